"""Models compared at equal training time: a table and a picture of rows by hand, whose figures are easy to average."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from finished_runs import lost, run, sweep_in

from gran_bench.sweep.models_page import compares_models, failures, write_models
from gran_bench.sweep.runs import SweepFileError, SweepRun
from gran_bench.sweep.side_by_side import FILE, SideBySide, read_side_by_side
from gran_bench.sweep.sweep_report import report_sweep
from gran_bench.sweep.table import read_standing

RANKED = ["com_angle", "speed_w1"]


def model(name: str, seed: int, com: float | None, w1: float, outside: float = 0.0) -> SweepRun:
    figures = {"shared/floors/com_angle": com, "shared/floors/speed_w1": w1, "headline/rollout ms per frame": 7.0}
    figures |= {"position_error/1_frames": 1e-4 * w1, "position_error/10_frames": 1e-3 * w1}
    figures |= {"shared/failures/outside_spheres": outside, "shared/failures/non_finite_states": 0.0}
    figures = {key: value for key, value in figures.items() if value is not None}
    facts = {"judged": "validation, 35 rpm", "made_with": "this", "budget": "10 min", "scene": "drum_short"}
    choices, training = {"model": name, "seed": str(seed)}, {"parameters": 8072, "steps": 100}
    one = run("0.1", seed, 1.0, name=f"{name}-{seed}", figures=figures, facts=facts, training=training)
    return replace(one, key=f"{name}{seed}", choices=choices)


def measured(folder: Path) -> None:
    error = {"1_frames": 5e-5, "3_frames": 2e-4, "10_frames": 1e-3}
    beside = SideBySide("k", {"contact0": 3.0, "radial0": 20.0}, 2.0, error, 10, 400, RANKED)
    (folder / FILE).write_text(json.dumps(asdict(beside)), "utf-8")


def cells(page: str, first: str) -> list[str]:
    (line,) = (line for line in page.splitlines() if line.startswith(f"| {first} |"))
    return [cell.strip() for cell in line.split("|")[2:-1]]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A sweep of two models that finished, of which one is undefined once, and one that failed."""
    folder, died = tmp_path / "results" / "sweeps" / "models", lost("0.1", 0, "the loss is not finite at update 7")
    died = replace(died, run="gns-0", key="gns0", choices={"model": "gns", "seed": "0"})
    rows = [model("radial", 0, None, 9.0, outside=12.0), model("radial", 1, 8.0, 2.0), died]
    sweep_in(folder, *rows, model("contact", 0, 3.0, 2.0), model("contact", 1, 1.0, 5.0), jobs=1)
    measured(folder)
    return folder


def test_the_page_holds_each_models_errors_in_floors_its_time_and_its_failures(folder: Path):
    report = report_sweep(folder)
    page = (folder.parents[1] / "models" / "README.md").read_text("utf-8")
    # The worst of each run first, then the mean over seeds: 3 and 5.
    assert cells(page, "`contact`") == [
        "8072", "3.00", "7.00 ± 4.24", "3.50 ± 2.12", "4.00 ± 1.41", "100 ± 0", "2", "0",
    ]  # fmt: skip
    assert cells(page, "`radial`")[1] == "20.00"
    assert cells(page, "`radial`")[4] == "undefined in 1, at least 8.50 ± 0.71"
    assert cells(page, "`radial`")[-1] == "1 with up to 12 spheres outside"
    assert cells(page, "`gns`")[-1] == "1 without a result"
    assert cells(page, "*DEM*")[1:5] == ["2.00", "1", "1", "1"]
    assert page.index("`contact` |") < page.index("`radial` |")
    assert "4 runs finished, 1 failed, 1 wait; each trained 10 min of processor time in drum_short" in page
    assert "judged at 35 rpm, the validation speed" in page
    assert "400 frames, floors" in page
    assert "0.05 mm, 1 mm" in page
    assert "- failed: `gns-0`: the loss is not finite at update 7" in page
    picture = folder.parents[1] / "models" / "time_error.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert picture in report.paths


def test_what_people_wrote_on_the_page_stays(folder: Path):
    (page, _) = write_models(folder, read_standing(folder))
    page.write_text(page.read_text("utf-8").replace("time\n", "time\n\nThe contact network wins.\n", 1), "utf-8")
    assert "The contact network wins.\n\n<!-- models -->" in write_models(folder, read_standing(folder))[0].read_text()


def test_without_measurements_side_by_side_times_are_of_the_runs_and_near_errors_have_no_floor(folder: Path):
    (folder / FILE).unlink()
    page = write_models(folder, read_standing(folder))[0].read_text("utf-8")
    assert cells(page, "`contact`")[1:4] == ["7.00", "undefined in 2", "undefined in 2"]
    assert "in turns" not in page


def test_damaged_measurements_are_named(folder: Path):
    (folder / FILE).write_text("{")
    with pytest.raises(SweepFileError, match=r"side_by_side\.json holds no measurements.*delete it"):
        read_side_by_side(folder)


def test_a_rollout_that_is_not_finite_is_counted_once(folder: Path):
    one = model("radial", 0, None, 9.0)
    one.figures["shared/failures/non_finite_states"] = 300.0
    one.facts["broken_rollouts"] = "35rpm at frame 100"
    assert failures([one, model("radial", 1, 8.0, 2.0)]) == "1 not finite"


def test_only_sweeps_of_the_recipe_have_the_page():
    names = ("models", "models+trainer.minutes-2", "models_of_mine", "sweep_loss")
    assert [compares_models(Path("results/sweeps") / name) for name in names] == [True, True, False, False]
