"""What a sweep keeps and says: every run in its table, failures too; the page can be made anew from small files."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from beds import flowing
from finished_runs import SCENE, broken, lost, run, summary_of, sweep_in

from gran_bench.run.run_file import (
    MADE,
    RunFile,
    SweepFileError,
    finished_run,
    read_runs,
    recorded_runs,
)
from gran_bench.run.summary import headline
from gran_bench.sweep.overview import write_overview
from gran_bench.sweep.standing import cut_short, read_standing, standing, unequal_updates
from gran_bench.sweep.sweep_file import SweepFile, SweepJob
from gran_bench.sweep.sweep_report import report_sweep
from gran_bench.sweep.table import axes_of, best_choices, choices_frame, newest, runs_frame, shown_table

RESULTS = Path(__file__).parents[1] / "results"


# ---- a run's file ----------------------------------------------------------------------------------------


def test_a_finished_run_leaves_a_few_kilobytes_that_hold_both_packings(tmp_path: Path):
    summary = summary_of(flowing(SCENE, seed=3), broken(7), failed_frames=(None, 7))
    summary["training"] |= {"loss": 0.1, "data_digest": "d", "model_sha256": "s"}
    summary |= {"judged_by": "judge", "provenance": {"commit": "abc"}}
    missed = headline(summary)["requirements failed"]
    left = finished_run("name", "0123456789ab", {"seed": "0"}, 0, summary, missed)
    path = left.write(tmp_path)
    assert path == tmp_path / "runs" / "name-01234567.json"
    assert path.stat().st_size < 10_000
    assert read_runs(tmp_path) == [left]
    assert left.figures["angle_error_deg"] == summary["judged"]["shared"]["errors"]["surface_angle"]["value"]
    assert left.figures["requirements_failed"] == missed
    assert left.packings["unseen"]["failures"]["non_finite_states"] == 24
    assert left.packings["unseen"]["errors"]["speed_w1"]["note"]
    assert left.facts["broken_rollouts"] == {"30rpm_unseen": 7}


def test_what_any_sweep_has_recorded_is_known_by_key_and_judge_but_a_failure_is_not(tmp_path: Path):
    good, bad = run("0.08", 0, 1.0), lost("0.1", 0)
    path = good.write(tmp_path / "sweeps" / "one")
    bad.write(tmp_path / "sweeps" / "two")
    assert recorded_runs(tmp_path) == ({(good.key, "j"): [path]}, [])


def test_a_damaged_file_of_one_sweep_hides_no_run_of_another(tmp_path: Path):
    good = run("0.08", 0, 1.0)
    path, damaged = good.write(tmp_path / "sweeps" / "two"), tmp_path / "sweeps" / "one" / "runs" / "x.json"
    damaged.parent.mkdir(parents=True)
    damaged.write_text("{")
    found, (complaint,) = recorded_runs(tmp_path)
    assert found == {(good.key, "j"): [path]}
    assert str(damaged) in str(complaint)


@pytest.mark.parametrize("text", ["{", "[]", '{"run": "x"}'])
def test_a_damaged_file_is_named(tmp_path: Path, text: str):
    path = tmp_path / "runs" / "x.json"
    path.parent.mkdir()
    path.write_text(text)
    with pytest.raises(SweepFileError, match=rf"{re.escape(str(path))}.*delete it"):
        read_runs(tmp_path)


# ---- the table -------------------------------------------------------------------------------------------


def test_a_choice_has_the_mean_and_the_spread_of_its_seeds():
    runs = [run("0.08", 0, 1.0), run("0.08", 1, 3.0), run("0.1", 0, 5.0)]
    assert axes_of(runs) == ["model.radius"]
    first, second = (row for _, row in choices_frame(runs).iterrows())
    assert (first["model.radius"], first["n"], first["failed"]) == ("0.08", 2, 0)
    assert first["angle_error_deg"] == 2.0
    assert first["angle_error_deg_spread"] == pytest.approx(2**0.5)
    assert (second["n"], second["angle_error_deg"]) == (1, 5.0)
    assert "4.00 ± 2.83" in shown_table(runs)
    assert best_choices(runs)["angle_error_deg"] == ("model.radius=0.08", 2.0)


def test_values_are_in_the_order_of_their_numbers():
    frame = runs_frame([run(radius, 0, 1.0) for radius in ("0.1", "0.08", "0.0625", "1e-1")])
    assert list(frame["model.radius"]) == ["0.0625", "0.08", "0.1", "1e-1"]


def test_a_failed_run_stays_in_the_table_and_its_choice_is_not_the_best():
    runs = [run("0.08", 0, 0.5), lost("0.08", 1), run("0.1", 0, 5.0)]
    first, _ = (row for _, row in choices_frame(runs).iterrows())
    assert (first["n"], first["failed"]) == (1, 1)
    assert best_choices(runs)["angle_error_deg"] == ("model.radius=0.1", 5.0)


def test_a_figure_that_is_undefined_in_one_seed_is_so_for_the_choice():
    undefined = run("0.08", 1, 1.0)
    undefined = replace(undefined, figures=undefined.figures | {"angle_error_floors": None})
    table = shown_table([run("0.08", 0, 1.0), undefined])
    assert "undefined in 1" in table


def test_a_newer_run_of_the_same_choices_takes_the_place_of_an_older_one():
    old = run("0.08", 0, 9.0)
    new = replace(run("0.08", 0, 1.0), key="f" * 12, ended_at="2026-01-01T00:00:00+00:00")
    assert newest([new, old]) == ([new], [old])


# ---- which runs count --------------------------------------------------------------------------------------


def job_of(one: RunFile) -> SweepJob:
    return SweepJob(one.run, one.key, one.judged_by, one.choices, one.seed)


def sweep_of(*runs: RunFile) -> SweepFile:
    return SweepFile("mine", "k", "python -m gran_bench.train -m ...", "gran-bench", [job_of(one) for one in runs])


def made(one: RunFile, code: str = "c1", budget: str = "2 min", **facts) -> RunFile:
    """A run that says what it was made with."""
    with_what = {"model": "contact", "training_code": {"contact": code, "radial": "r"}, "budget": budget}
    return replace(one, facts=one.facts | {MADE: with_what | {"judging_code": "j"}} | facts)


def test_a_run_with_another_key_than_its_job_does_not_count_and_the_job_waits():
    old, other = run("0.08", 0, 9.0), run("0.1", 0, 1.0)
    job = replace(old, key="f" * 12)
    stands = standing(sweep_of(job, other), [old, other])
    assert (stands.counted, stands.others) == ([other], [old])
    assert stands.waiting == [job_of(job)]
    assert standing(sweep_of(replace(old, judged_by="k")), [old]).counted == []


def test_runs_of_an_earlier_command_of_the_same_code_count_though_the_last_one_does_not_list_them():
    contact, radial = (
        replace(made(run("0.08", 0, 1.0)), run=model, key=model, choices={"model": model})
        for model in ("contact", "radial")
    )
    stands = standing(sweep_of(radial), [contact, radial])
    assert (stands.counted, stands.others, stands.waiting) == ([contact, radial], [], [])


@pytest.mark.parametrize(
    "earlier",
    [
        made(run("0.1", 1, 1.0), code="c0"),
        made(run("0.1", 1, 1.0), budget="4 min"),
        made(run("0.1", 1, 1.0), data_digest="other data"),
        replace(made(run("0.1", 1, 1.0)), judged_by="another judge"),
        replace(made(lost("0.1", 1)), facts=made(lost("0.1", 1), code="c0").facts),
    ],
    ids=["code", "budget", "data", "judge", "failed"],
)
def test_a_run_of_an_earlier_command_does_not_count_where_it_says_that_it_was_made_otherwise(earlier: RunFile):
    now = made(run("0.1", 0, 1.0, training={"stopped_by": "time"}), data_digest="data")
    stands = standing(sweep_of(now), [earlier, now])
    assert (stands.counted, stands.others) == ([now], [earlier])


def test_choices_of_data_and_budget_may_change_data_and_budget():
    now = made(run("0.1", 0, 1.0), data_digest="of the drum")
    chosen = {"scene": "drum_small", "trainer": "quick", "seed": "0"}
    other = made(run("0.1", 0, 1.0), budget="1 min", data_digest="of a small drum")
    other = replace(other, choices=chosen, judged_by="there")
    assert standing(sweep_of(now), [now, other]).others == []


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
    (folder / "runs" / waits.file_name).unlink()
    earlier.write(folder)
    assert "2 runs finished, 0 failed, 1 wait" in report_sweep(folder).text
    assert "2 runs finished, 0 failed, 1 wait" in write_overview(tmp_path).read_text("utf-8")


def test_the_page_says_where_equal_time_bought_unequal_updates_of_one_model(tmp_path: Path):
    def trained(model: str, seed: int, steps: int, stopped_by: str = "time") -> RunFile:
        one = run("0.1", seed, 1.0, name=f"{model}-{seed}", training={"steps": steps, "stopped_by": stopped_by})
        return replace(one, key=one.run, choices={"model": model, "seed": str(seed)})

    runs = [
        trained("contact", 0, 1000),
        trained("contact", 1, 1501),
        trained("radial", 0, 200),
        trained("radial", 1, 300),
    ]
    sweep_in(tmp_path, *runs)
    text = report_sweep(tmp_path).text
    assert "Equal processor time bought `contact` 1000 to 1501 updates: compare with care." in text
    assert "`radial` 200" not in text
    assert "| updates" in text
    assert unequal_updates([trained("contact", 0, 10, "steps"), trained("contact", 1, 90, "steps")]) == []


def test_the_page_lists_what_does_not_count(tmp_path: Path):
    old, now = run("0.08", 0, 9.0), replace(run("0.08", 0, 1.0), key="f" * 12)
    sweep_in(tmp_path, now)
    old.write(tmp_path)
    text = report_sweep(tmp_path).text
    assert "1 runs finished" in text
    assert f"- not counted, of other code, data or budget: `{old.file_name}`" in text


def test_the_page_says_where_the_clock_has_cut_budgets_of_steps(tmp_path: Path):
    def trained(seed: int, steps: int, planned: int | None) -> RunFile:
        stopped_by = "steps" if steps == planned else "time"
        training = {"steps": steps, "planned_steps": planned, "stopped_by": stopped_by}
        return replace(run("0.1", seed, 1.0, name=f"R{seed}", training=training), key=f"R{seed}")

    sweep_in(tmp_path, trained(0, 4000, 4000), trained(1, 1000, 4000), trained(2, 3000, 4000))
    text = report_sweep(tmp_path).text
    assert "The clock has cut the training of 2 of 3 runs, one after 25% of its updates: compare with care." in text
    assert "Equal processor time" not in text
    assert cut_short([trained(0, 4000, 4000), trained(1, 700, None)]) == []
