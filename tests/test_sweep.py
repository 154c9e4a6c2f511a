"""What a sweep keeps and says: every run in its table, failures too; the page can be made anew from small files."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from beds import flowing
from finished_runs import ANGLE, ANGLE_FLOORS, SCENE, broken, job_of, lost, run, summary_of, sweep_in

from gran_bench.config import TrainConfig
from gran_bench.run.identity import RunIdentity
from gran_bench.run.summary import headline, write_summary
from gran_bench.sweep.opening import _fill_table
from gran_bench.sweep.runs import SweepFile, SweepFileError, SweepJob, SweepRun, read_runs, write_runs
from gran_bench.sweep.sweep_report import report_sweep, write_overview
from gran_bench.sweep.table import axes_of, best_choices, read_standing, runs_frame, shown_table, standing

RESULTS = Path(__file__).parents[1] / "results"


# ---- the rows of a table -----------------------------------------------------------------------------------


def ready(one: SweepRun, root: Path, made_with: str = "this") -> SweepJob:
    """The job of a run whose data are there, and nothing else of it."""
    identity = RunIdentity(root / "runs" / one.run, one.key, one.judged_by, "")
    return replace(job_of(one), made_with=made_with, config=TrainConfig(), identity=identity)


def test_a_finished_run_leaves_a_row_that_holds_both_packings(tmp_path: Path):
    summary = summary_of(flowing(SCENE, seed=3), broken(7), failed_frames=(None, 7))
    summary["training"] |= {"loss": 0.1, "data_digest": "d", "model_sha256": "s"}
    summary |= {"judged_by": "judge", "provenance": {"commit": "abc"}}
    job = ready(SweepRun("name", {"seed": "0"}, 0, "0123456789ab", "judge"), tmp_path)
    write_summary(job.identity.folder, summary)
    assert _fill_table(tmp_path / "sweeps" / "mine", [job])[0].where.endswith(str(job.identity.folder))
    (row,) = read_runs(tmp_path / "sweeps" / "mine")
    assert row.figures.get(ANGLE) == summary["judged"]["shared"]["errors"]["surface_angle"]["value"]
    assert row.figures["headline/requirements failed"] == headline(summary)["requirements failed"]
    assert row.figures["unseen/failures/non_finite_states"] == 24
    assert row.facts["broken_rollouts"] == "30rpm_unseen at frame 7"


def test_the_table_keeps_every_word_and_every_bit(tmp_path: Path):
    odd = {"command": 'train "a=b, c"\nd', "versions": "null"}
    training = {"steps": 5, "stopped_by": "steps", "loss": 0.1 + 0.2}
    runs = [run("0.10", 3, 2 / 3, facts=odd, training=training), lost("0.1", 0), run("0.2", 1, 1 / 3)]
    runs[0].choices.update({"scene": "null", "dataset": "1e3"})
    path = write_runs(tmp_path, runs)
    kept = read_runs(tmp_path)
    assert sorted(kept, key=str) == sorted(runs, key=str)
    table = path.read_bytes()
    assert write_runs(tmp_path, kept).read_bytes() == table


def test_a_job_failed_where_its_log_ends_so_and_one_that_is_done_again_replaces_its_row(tmp_path: Path):
    folder, root = tmp_path / "sweeps" / "mine", tmp_path
    failed, stopped = (ready(run(radius, 0, 1.0), root) for radius in ("0.1", "0.2"))
    (folder / "logs").mkdir(parents=True)
    (folder / failed.log_name).write_text("---- a life\nerror: it was cold\n---- another\nerror: the loss is lost\n")
    (folder / stopped.log_name).write_text("---- a life\nerror: it was cold\n---- another\nstopped at update 7\n")
    assert _fill_table(folder, [failed, stopped]) == {}
    assert [(row.run, row.reason) for row in read_runs(folder)] == [(failed.run, "the loss is lost")]
    summary = summary_of(flowing(SCENE, seed=3))
    summary |= {"judged_by": "j", "provenance": {}}
    write_summary(failed.identity.folder, summary)
    assert list(_fill_table(folder, [failed, stopped])) == [0]
    assert [(row.run, row.status) for row in read_runs(folder)] == [(failed.run, "finished")]


def test_a_finished_row_of_any_sweep_is_known_whatever_else_failed_or_is_damaged(tmp_path: Path, capsys):
    good, bad = run("0.08", 0, 1.0, training={"stopped_by": "steps"}), lost("0.1", 0)
    theirs, mine = tmp_path / "sweeps" / "theirs", tmp_path / "sweeps" / "mine"
    write_runs(theirs, [good, bad])  # as a clone has it
    damaged = tmp_path / "sweeps" / "one" / "runs.csv"
    damaged.parent.mkdir(parents=True)
    damaged.write_text("{\n[")
    jobs = [replace(ready(good, tmp_path), run="mine", choices={"boundary": "spheres"}), ready(bad, tmp_path)]
    assert list(_fill_table(mine, jobs)) == [0]
    assert f"not looked at: {damaged}" in capsys.readouterr().err
    # It has a row of its own here, like a run of this sweep.
    SweepFile("mine", "k", "train", "gran-bench", jobs).write(mine)
    stands = read_standing(mine)
    ((row,), others) = stands.counted, stands.others
    assert (row.run, row.choices, row.figures, others) == ("mine", jobs[0].choices, good.figures, [])
    assert row.facts["copied_from"] == f"theirs, {good.run}"
    assert [job.run for job in stands.waiting] == [bad.run]


@pytest.mark.parametrize("damage", ["no table", "header", "short row", "no number"])
def test_a_damaged_table_is_named(tmp_path: Path, damage: str):
    path = write_runs(tmp_path, [run("0.08", 0, 1.0)])
    header, row = path.read_text("utf-8").splitlines()
    texts = {
        "no table": "{\n[",
        "header": f"x{header}\n{row}\n",
        "short row": f"{header}\n{row.rpartition(',')[0]}\n",
        "no number": f"{header}\n{row.replace('80.0', 'many')}\n",
    }
    path.write_text(texts[damage], "utf-8")
    with pytest.raises(SweepFileError, match=rf"{re.escape(str(path))}.*delete it"):
        read_runs(tmp_path)


# ---- the table -------------------------------------------------------------------------------------------


def test_a_choice_has_the_mean_and_the_spread_of_its_seeds():
    runs = [run("0.08", 0, 1.0), run("0.08", 1, 3.0), run("0.1", 0, 5.0)]
    assert axes_of(runs) == ["model.radius"]
    _, _, first, second = shown_table(runs).splitlines()
    assert [cell.strip() for cell in first.split("|")[1:5]] == ["0.08", "2", "0", "4.00 ± 2.83"]
    assert [cell.strip() for cell in second.split("|")[1:5]] == ["0.1", "1", "0", "10.00"]
    assert best_choices(runs)["angle error floors"] == ("model.radius=0.08", 4.0)


def test_values_are_in_the_order_of_their_numbers():
    frame = runs_frame([run(radius, 0, 1.0) for radius in ("0.1", "0.08", "0.0625", "1e-1")])
    assert list(frame["model.radius"]) == ["0.0625", "0.08", "0.1", "1e-1"]


def test_a_failed_run_and_an_undefined_figure_stay_in_the_table_and_their_choice_is_not_the_best():
    undefined = run("0.2", 1, 1.0)
    del undefined.figures[ANGLE_FLOORS]
    runs = [run("0.08", 0, 0.5), lost("0.08", 1), run("0.1", 0, 5.0), run("0.2", 0, 1.0), undefined]
    _, _, failed, _, half = shown_table(runs).splitlines()
    assert [cell.strip() for cell in failed.split("|")[1:5]] == ["0.08", "1", "1", "1.00"]
    assert "undefined in 1" in half
    assert best_choices(runs)["angle error floors"] == ("model.radius=0.1", 10.0)


def test_a_newer_run_of_the_same_choices_takes_the_place_of_an_older_one():
    old = run("0.08", 0, 9.0)
    new = replace(run("0.08", 0, 1.0), key="f" * 12, ended_at="2026-01-01T00:00:00+00:00")
    stands = standing(None, [new, old])
    assert (stands.counted, stands.others) == ([new], [old])


# ---- which runs count --------------------------------------------------------------------------------------


def sweep_of(*runs: SweepRun) -> SweepFile:
    return SweepFile("mine", "k", "python -m gran_bench.train -m ...", "gran-bench", [job_of(one) for one in runs])


def made(one: SweepRun, made_with: str) -> SweepRun:
    return replace(one, facts=one.facts | {"made_with": made_with})


def test_a_run_with_another_key_than_its_job_does_not_count_and_the_job_waits():
    old, other = run("0.08", 0, 9.0), run("0.1", 0, 1.0)
    job = replace(old, key="f" * 12)
    stands = standing(sweep_of(job, other), [old, other])
    assert (stands.counted, stands.others) == ([other], [old])
    assert stands.waiting == [job_of(job)]
    assert standing(sweep_of(replace(old, judged_by="k")), [old]).counted == []


def test_runs_of_an_earlier_command_that_were_made_alike_count_though_the_last_one_does_not_list_them():
    contact, radial = (
        replace(run("0.08", 0, 1.0), run=model, key=model, choices={"model": model}) for model in ("contact", "radial")
    )
    stands = standing(sweep_of(radial), [contact, radial])
    assert (stands.counted, stands.others, stands.waiting) == ([contact, radial], [], [])


@pytest.mark.parametrize("earlier", [run("0.1", 1, 1.0), lost("0.1", 1)], ids=["finished", "failed"])
def test_a_run_of_an_earlier_command_that_was_made_otherwise_does_not_count(earlier: SweepRun):
    now, earlier = run("0.1", 0, 1.0), made(earlier, "other code, data, judge or budget")
    stands = standing(sweep_of(now), [earlier, now])
    assert (stands.counted, stands.others) == ([now], [earlier])


def test_a_finished_row_of_the_table_is_made_with_what_its_command_goes_by_now(tmp_path: Path):
    folder, old = tmp_path / "sweeps" / "mine", made(run("0.1", 0, 1.0, training={"stopped_by": "steps"}), "old")
    write_runs(folder, [old])
    (found,) = _fill_table(folder, [ready(old, tmp_path, "new")]).values()
    assert found.where == f"its row is in {folder}"
    assert read_runs(folder) == [made(old, "new")]


def test_choices_of_data_and_budget_within_one_command_may_change_data_and_budget():
    now, other = run("0.1", 0, 1.0), made(replace(run("0.1", 1, 1.0), judged_by="there"), "of a small drum")
    assert standing(sweep_of(now, other), [now, other]).others == []


def test_every_committed_run_counts():
    counts = {}
    for folder in sorted((RESULTS / "sweeps").glob("sweep_*")):
        stands = read_standing(folder)
        assert stands.others == []
        counts[folder.name] = len(stands.counted)
    assert counts["sweep_loss"] >= 9
    assert counts["sweep_radius"] >= 6
    assert counts["sweep_rollout"] >= 14


def test_every_page_counts_waiting_jobs_alike(tmp_path: Path):
    folder = tmp_path / "sweeps" / "sweep_radius"
    # A job waits although as many runs have ended as there are jobs: one is of another command.
    waits, now, earlier = run("0.2", 0, 1.0), run("0.1", 0, 1.0), run("0.08", 0, 1.0)
    sweep_in(folder, now, waits)
    write_runs(folder, [now, earlier])
    assert "2 runs finished, 0 failed, 1 wait" in report_sweep(folder).text
    assert "2 runs finished, 0 failed, 1 wait" in write_overview(tmp_path).read_text("utf-8")


def test_the_page_lists_what_does_not_count_and_what_the_clock_has_cut(tmp_path: Path):
    cut = {"steps": 1000, "planned_steps": 4000, "stopped_by": "time"}
    old, now = run("0.08", 0, 9.0), replace(run("0.08", 0, 1.0, training=cut), key="f" * 12)
    write_runs(tmp_path, [old])
    sweep_in(tmp_path, now)
    text = report_sweep(tmp_path).text
    assert "1 runs finished" in text
    assert f"- not counted, of other code, data or budget: `{old.run}-{old.key[:8]}`" in text
    assert f"- cut by the clock, goes on with more trainer.minutes: `{now.run}`" in text
