"""The front page of the results: it is what the committed records say, and says who is old, who failed and who wins."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from test_comparison_page import found, row  # noqa: F401  a fixture
from test_run_summary import SCENE, broken, flowing, summary_of
from test_sweep import lost, run

from gran_bench.code_identity import modules_behind
from gran_bench.front_page import age
from gran_bench.front_page.advice import benchmark_advice, run_advice
from gran_bench.front_page.age import Age, age_of, today, unknown_age, without_today
from gran_bench.front_page.command import report_command
from gran_bench.front_page.failures import broken_cases, sweep_failures
from gran_bench.front_page.influence import largest
from gran_bench.front_page.page import PAGE, PAGES, page_text
from gran_bench.front_page.records import STRESSED, Origin, read_records
from gran_bench.front_page.speed import lammps_sentence
from gran_bench.provenance import read_origin, write_origin
from gran_bench.sweep.overview import reaches

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results"


def git(*words: str) -> str:
    done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, encoding="utf-8", check=False)
    return done.stdout if done.returncode == 0 else ""


# ---- the committed page ----------------------------------------------------------------------------------


def test_the_page_is_what_the_committed_records_say():
    changed = git("status", "--porcelain", "--", "results").split("\n")
    if [line for line in changed if line and not line.endswith("results/README.md")]:
        pytest.skip("records differ from the commit; python -m gran_bench.report takes them up")
    fresh = page_text(read_records(RESULTS), RESULTS, unknown_age)
    kept = (RESULTS / PAGE).read_text("utf-8")
    assert without_today(fresh) == without_today(kept), "run python -m gran_bench.report and commit results/README.md"


def test_every_link_of_the_page_leads_somewhere():
    links = re.findall(r"\]\(([^)#]+)\)", (RESULTS / PAGE).read_text("utf-8"))
    assert len(links) > 10
    assert [link for link in links if not (RESULTS / link).exists()] == []


def test_a_page_that_is_there_is_in_the_table_of_pages():
    listed = {page.partition("/")[0] for page, _, _ in PAGES}
    tracked = {line.split("/")[1] for line in git("ls-files", "results").splitlines() if line.count("/") > 1}
    assert tracked <= listed


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """The committed records alone, in a folder of their own."""
    for path in ("holdout30rpm/summary.json", "paper/summary.json", "verification/verification.json"):
        (tmp_path / path).parent.mkdir(exist_ok=True)
        shutil.copy(RESULTS / path, tmp_path / path)
    return tmp_path


def pure(root: Path) -> str:
    return without_today(page_text(read_records(root), root, unknown_age))


def test_a_record_that_changes_changes_the_page_and_its_age_does_not(copied: Path):
    before = pure(copied)
    assert pure(copied) == before
    old = page_text(read_records(copied), copied, lambda origin: Age("2026-11-22", ("dem",)))
    assert "**STALE**" in old
    assert without_today(old) == before
    path = copied / "holdout30rpm/summary.json"
    summary = json.loads(path.read_text("utf-8"))
    summary["judged"]["shared"]["errors"]["surface_angle"]["value"] += 1.0
    path.write_text(json.dumps(summary))
    assert pure(copied) != before


def test_what_was_not_made_yet_is_named_with_the_command_that_makes_it(copied: Path):
    text = pure(copied)
    for words in ("`make bench`", "`make stress`", "+experiment=sweep_radius"):
        assert re.search(rf"not (made|known) yet.*{re.escape(words)}|No sweep.*{re.escape(words)}", text), words


def test_the_page_is_written_with_all_sweeps_and_only_where_records_are(copied: Path, capsys):
    assert report_command(["--root", str(copied)]) == 0
    assert without_today((copied / PAGE).read_text("utf-8")) == pure(copied)
    (copied / "paper/summary.json").write_text("{")
    assert report_command(["--root", str(copied)]) == 1
    assert "error:" in capsys.readouterr().err
    assert report_command(["--root", str(copied / "nothing")]) == 2


# ---- age -------------------------------------------------------------------------------------------------


def origin(commit: str, *roots: str) -> Origin:
    return Origin("a record", "README.md", "make", commit, "two cores", roots)


def test_the_stress_test_goes_through_every_experiment_and_through_sweeps():
    behind = modules_behind(*STRESSED)
    experiments = {f"stability.{name}" for name in ("impacts", "rollouts", "kills", "sharing", "damage")}
    sweeps = {"stability.sweep_kill", "stability.victim", "sweep_run", "launcher", "job", "experiment", "evaluation"}
    assert {*experiments, *sweeps, "stability.case_list", "tracking.store", "dataset.worker"} <= behind


def test_a_record_is_stale_where_code_that_made_it_differs_from_its_commit():
    head = git("rev-parse", "--short=12", "HEAD").strip()
    if not head:
        pytest.skip("no history")
    now = age_of(origin(head, "dem.simulate"))
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", now.date)
    if not git("status", "--porcelain", "--", "src"):
        assert now.changed == ()
    # At the root of the history there was no such module.
    first = git("rev-list", "--max-parents=0", "HEAD").split()[0]
    if git("ls-tree", "--name-only", first, "src/gran_bench/dem/simulate.py"):
        pytest.skip("a shallow history")
    assert "dem" in age_of(origin(first, "dem.simulate")).changed


def test_what_came_out_of_a_solver_that_gives_the_same_bits_is_not_stale_but_its_times_are(monkeypatch):
    head = git("rev-parse", "--short=12", "HEAD").strip()
    if not head:
        pytest.skip("no history")
    monkeypatch.setattr(age, "_code_differs", lambda commit, name: "/dem/" in name)
    monkeypatch.setattr(age, "_git", lambda *words: changed_since(*words))
    result = origin(head, "dem.simulate")
    for same, stale in ((True, False), (False, True)):
        monkeypatch.setattr(age, "_same_bits", lambda commit, names, same=same: same)
        assert age_of(result).stale is stale
        assert age_of(replace(result, about_code=True)).stale


def changed_since(*words: str) -> str:
    """What git would say if all files had changed."""
    files = git("ls-files", "src/gran_bench")
    return files if words[0] in ("ls-tree", "diff") else "2026-11-22"


def test_the_solver_of_this_commit_gives_its_own_bits():
    names = git("ls-files", "src/gran_bench").split("\n")
    if not any(names):
        pytest.skip("no history")
    if not git("status", "--porcelain", "--", "src"):
        assert age._same_bits("HEAD", names)


def test_a_commit_that_the_history_does_not_have_says_so():
    for commit in ("0" * 12, ""):
        age = age_of(origin(commit, "state"))
        assert not age.stale
        assert "not in this history" in str(age)


def test_marks_stand_apart_from_what_the_records_say():
    assert without_today(f"a{today(' b')}c\n{today('d')}") == "ac\n"
    assert "**STALE**: since then changed the DEM and the judge" in str(Age("2026-11-22", ("dem", "metrics")))
    assert "by today's code" in str(Age("2026-11-22", ()))


def test_the_origin_of_a_table_counts_for_that_table_alone(tmp_path: Path):
    table = tmp_path / "stress.csv"
    table.write_text("a\n")
    assert read_origin(table) is None
    write_origin(table, {"commit": "abc"})
    assert read_origin(table) == {"commit": "abc"}
    table.write_text("b\n")
    assert read_origin(table) is None


# ---- sentences that follow from figures ------------------------------------------------------------------


def test_a_surrogate_is_not_for_where_the_dem_is_as_exact_and_faster(found: dict):  # noqa: F811
    (said,) = benchmark_advice(found)
    # 900 s of data and training, 0.3 s saved a second beside the DEM at its automatic step.
    assert "Not **net** in `drum` for fewer than 3,000 simulated seconds" in said
    assert "1.5 times as fast as DEM 0.2 ms" in said
    found["methods"].append(row("DEM 1.25 ms, soft", "dem", 0.3, 1.2))
    (said,) = benchmark_advice(found)
    assert said == "Not **net** in `drum`: DEM 1.25 ms, soft is 2 times as fast (1.20 floors beside 1.80)."
    found["methods"].append(row("DEM 0.8 ms, soft", "dem", 0.6, 1.2))
    found["methods"].remove(next(one for one in found["methods"] if one["name"] == "DEM 1.25 ms, soft"))
    (said,) = benchmark_advice(found)
    assert "are not told apart in time" in said
    uncertain = {"floors_low": 1.7, "floors_high": 2.1}
    found["methods"] = [row("DEM 0.2 ms", "dem", 0.9, 1.0), row("DEM 1.5 ms", "dem", 0.3, 1.9, **uncertain)]
    found["methods"].append(row("net", "surrogate", 0.6, 1.8, **uncertain))
    (said,) = benchmark_advice(found)
    assert "it is undecided whether **net** or a DEM that is as exact is faster" in said
    found["methods"] = [row("net", "surrogate", 0.6, None, "spheres left")]
    assert list(benchmark_advice(found)) == ["Not **net** in `drum`: it failed, spheres left."]


def judged(multiple: float, **baselines: float) -> dict:
    def errors(value: float) -> dict:
        return {"surface_angle": {"multiple_of_floor": value}, "speed_w1": {"multiple_of_floor": 0.5 * value}}

    return {
        "model": {"name": "net"},
        "judged": {"shared": {"errors": errors(multiple), "requirements": {"a": {"label": "a", "verdict": "pass"}}}},
        "baselines": {name: errors(value) for name, value in baselines.items()},
    }


def test_a_baseline_that_is_as_exact_and_costs_nothing_speaks_against_a_surrogate():
    (said,) = run_advice("mine", judged(1.5, interpolated=1.2, replayed=1.6))
    assert "interpolated errs by 1.20 floors, `net` (mine) by 1.50" in said
    assert list(run_advice("mine", judged(1.1, interpolated=1.2))) == []
    summary = judged(1.5)
    summary["judged"]["shared"]["errors"]["speed_w1"]["multiple_of_floor"] = None
    assert "an error is undefined" in next(run_advice("mine", summary))


def test_rollouts_of_trained_models_that_ended_early_are_counted():
    def case(name: str, model: str, survived: float) -> dict[str, str]:
        quantities = json.dumps({"time_to_failure": survived, "horizon": 4.0})
        return {"part": "surrogate", "case": name, "model": model, "quantities": quantities}

    rows = [case("500 rpm", "net", 0.03), case("30 rpm", "net", 4.0), case("untrained", "", 0.1)]
    assert broken_cases(rows) == ["500 rpm (after 0.03 s)"]


def test_failed_runs_of_a_sweep_are_counted_with_their_reasons():
    done = run("0.08", 0, 1.0)
    gone = replace(done, figures=done.figures | {"angle_error_deg": None}, facts={"broken_rollouts": {"30rpm": 3}})
    said = sweep_failures([done, gone, lost("0.2", 0)], waiting=2)
    assert re.match(r"1 of 3 runs failed \(1 × .+\), 2 wait; of those that finished 1 broke down", said)
    assert "1 have an undefined figure" in said


def test_a_difference_that_seeds_alone_give_is_no_reach():
    certain = [run("0.08", 0, 1.0), run("0.08", 1, 1.1), run("0.1", 0, 4.0), run("0.1", 1, 4.1)]
    assert "angle error, floors" in {reach.figure for reach in largest(reaches(certain))}
    blurred = [run("0.08", 0, 1.0), run("0.08", 1, 4.0), run("0.1", 0, 2.0), run("0.1", 1, 4.1)]
    assert "angle error, floors" not in {reach.figure for reach in largest(reaches(blurred))}


def test_a_single_seed_a_choice_ranks_nothing_and_the_page_says_how_many_rows_have_one(tmp_path: Path):
    single = [run("0.08", 0, 1.0), run("0.1", 0, 4.0)]
    assert largest(reaches(single)) == []
    for one in single:
        one.write(tmp_path / "sweeps/sweep_radius")
    section = pure(tmp_path).partition("## What matters")[2].partition("##")[0]
    assert "4 of 4 have one seed a choice and are not ranked here" in section
    assert "(sweeps/README.md)" in section
    assert "worst / best" not in section


def test_the_time_of_a_frame_counts_only_where_the_network_has_other_work():
    def figures(axis: str) -> set[str]:
        runs = [replace(one, choices={axis: one.run}) for one in (run("0.08", 0, 1.0), run("0.1", 0, 4.0))]
        return {reach.figure for reach in reaches(runs)}

    for axis in ("model", "model.radius", "boundary", "+model.radius"):
        assert "a frame, ms" in figures(axis)
    for axis in ("loss", "rollout", "optim.learning_rate", "trainer.minutes"):
        assert figures(axis) == {"angle error, floors", "speed W1, floors", "position error, 10 frames, mm"}


def test_lammps_is_held_against_as_many_cores():
    columns = ("solver", "cores", "median_us")
    rows = [("gran-bench numba", 1, 100), ("LAMMPS, skin 3", 1, 600), ("LAMMPS, skin 5", 1, 500)]
    assert "100 µs a step against 500 on 1 core (LAMMPS takes 5.0 times" in lammps_sentence(
        pd.DataFrame(rows, columns=columns)
    )


# ---- the sections with everything there ------------------------------------------------------------------


@pytest.mark.parametrize("fails", [False, True])
def test_every_section_speaks_where_every_record_is_there(tmp_path: Path, found: dict, fails: bool):  # noqa: F811
    write: Callable[[str, object], int] = lambda path, what: (tmp_path / path).write_text(json.dumps(what))  # noqa: E731
    for folder in ("holdout30rpm", "benchmark/quick/drum", "sweeps/sweep_radius"):
        (tmp_path / folder).mkdir(parents=True)
    rollout = broken(20) if fails else flowing(SCENE, seed=3)
    summary = summary_of(rollout, flowing(SCENE, seed=4), failed_frames=(20 if fails else None, None))
    made = {"command": "train", "commit": "abc", "hardware": "two cores"}
    write("holdout30rpm/summary.json", summary | {"provenance": made, "training": summary["training"] | made})
    write("benchmark/quick/drum/benchmark.json", found)
    finished = [run(radius, seed, 50 * float(radius) + 0.1 * seed) for radius in ("0.08", "0.1") for seed in (0, 1)]
    for one in (*finished, lost("0.2", 0)):
        one.write(tmp_path / "sweeps/sweep_radius")
    text = pure(tmp_path)
    assert "| net | 0.6 | 0.6 | 1.80 |" in text
    assert "the fastest is **DEM 0.2 ms**" in text
    assert "| [sweep_radius](sweeps/sweep_radius/README.md) |" in text
    assert "1 of 4 methods failed: DEM 5 ms (sphere 3 diverged)" in text
    assert "1 of 5 runs failed" in text
    assert ("rollout 30rpm broke down at frame 20" in text) == fails
