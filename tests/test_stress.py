"""The stress test: its list is read strictly, its expectations can fail, its short list passes."""

from __future__ import annotations

import csv
import io
import math
import re
import subprocess
import sys
import textwrap
import threading
from dataclasses import asdict
from pathlib import Path

import pytest

import gran_bench
from gran_bench import workers
from gran_bench.config import (
    BoundaryConfig,
    CconvModelConfig,
    ContainerConfig,
    FillingConfig,
    SceneConfig,
    StressConfig,
)
from gran_bench.config.rules import ConfigError
from gran_bench.files import locked
from gran_bench.plots.stability import draw_dem_step, draw_energy_drift, draw_time_to_failure
from gran_bench.provenance import read_table
from gran_bench.scene import build_scene
from gran_bench.shipped import shipped_model
from gran_bench.stress import case_list, command, run, steps
from gran_bench.stress.case_list import read_cases, shipped_cases
from gran_bench.stress.command import StressFailed, chosen, run_stress
from gran_bench.stress.expectation import Bound, Expectation, Failure, Observation, verdict
from gran_bench.stress.experiment import Bench, Experiment
from gran_bench.stress.page import closing_line, row
from gran_bench.stress.perform import EXPERIMENTS
from gran_bench.stress.run import Errand, carry_out, errands, forget
from gran_bench.surrogate.checkpoint import CheckpointError, ModelCard, save_model
from gran_bench.surrogate.step import build_model

CASE = """
- name: gap
  kind: start_overlap
  with: {overlap: 0.1}
  expect:
    met: [{quantity: energy_released, at_most: LIMIT, unit: of the stored}]
"""


def cases_of(text: str):
    return read_cases(text, "test.yaml", "dem")


# ---- the short list ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_short_list_passes_and_leaves_its_page(tmp_path, capsys):
    results = run_stress(StressConfig(selection="short", workers=1, output=str(tmp_path)))
    assert {result.case.part for result in results} == {"dem", "surrogate"}
    assert {result.verdict[0] for result in results} <= {"met", "flagged"}
    page = tmp_path / "part" / "README.md"
    text = page.read_text("utf-8")
    made, table = read_table(tmp_path / "part" / "stress.csv")
    assert {"command", "commit", "day"} <= set(made)
    rows = list(csv.DictReader(io.StringIO(table)))
    assert [row["case"] for row in rows] == [result.case.name for result in results]
    assert f"| {len(results)} cases | met | flagged | FAILED |" in text
    # Where the untrained network broke down stands on the page; what was kept to resume from is gone.
    assert re.search(r"\| untrained contact network \| untrained \| 0\.\d+ \|", text)
    assert {path.name for path in page.parent.iterdir()} == {".lock", "README.md", "stress.csv"}
    told = capsys.readouterr().out
    assert "FAILED" not in told
    assert f"{len(results)} cases in" in told
    assert str(tmp_path) not in text


def test_an_expectation_that_must_fail_fails_and_the_exit_code_is_1(tmp_path):
    # A tenth of the stored energy cannot be all that comes out at e = 0.5.
    cases = tmp_path / "cases.yaml"
    cases.write_text(CASE.replace("LIMIT", "0.1") + CASE.replace("LIMIT", "1.0").replace("gap", "wide"), "utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "gran_bench.stress", f"case_list={cases}", "workers=1", "output=out"],
        cwd=tmp_path, capture_output=True, text=True, timeout=200, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert done.stderr.splitlines()[-1] == "error: 1 of 2 expectations are not met: gap"
    assert "1 met, 1 FAILED (gap)" in done.stdout
    assert "FAILED" in (tmp_path / "out" / "part" / "README.md").read_text("utf-8")


# ---- the list is read strictly -------------------------------------------------------------------------------


def test_the_shipped_list_is_whole():
    cases = shipped_cases()
    assert {case.kind for case in cases} == set(EXPERIMENTS), "every kind of experiment is in the list"
    assert len([case for case in cases if case.short]) < len(cases)
    assert not [case.name for case in cases if case.known], "no failure is waiting to be mended"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("kind: start_overlap", "kind: start_overlaps", "kind 'start_overlaps' is unknown; did you mean start_overlap"),
        ("overlap: 0.1", "overlapp: 0.1", "parameter 'overlapp' is unknown; did you mean overlap"),
        ("overlap: 0.1", "overlap: deep", "with.overlap=deep has the wrong type; give a number"),
        ("overlap: 0.1", "overlap: 1e-1", "with.overlap=1e-1 has the wrong type"),  # YAML reads a text here
        ("with: {overlap: 0.1}", "with: {}", "needs with.overlap"),
        ("  with", "  wiht", "key 'wiht' is unknown; did you mean with"),
        ("quantity: energy_released", "quantity: energy_release", "did you mean energy_released"),
        ("unit: of the stored", "unit: J", "energy_released is measured in 'of the stored', not in 'J'"),
        (", at_most: LIMIT", "", "has no limit"),
        ("at_most: LIMIT", "at_most: true", "at_most=true has the wrong type; give a number"),
        ("met: [{", "may_diverge: [{", "key of expect 'may_diverge' is unknown"),
        ("    met: [{quantity: energy_released, at_most: LIMIT, unit: of the stored}]", "    met: []", "no bounds"),
        ("    met: [{quantity: energy_released, at_most: LIMIT, unit: of the stored}]", "    says: [x]", "give one of"),
        (
            "    met: [{quantity: energy_released, at_most: LIMIT, unit: of the stored}]",
            "    error: StateError",
            "without expect.says",
        ),
        ("name: gap", "models: [contact]\n  name: gap", "has no model, so models=['contact'] is idle"),
    ],
)
def test_what_cannot_be_in_a_list_is_refused_with_the_remedy(old, new, words):
    text = CASE.replace(old, new).replace("LIMIT", "1.0")
    with pytest.raises(ConfigError) as caught:
        cases_of(text)
    assert words in str(caught.value)
    assert "test.yaml, case 1" in str(caught.value)


@pytest.mark.parametrize("text", ["", "a: 1", "- 3", "- {a: [}"])
def test_what_is_no_list_is_refused(text):
    with pytest.raises(ConfigError, match=r"test\.yaml"):
        cases_of(text)


def test_an_unknown_case_and_an_empty_choice_are_refused():
    with pytest.raises(ConfigError, match="did you mean no sphere at all"):
        chosen(StressConfig(cases=["no spheres at all"]))
    with pytest.raises(ConfigError, match="choose selection=full"):
        chosen(StressConfig(selection="short", cases=["no gravity"]))
    with pytest.raises(CheckpointError, match="does not exist"):
        run_stress(StressConfig(cases=["20 rpm"], checkpoint="nowhere.pt"))


# ---- verdicts ------------------------------------------------------------------------------------------------

MET = Expectation("met", (Bound("a", "m", at_most=1.0),))
FLAGGED = Expectation("flagged", (Bound("a", "m", at_most=1.0),), says=("frame 3",))
ERROR = Expectation("error", error="StateError", says=("sphere 3", "move it"))


@pytest.mark.parametrize(
    ("expectation", "outcome", "word"),
    [
        (MET, Observation({"a": 1.0}), "met"),
        (MET, Observation({"a": 1.1}), "FAILED"),
        (MET, Observation({"a": math.nan}), "FAILED"),
        (MET, Observation({}), "FAILED"),
        (MET, Observation({"a": 1.0}, unflagged=1), "FAILED"),
        (MET, Failure("StateError", "sphere 3"), "FAILED"),
        (FLAGGED, Observation({"a": 1.0}, ("failed at frame 3",)), "flagged"),
        (FLAGGED, Observation({"a": 1.0}), "FAILED"),
        (FLAGGED, Observation({"a": 2.0}, ("failed at frame 3",)), "FAILED"),
        (FLAGGED, Observation({"a": 1.0}, ("failed at frame 3",), unflagged=2), "FAILED"),
        (FLAGGED, Failure("Crash", "frame 3"), "FAILED"),
        (ERROR, Failure("StateError", "sphere 3 is out; move it"), "met"),
        (ERROR, Failure("StateError", "sphere 3 is out"), "FAILED"),
        (ERROR, Failure("ValueError", "sphere 3 is out; move it"), "FAILED"),
        (ERROR, Observation({"a": 0.0}), "FAILED"),
    ],
)
def test_a_verdict_is_what_the_expectation_says(expectation, outcome, word):
    assert verdict(expectation, outcome)[0] == word


def test_a_known_failure_still_fails_and_is_told_as_known():
    (case,) = cases_of(CASE.replace("LIMIT", "0.1").replace("name: gap", "known: springs\n  name: gap"))
    result = Errand(case, "", "", Path(), Observation({"energy_released": 0.5}), 1.0)
    assert result.verdict[0] == "FAILED"
    assert row(result)[4] == "FAILED (known: springs)"
    assert "1 FAILED (gap)" in closing_line([result], 1.0)


def test_the_documented_form_of_a_list_is_legal():
    example = case_list.__doc__.partition("of the form\n\n")[2].partition("\n\nwhere")[0]
    assert [case.kind for case in cases_of(textwrap.dedent(example))] == ["start_overlap"]


# ---- the run -------------------------------------------------------------------------------------------------


def test_an_interrupted_run_goes_on_where_it_was(tmp_path, monkeypatch):
    cases = cases_of(CASE.replace("LIMIT", "1.0") + CASE.replace("LIMIT", "0.9").replace("gap", "other"))
    cases[1].parameters["overlap"] = 0.05
    seen, perform = [], run.perform

    def interrupted(**task):
        if seen:
            raise KeyboardInterrupt
        seen.append(perform(**task))
        return seen[-1]

    monkeypatch.setattr(run, "perform", interrupted)
    with pytest.raises(KeyboardInterrupt):
        carry_out(errands(cases, [], tmp_path), tmp_path, 1, 60.0)
    monkeypatch.undo()
    again = errands(cases, [], tmp_path)
    carry_out(again, tmp_path, 1, 60.0)
    assert [result.kept for result in again] == [True, False]
    assert again[0].outcome == seen[0]
    forget(tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_step_of_the_data_is_held_against_the_floor_that_is_measured_beside_it(tmp_path, monkeypatch):
    drum = SceneConfig("drum_tiny", ContainerConfig(diameter=0.4, length=0.2), FillingConfig(count=60), start_time=1.0)
    monkeypatch.setattr(steps, "shipped_scene", lambda name: build_scene(drum))
    seen = steps.step_ladder(Bench(tmp_path), [1e-4, 2e-4], production=2e-4, seconds=0.1).quantities
    assert seen["beyond_floor"] == seen["error"] - seen["floor"]
    assert seen["error"] > 0.0
    (case,) = (case for case in shipped_cases() if case.kind == "step_ladder")
    assert case.expectation.bounds == (Bound("beyond_floor", "°", at_most=0.5),)


@pytest.mark.parametrize("file", ["sweep/opening.py", "conf/trainer/quick.yaml", "stress/lists/dem.yaml"])
def test_what_was_kept_counts_no_more_once_any_code_config_or_list_has_changed(tmp_path, monkeypatch, file):
    for name in ("__init__.py", "sweep/opening.py", "conf/trainer/quick.yaml", "stress/lists/dem.yaml"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("a = 1\n", "utf-8")
    monkeypatch.setattr(gran_bench, "__file__", str(tmp_path / "__init__.py"))
    monkeypatch.setattr(run, "files", lambda package: tmp_path / package.removeprefix("gran_bench."))
    monkeypatch.setattr(run, "package_digest", run.package_digest.__wrapped__)
    cases, results = cases_of(CASE.replace("LIMIT", "1.0")), tmp_path / "results"
    (before,), (same,) = errands(cases, [], results), errands(cases, [], results)
    (tmp_path / file).write_text("a = 2\n", "utf-8")
    (after,) = errands(cases, [], results)
    assert before.file == same.file
    assert before.file != after.file


def test_a_second_run_in_the_same_folder_waits_for_the_first_and_says_so(tmp_path, monkeypatch, capsys):
    path = tmp_path / "cases.yaml"
    path.write_text(CASE.replace("LIMIT", "1.0"), "utf-8")
    config = StressConfig(case_list=str(path), workers=1, output=str(tmp_path))
    folder, waits, say = tmp_path / "part", threading.Event(), command._tell_of_another
    monkeypatch.setattr(command, "_tell_of_another", lambda place: (say(place), waits.set()))
    second = threading.Thread(target=run_stress, args=(config,))
    with locked(folder / ".lock"):
        second.start()
        assert waits.wait(60.0)
        assert f"another stress test runs in {folder}; waiting for it to end" in capsys.readouterr().err
        assert {path.name for path in folder.iterdir()} == {".lock"}
    second.join(60.0)
    assert (folder / "README.md").exists()


def test_every_model_gets_every_case_that_is_for_it(tmp_path):
    config, boundary, scene = CconvModelConfig(name="radial", kernel="radial"), BoundaryConfig(), SceneConfig("drum")
    for diameter in (0.05, 0.04):
        scene.filling.diameter = diameter
        model = build_model(config, boundary, build_scene(scene))
        card = ModelCard(asdict(config), asdict(boundary), asdict(scene), {})
        save_model(tmp_path / f"{diameter}" / "model.pt", model.state_dict(), card)
    files = [shipped_model(), tmp_path / "0.05" / "model.pt"]
    todo = [(errand.case.name, errand.model) for errand in errands(shipped_cases(), files, tmp_path)]
    contact, radial = "contact (holdout30rpm)", "radial (0.05)"
    assert {("20 rpm", contact), ("20 rpm", radial), ("no sphere at all", "")} < set(todo)
    assert ("model, turned by 40° about the axis", radial) not in todo
    assert ("convolution, turned by 40° about the axis", contact) not in todo
    assert len(todo) == len(set(todo))
    with pytest.raises(ConfigError, match=r"made for spheres of 0\.04 m, and the lists have 0\.05 m"):
        errands(shipped_cases(), [tmp_path / "0.04" / "model.pt"], tmp_path)


@pytest.mark.parametrize(("does", "word"), [("time.sleep(60)", "Hang"), ("sys.stdin.readline()", "Crash")])
def test_a_case_that_crashes_or_hangs_costs_itself_alone(tmp_path, monkeypatch, does, word):
    def stubborn(module, environment, **pipes):
        code = f"import sys, time; {does}"
        return subprocess.Popen([sys.executable, "-S", "-c", code], start_new_session=True, **pipes)

    monkeypatch.setattr(workers, "start_module", stubborn)
    (errand,) = todo = errands(cases_of(CASE.replace("LIMIT", "1.0")), [], tmp_path)
    carry_out(todo, tmp_path, 2, 0.2 if word == "Hang" else 60.0)
    assert errand.outcome.error == word
    assert not errand.file.exists()
    monkeypatch.undo()
    carry_out(todo, tmp_path, 2, 60.0)
    assert errand.verdict[0] == "met"


def test_a_failed_run_says_which(tmp_path, capsys):
    path = tmp_path / "cases.yaml"
    path.write_text(CASE.replace("LIMIT", "0.1"), "utf-8")
    with pytest.raises(StressFailed, match="1 of 1 expectations are not met: gap"):
        run_stress(StressConfig(case_list=str(path), workers=1, output=str(tmp_path)))
    assert "FAILED" in capsys.readouterr().out


def test_a_kind_names_its_parameters_and_quantities():
    for name, experiment in EXPERIMENTS.items():
        assert isinstance(experiment, Experiment)
        assert experiment.measures, name
        assert all(parameter.annotation is not parameter.empty for parameter in experiment.parameters.values()), name


def test_the_list_is_where_the_package_is():
    import gran_bench.stress

    folder = Path(gran_bench.stress.__file__).parent / "lists"
    assert sorted(path.stem for path in folder.glob("*.yaml")) == ["dem", "surrogate"]


# ---- figures -------------------------------------------------------------------------------------------------


def test_figures_show_what_failed_too(tmp_path):
    step = {
        "step": [1e-4, 2e-4, 4e-4], "error": [0.0, 0.3, math.inf], "cost": [9.0, 5.0, math.nan],
        "floor": [0.2], "contact_time": [4e-3], "production": [2e-4],
    }  # fmt: skip
    drift = {"steps_per_contact": [50.0, 10.0, 2.0], "change": [1e-4, 1e-2, math.inf], "bound": [3.0]}
    runs = {"contact": [(30.0, 4.0, True), (500.0, 0.03, False)], "ccnn, untrained": [(30.0, 0.07, False)]}
    for draw, values in ((draw_dem_step, step), (draw_energy_drift, drift), (draw_time_to_failure, runs)):
        assert draw(values, tmp_path / f"{draw.__name__}.png").stat().st_size > 10_000
    assert draw_time_to_failure({}, tmp_path / "nothing.png").exists()
