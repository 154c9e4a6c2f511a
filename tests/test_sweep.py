"""What a sweep keeps and says: every run in its table, failures too; the page can be made anew from small files."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from test_run_summary import SCENE, broken, flowing, summary_of

from gran_bench.front_page.command import report_command
from gran_bench.front_page.records import read_records
from gran_bench.run_summary import headline
from gran_bench.sweep.overview import reaches, write_overview
from gran_bench.sweep.run_file import (
    MADE,
    RunFile,
    SweepFileError,
    failed_run,
    finished_run,
    read_runs,
    recorded_runs,
)
from gran_bench.sweep.standing import read_standing, standing, unequal_updates
from gran_bench.sweep.sweep_file import SweepFile, SweepJob, read_sweep
from gran_bench.sweep.sweep_report import report_sweep
from gran_bench.sweep.table import axes_of, best_choices, choices_frame, newest, runs_frame, shown_table

RESULTS = Path(__file__).parents[1] / "results"


def run(radius: str, seed: int, angle: float, w1: float = 0.1, name: str = "", **changes) -> RunFile:
    """A finished run by hand, whose figures are easy to average."""
    figures = {
        "angle_error_deg": angle,
        "angle_error_floors": 2 * angle,
        "speed_w1_m_s": w1,
        "speed_w1_floors": 10 * w1,
        "position_error_10_frames_mm": 5.0,
        "ms_per_frame": 1e3 * float(radius),
        "training_minutes": 2.0,
        "requirements_failed": 1.0,
    }
    choices = {"model.radius": radius, "seed": str(seed)}
    values = {"figures": figures, "judged": {"rpm": 35.0, "as": "validation"}, "ended_at": "2025-01-01T00:00:00+00:00"}
    key = f"{radius}{seed}".replace(".", "").ljust(12, "0")
    name = name or f"r+model.radius-{radius}+seed-{seed}"
    return RunFile(name, key, "j", "finished", choices, seed, **values | changes)


def lost(radius: str, seed: int, reason: str = "the loss is not finite at update 7") -> RunFile:
    choices = {"model.radius": radius, "seed": str(seed)}
    facts = {"log": "logs/x.log"}
    return failed_run(f"r+model.radius-{radius}+seed-{seed}", f"{radius}{seed}", "j", choices, seed, reason, facts)


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
    assert recorded_runs(tmp_path) == {(good.key, "j"): path}


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
    assert "2.00 ± 1.41" in shown_table(runs)
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
    undefined = replace(undefined, figures=undefined.figures | {"angle_error_deg": None})
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
        run("0.1", 1, 1.0, training={"stopped_by": "time"}, facts={"provenance": {"command": "t trainer.minutes=4"}}),
        replace(made(lost("0.1", 1)), facts=made(lost("0.1", 1), code="c0").facts),
    ],
    ids=["code", "budget", "data", "judge", "minutes typed", "failed"],
)
def test_a_run_of_an_earlier_command_does_not_count_where_it_says_that_it_was_made_otherwise(earlier: RunFile):
    command = {"provenance": {"command": "t trainer.minutes=2"}}
    now = made(run("0.1", 0, 1.0, training={"stopped_by": "time"}), data_digest="data", **command)
    stands = standing(sweep_of(now), [earlier, now])
    assert (stands.counted, stands.others) == ([now], [earlier])


def test_choices_of_data_and_budget_may_change_data_and_budget():
    now = made(run("0.1", 0, 1.0), data_digest="of the drum")
    chosen = {"scene": "drum_small", "trainer": "quick", "seed": "0"}
    other = made(run("0.1", 0, 1.0), budget="1 min", data_digest="of a small drum")
    other = replace(other, choices=chosen, judged_by="there")
    assert standing(sweep_of(now), [now, other]).others == []


def test_where_code_is_not_said_runs_share_the_fate_of_others_of_that_code():
    old = {"provenance": {"code_digest": "old"}}
    replaced, orphan = run("0.08", 0, 9.0, facts=old), run("0.08", 1, 9.0, facts=old)
    now = replace(run("0.08", 0, 1.0, facts={"provenance": {"code_digest": "new"}}), key="f" * 12)
    assert standing(sweep_of(now), [replaced, orphan, now]).counted == [now]
    same_code = replace(now, facts=old)
    assert standing(sweep_of(same_code), [replaced, orphan, same_code]).counted == [same_code, orphan]


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
    assert read_records(tmp_path).waiting == {"sweep_radius": 1}


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
    assert re.search(rf"## Not counted, of other code or data\n\n.+\n\n- `{re.escape(old.file_name)}`", text)


# ---- the page --------------------------------------------------------------------------------------------


def sweep_in(folder: Path, *runs: RunFile, jobs: int = 0) -> None:
    for one in runs:
        one.write(folder)
    listed = [SweepJob(one.run, one.key, one.judged_by, one.choices, one.seed) for one in runs]
    listed += [SweepJob(f"waits {i}", f"w{i}", "j", {"model.radius": "0.2", "seed": str(i)}, i) for i in range(jobs)]
    SweepFile(folder.name, "k", "python -m gran_bench.train -m ...", "gran-bench", listed).write(folder)


def test_the_page_says_what_it_is_judged_on_what_failed_and_what_waits(tmp_path: Path):
    folder = tmp_path / "results" / "sweeps" / "mine"
    sweep_in(folder, run("0.08", 0, 1.0), run("0.1", 0, 2.0), lost("0.15", 0), jobs=2)
    report = report_sweep(folder)
    text = (folder / "README.md").read_text("utf-8")
    assert text == report.text
    assert "2 runs finished, 1 failed, 2 wait; judged at 35 rpm, the validation speed" in text
    assert "the loss is not finite at update 7 (log: `logs/x.log`)" in text
    assert "waits 1" in text
    assert (len(report.failed), len(report.waiting)) == (1, 2)
    assert report.metrics["best/angle_error_deg"] == 1.0
    assert report.tags["best.angle_error_deg"] == "model.radius=0.08"
    assert (folder / "model.radius.png").read_bytes().startswith(b"\x89PNG")
    assert len((folder / "runs.csv").read_text().splitlines()) == 4
    assert read_sweep(folder).jobs[-1].run == "waits 1"


def test_a_sweep_of_which_all_failed_has_a_page_and_a_figure_too(tmp_path: Path):
    folder = tmp_path / "sweeps" / "mine"
    sweep_in(folder, lost("0.08", 0), lost("0.1", 0))
    report = report_sweep(folder)
    assert "0 runs finished, 2 failed" in report.text
    assert (folder / "model.radius.png").exists()


def test_sweeps_are_reported_at_any_time_from_their_files_alone(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert report_command([]) == 2
    assert "holds no sweep" in capsys.readouterr().err
    for name in ("one", "two"):
        sweep_in(tmp_path / "results" / "sweeps" / name, run("0.08", 0, 1.0))
    assert report_command([]) == 0
    said = capsys.readouterr()
    assert "# one" in said.out
    assert "# two" in said.out
    (tmp_path / "results" / "sweeps" / "one" / "runs" / "x.json").write_text("{")
    assert report_command(["results/sweeps/one", "results/sweeps/two"]) == 1
    said = capsys.readouterr()
    assert "x.json is no file of a sweep's run" in said.err
    assert "# two" in said.out


def test_a_runs_file_is_plain_json(tmp_path: Path):
    path = run("0.08", 0, 1.0).write(tmp_path)
    assert json.loads(path.read_text("utf-8"))["choices"] == {"model.radius": "0.08", "seed": "0"}


# ---- over all sweeps -------------------------------------------------------------------------------------


def test_the_reach_of_a_key_is_from_its_best_mean_to_its_worst_beside_the_spread_of_seeds():
    runs = [run("0.08", 0, 1.0), run("0.08", 1, 2.0), run("0.1", 0, 4.0), run("0.1", 1, 5.0), lost("0.2", 0)]
    found = {reach.figure: reach for reach in reaches(runs)}
    angle = found["angle error, floors"]
    assert (angle.axis, angle.beside) == ("model.radius", "")
    assert angle.best == ("0.08", 3.0)
    assert angle.worst == ("0.1", 9.0)
    assert angle.factor == 3.0
    # Figures in floors are twice the angle: 2 and 4, 8 and 10; each pair scatters by √2.
    assert angle.spread == pytest.approx(2**0.5)
    assert angle.lost == ("0.2",)
    assert found["speed W1, floors"].factor == 1.0
    assert "centre-of-mass angle error, floors" not in found  # of which these runs say nothing


def test_the_page_over_all_sweeps_begins_with_a_persons_remarks_and_shows_every_sweep(tmp_path: Path, capsys):
    for name, radii in {"one": ("0.08", "0.1"), "two": ("0.1", "0.2")}.items():
        for radius in radii:
            run(radius, 0, 10 * float(radius)).write(tmp_path / "sweeps" / name)
    (tmp_path / "sweeps" / "remarks.md").write_text("The radius matters.\n")
    assert report_command(["--root", str(tmp_path)]) == 0
    page = (tmp_path / "sweeps" / "README.md").read_text()
    assert page.index("The radius matters.") < page.index("| sweep |") < page.index("## one") < page.index("## two")
    assert "| [one](one/README.md) |  | angle error, floors | 0.08 (1.6) | 0.1 (2) | 1.25 | one seed |" in page
    assert "![model.radius](two/model.radius.png)" in page
    assert write_overview(tmp_path / "nothing") is None
