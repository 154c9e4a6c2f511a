"""What a sweep says: its page, its figures, and over all sweeps what matters and by how much."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from finished_runs import lost, run, sweep_in

from gran_bench.report.command import report_command
from gran_bench.sweep.runs import SweepRun, read_sweep, write_runs
from gran_bench.sweep.sweep_report import chance_ratio, reaches, report_sweep, write_overview
from gran_bench.sweep.table import best_choices

# ---- the page --------------------------------------------------------------------------------------------


def test_the_page_says_what_it_is_judged_on_what_failed_and_what_waits(tmp_path: Path):
    folder = tmp_path / "results" / "sweeps" / "mine"
    sweep_in(folder, run("0.08", 0, 1.0), run("0.1", 0, 2.0), lost("0.15", 0), jobs=2)
    report = report_sweep(folder)
    text = (folder / "README.md").read_text("utf-8")
    assert text == report.text
    assert "2 runs finished, 1 failed, 2 wait; judged at 35 rpm, the validation speed" in text
    assert "the loss is not finite at update 7 (log: `logs/r+model.radius-0.15+seed-0-0.150.log`)" in text
    assert "waits 1" in text
    assert (len(report.failed), report.metrics["sweep/jobs waiting"]) == (1, 2.0)
    assert report.metrics["best/angle error floors"] == 2.0
    assert report.tags["best.angle error floors"] == "model.radius=0.08"
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
    assert "holds no record" in capsys.readouterr().err
    for name in ("one", "two"):
        sweep_in(tmp_path / "results" / "sweeps" / name, run("0.08", 0, 1.0))
    assert report_command([]) == 0
    said = capsys.readouterr()
    assert "# one" in said.out
    assert "# two" in said.out
    (tmp_path / "results" / "sweeps" / "one" / "runs.csv").write_text("{\n[")
    assert report_command(["results/sweeps/one", "results/sweeps/two"]) == 1
    said = capsys.readouterr()
    assert "runs.csv is no table of a sweep's runs" in said.err
    assert "# two" in said.out


# ---- over all sweeps -------------------------------------------------------------------------------------


def test_the_reach_of_a_key_is_from_its_best_mean_to_its_worst_beside_the_spread_of_seeds():
    runs = [run("0.08", 0, 1.0), run("0.08", 1, 2.0), run("0.1", 0, 4.0), run("0.1", 1, 5.0), lost("0.2", 0)]
    found = {reach.figure: reach for reach in reaches(runs)}
    angle = found["angle error, floors"]
    assert (angle.axis, angle.beside) == ("model.radius", "")
    assert angle.best == ("0.08", 3.0)
    assert angle.worst == ("0.1", 9.0)
    assert angle.factor == 3.0
    # Figures in floors are twice the angle, 2 and 4, 8 and 10, and seeds scatter by ½ ln² 2 and ½ ln² 1.25 in the log.
    deviation = (0.25 * (math.log(2.0) ** 2 + math.log(1.25) ** 2)) ** 0.5
    assert angle.chance == pytest.approx(math.exp(6.085 * deviation / 2**0.5), rel=1e-3)  # q of 2 means, 2 degrees
    assert not angle.counts
    assert angle.lost == ("0.2",)
    assert found["speed W1, floors"].factor == 1.0
    assert "centre-of-mass angle error, floors" not in found  # of which these runs say nothing


def test_the_best_and_the_worst_of_choices_that_do_not_matter_are_apart_by_chance():
    chosen = np.random.default_rng(0)
    rows = [[np.exp(0.3 * chosen.standard_normal(2)) for _ in range(5)] for _ in range(1000)]
    means = [[np.log(sample).mean() for sample in row] for row in rows]
    above = [max(m) - min(m) > math.log(chance_ratio(row)) for row, m in zip(rows, means, strict=True)]
    assert 0.03 < np.mean(above) < 0.07
    assert math.isnan(chance_ratio([np.array([1.0]), np.array([2.0])]))
    assert math.isnan(chance_ratio([np.array([0.0, 1.0]), np.array([2.0, 3.0])]))


def test_the_smallest_time_of_a_frame_is_named_only_where_every_key_changes_the_work():
    runs = [run("0.08", 0, 1.0), run("0.1", 0, 2.0)]
    assert "rollout ms per frame" in best_choices(runs)
    losses = [replace(one, choices={"loss": loss, "seed": "0"}) for one, loss in zip(runs, "ab", strict=True)]
    assert "rollout ms per frame" not in best_choices(losses)
    assert "angle error floors" in best_choices(losses)


def test_the_page_says_on_which_machines_its_runs_were_made(tmp_path: Path):
    def made(radius: str, hardware: str) -> SweepRun:
        return run(radius, 0, 1.0, facts={"hardware": hardware, "commit": "abc"})

    sweep_in(tmp_path / "one", made("0.08", "a fast one"), made("0.1", "a fast one"))
    assert "commit `abc`, 2025-01-01, a fast one*" in report_sweep(tmp_path / "one").text
    sweep_in(tmp_path / "two", made("0.08", "a fast one"), made("0.1", "a slow one"))
    text = report_sweep(tmp_path / "two").text
    assert "a fast one (1 runs); a slow one (1 runs)*" in text


def test_a_figure_that_cannot_be_drawn_costs_no_page(tmp_path: Path, monkeypatch):
    def refuse(*arguments) -> None:
        raise OSError("no space left")

    monkeypatch.setattr("gran_bench.sweep.sweep_report.sweep_axis", refuse)
    sweep_in(tmp_path, run("0.08", 0, 1.0))
    with pytest.raises(OSError, match="no space left"):
        report_sweep(tmp_path)
    assert (tmp_path / "README.md").exists()


def test_the_page_over_all_sweeps_keeps_a_persons_words_and_shows_every_sweep(tmp_path: Path, capsys):
    for name, radii in {"one": ("0.08", "0.1"), "two": ("0.1", "0.2")}.items():
        runs = [run(radius, seed, 50 * float(radius) + 0.1 * seed) for radius in radii for seed in (0, 1)]
        write_runs(tmp_path / "sweeps" / name, runs)
    (tmp_path / "sweeps" / "README.md").write_text("# Mine\n\nThe radius matters.\n")
    assert report_command(["--root", str(tmp_path)]) == 0
    page = (tmp_path / "sweeps" / "README.md").read_text()
    assert page.index("The radius matters.") < page.index("| sweep |") < page.index("## one") < page.index("## two")
    assert "| one | model.radius |  | angle error, floors | 0.08 (8.1) | 0.1 (10.1) | 1.25 |" in page
    assert "![model.radius](two/model.radius.png)" in page
    assert write_overview(tmp_path / "nothing") is None
