"""The verification suite: its quick cases hold, and it fails where the solver, a tolerance or a case is wrong."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gran_bench.verification.theory
from gran_bench.dem import contact, engine_numpy
from gran_bench.plots.verification import draw_verification
from gran_bench.verification import CASES, Case, Check, run_case
from gran_bench.verification.command import FAILED, MET, REFUSED, run, table
from gran_bench.verification.laboratory import (
    Impacts,
    collide,
    on_rigid_wall,
    on_sphere,
    on_wall,
    sphere_material,
)
from gran_bench.verification.theory import damping, restitution, sliding_rebound

ROOT = Path(__file__).parents[2]
BY_NAME = {case.name: case for case in CASES}


def test_spheres_of_two_densities_keep_their_momentum_and_part_as_set():
    light = sphere_material(restitution=0.7)
    contact = on_sphere(light, 0.02, 0.03, replace(light, density=5.0 * light.density))
    rebounds = collide(Impacts(contact, [0.5, 1.0, 2.0]))
    mass = np.array([contact.first.mass, contact.second.mass])
    assert mass[1] / mass[0] == pytest.approx(5.0 * 1.5**3)
    after = rebounds.result.final.velocity[:, 2].reshape(2, 3)
    assert mass @ after == pytest.approx(-mass[0] * np.array([0.5, 1.0, 2.0]), rel=1e-12)
    assert rebounds.normal == pytest.approx(0.7 * np.array([0.5, 1.0, 2.0]), rel=2e-3)
    # Of the energy in the frame in which the second body rested, m*/m₁ (1 − e²) is lost.
    lost = contact.effective_mass / contact.first.mass * (1.0 - 0.7**2)
    assert rebounds.energy == pytest.approx(1.0 - lost, abs=2e-3)


@pytest.mark.parametrize("name", [case.name for case in CASES if case.quick])
def test_case(name):
    outcome = run_case(BY_NAME[name])
    assert outcome.failure is None
    missed = [check.quantity for check in outcome.checks if not check.met]
    assert outcome.met, f"out of tolerance: {missed}\n{table([outcome])}"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """No test writes the page of this checkout."""
    monkeypatch.chdir(tmp_path)


def command(*words: str, cases: tuple[Case, ...] = CASES) -> int:
    """Exit code of the command, without figures."""
    return run(lambda outcomes, folder: [], words, cases)


def a_case(found: object, tolerance: float = 1e-3, expected: object = 1.0) -> Case:
    """A case of one quantity."""
    check = Check("length, m", expected, found, tolerance, "made up")
    return Case("made-up", "a case of a test", lambda: [check])


# What the suite says of a solver that is wrong


def test_damping_by_the_formula_with_the_attractive_tail_is_found_out(monkeypatch, capsys):
    tailed = {e: -np.sqrt(5.0) * np.log(e) / np.hypot(np.pi, np.log(e)) for e in np.arange(0.01, 1.01, 0.01).round(2)}
    monkeypatch.setattr(contact, "damping_coefficient", lambda e: float(tailed[round(e, 2)]))
    assert command("--case", "chung-ooi-3") == FAILED
    assert "FAILED" in capsys.readouterr().out


def test_a_friction_coefficient_that_is_off_by_three_percent_is_found_out(monkeypatch):
    between = contact.ContactLaw.between

    def slippery(first, second):
        law = between(first, second)
        return replace(law, friction=0.97 * law.friction)

    monkeypatch.setattr(contact.ContactLaw, "between", slippery)
    assert command("--case", "chung-ooi-4") == FAILED


def test_a_torque_that_is_off_by_a_trifle_is_found_out(monkeypatch):
    honest = engine_numpy.contact_force

    def long_arm(law, **given):
        force = honest(law, **given)
        return replace(force, twist=(1.0 + 1e-9) * force.twist)

    monkeypatch.setattr(engine_numpy, "contact_force", long_arm)
    assert command("--case", "engine-forces") == FAILED


def test_a_history_that_forgets_to_unload_is_found_out(monkeypatch):
    honest = engine_numpy.contact_force
    monkeypatch.setattr(
        engine_numpy,
        "contact_force",
        lambda law, **given: honest(
            law, **given | {"overlap_before": np.minimum(given["overlap_before"], given["overlap"])}
        ),
    )
    assert command("--case", "shear-load-cycle") == FAILED


# What it says of a tolerance that is missed, of what has no number, and of a case that stops


@pytest.mark.parametrize("found", [1.002, np.nan, np.inf])
def test_a_quantity_out_of_tolerance_is_a_failure(found, capsys):
    assert command("--case", "made-up", cases=(a_case(found), a_case(1.0))) == FAILED
    assert "1 FAILED: made-up" in capsys.readouterr().out


def test_a_tolerance_of_nothing_fails_a_true_case():
    case = BY_NAME["chung-ooi-1"]
    strict = [replace(check, tolerance=0.0) for check in case.run()]
    assert command("--case", "strict", cases=(Case("strict", "", lambda: strict),)) == FAILED


def test_a_case_that_stops_is_a_failure_with_its_words(capsys):
    def stop() -> list[Check]:
        raise ZeroDivisionError("no mass")

    assert command("--case", "stops", cases=(Case("stops", "", stop), a_case(1.0))) == FAILED
    assert "ZeroDivisionError: no mass" in capsys.readouterr().out


def test_a_case_that_checks_nothing_is_a_failure(capsys):
    assert command("--case", "empty", cases=(Case("empty", "", lambda: []),)) == FAILED
    assert "nothing was checked" in capsys.readouterr().out


def test_the_worst_point_is_the_one_that_is_shown(capsys):
    check = Check("speed, m/s", [1.0, 2.0, 3.0], [1.0, 2.5, 3.0], 0.3, "made up", at=("a", "b", "c"))
    assert command("--case", "made-up", cases=(Case("made-up", "", lambda: [check]),)) == MET
    row = capsys.readouterr().out.splitlines()[2]
    assert "speed, m/s at b" in row
    assert "2.5" in row
    assert "met" in row


def test_an_error_is_zero_where_nothing_is_expected_and_nothing_found():
    assert Check("spin", [0.0, 1.0], [0.0, 1.0], 0.0, "made up", at=("a", "b")).met
    assert not Check("spin", 0.0, 1e-300, 1.0, "made up").met


def test_points_that_do_not_match_are_refused():
    with pytest.raises(ValueError, match="2 expected, 1 found"):
        Check("spin", [0.0, 1.0], 0.0, 1.0, "made up", at=("a", "b"))


# The command


def test_names_of_cases_are_unique_and_listed(capsys):
    assert len(BY_NAME) == len(CASES)
    assert command("--list") == MET
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(BY_NAME)


def test_an_unknown_case_is_refused_with_the_nearest_one(capsys):
    assert command("--case", "head_on") == REFUSED
    assert "did you mean head-on?" in capsys.readouterr().err


def test_a_case_that_quick_leaves_out_is_refused(capsys):
    assert command("--quick", "--case", "energy-drift") == REFUSED
    assert "give one of the two" in capsys.readouterr().err


def test_an_output_that_is_a_file_is_refused_before_anything_runs(tmp_path, capsys):
    taken = tmp_path / "taken"
    taken.write_text("")
    never = Case("never", "", lambda: pytest.fail("it ran"))
    assert command("--output", str(taken), cases=(never,)) == REFUSED
    assert "choose a folder for --output" in capsys.readouterr().err


def test_a_part_of_the_suite_leaves_the_page_of_the_whole_alone(tmp_path):
    other = Case("other", "another", lambda: [Check("a", 1.0, 1.0, 1.0, "made up")])
    assert command("--case", "made-up", cases=(a_case(1.0), other)) == MET
    assert command("--quick", cases=(a_case(1.0), other)) == MET
    assert list(tmp_path.iterdir()) == []
    assert command(cases=(a_case(1.0), other)) == MET
    assert (tmp_path / "results" / "verification" / "README.md").exists()


def test_the_page_holds_every_case_and_the_json_every_point(tmp_path):
    failing = Case("stops", "a case that stops", lambda: 1 / 0)
    assert command("--output", str(tmp_path), cases=(failing, a_case(np.inf))) == FAILED
    page = (tmp_path / "README.md").read_text("utf-8")
    record = json.loads((tmp_path / "verification.json").read_text("utf-8"))
    for text in ("| stops | a case that stops |", "division by zero", "| inf | FAILED |", "2 FAILED: stops, made-up"):
        assert text in page
    assert record["met"] is False
    assert [case["name"] for case in record["cases"]] == ["stops", "made-up"]
    assert record["cases"][1]["checks"][0]["found"] == ["inf"]
    assert {"command", "commit", "hardware"} <= set(record["provenance"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["README.md", "verification.json"]


def test_figures_show_the_cases_that_were_run(tmp_path):
    outcomes = [run_case(BY_NAME["chung-ooi-4"]), run_case(BY_NAME["order"])]
    assert draw_verification(outcomes, tmp_path) == ["oblique_impact.png", "step.png"]
    assert draw_verification([run_case(a_case(1.0))], tmp_path / "none") == []
    assert all((tmp_path / name).stat().st_size > 10_000 for name in ("oblique_impact.png", "step.png"))


@pytest.mark.parametrize("module", ["gran_bench.verify", "data_gen.verify"])
def test_both_entries_run(module):
    words = [sys.executable, "-m", module, "--case", "nothing-like-it"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == REFUSED
    assert done.stderr == "error: --case nothing-like-it is unknown; --list shows the names\n"


# The theory


def test_theory_shares_no_code_with_the_solver():
    tree = ast.parse(Path(gran_bench.verification.theory.__file__).read_text("utf-8"))
    imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    imported |= {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    own = {name for name in imported if name.startswith("gran_bench")}
    assert own <= {"gran_bench.scene", "gran_bench.state"}


def test_the_closed_form_of_restitution_is_what_the_solver_integrates():
    for alpha in (0.05, 0.5, 1.0, 2.0, np.sqrt(5.0), 3.0, 8.0):
        assert restitution(alpha) == pytest.approx(contact.restitution_of(alpha), abs=1e-7)
    for e in (0.05, 0.3, 0.9, 1.0):
        assert restitution(damping(e)) == pytest.approx(e, abs=1e-12)


def test_the_equations_slide_like_rigid_bodies_where_contacts_are_stiff():
    impact = gran_bench.verification.theory.impact
    for bodies in (on_wall, on_sphere):
        contact_of = bodies(sphere_material(7e14, 0.7, 0.2))
        rebound = impact(contact_of, np.array([3.0, -1.0]))
        speed, spin = sliding_rebound(contact_of, np.array([1.0]), np.array([3.0]), contact_of.first.radius)
        assert rebound.slid_throughout
        assert rebound.velocity == pytest.approx([speed[0], 0.7], rel=1e-3)
        assert rebound.spin[0] == pytest.approx(spin[0], rel=2e-3)


def test_without_friction_nothing_but_the_normal_speed_changes():
    rebound = gran_bench.verification.theory.impact(on_rigid_wall(sphere_material(1e7, 0.4)), np.array([2.0, -1.0]))
    assert rebound.velocity == pytest.approx([2.0, 0.4], rel=1e-8)
    assert rebound.spin == (0.0, 0.0)


def test_impacts_side_by_side_do_not_see_each_other():
    material = sphere_material(1e7, 0.5, 0.3)
    together = collide(Impacts(on_sphere(material), [1.0, 1.0, 1.0], [0.2, 1.0, 3.0]))
    alone = collide(Impacts(on_sphere(material), 1.0, 1.0))
    assert together.first_spin[1] == pytest.approx(alone.first_spin[0], rel=1e-12)
