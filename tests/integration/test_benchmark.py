"""The benchmark in a small drum: killed in the middle, gone on with, judged; a method that fails is a marked row."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import psutil
import pytest
import torch

from gran_bench.benchmark.command import run_benchmark
from gran_bench.benchmark.page import PAGE
from gran_bench.benchmark.results import RESULTS
from gran_bench.compose import checked_config, compose
from gran_bench.config import BenchmarkConfig, EmulatorConfig, SceneConfig
from gran_bench.emulator.network import Emulator
from gran_bench.scene import build_scene
from gran_bench.surrogate.checkpoint import ModelCard, save_model

OVERRIDES = [
    *("scene=drum_small", "scene.filling.count=120", "scene.container.length=0.25", "scene.end_time=1.8"),
    *("dataset.replicas=2", "dataset.training_speeds_rpm=[40,50]", "dataset.holdout_speeds_rpm=[45]"),
    # 10 ms a step: no contact survives that.
    *("profile.rounds=2", "profile.judged_rounds=2"),
    *("profile.step_multiples=[1,50]", "profile.single_multiples=[]", "profile.soft_moduli=[1e6]"),
    *("profile.soft_multiples=[1]", "profile.numpy_frames=1", "profile.stiffness=[1e7,1e8]", "profile.counts=[]"),
    *("profile.study_frames=2", "profile.study_rounds=1", "profile.study_scenes=[drum_small]"),
]


def measurements(folder: Path) -> dict[Path, str]:
    return {path: path.read_text("utf-8") for path in folder.rglob("round*.json")}


def emulator_file(folder: Path, scene: SceneConfig) -> Path:
    """An emulator of a scene that has learned nothing, as a run leaves one."""
    torch.manual_seed(0)
    config, figures = EmulatorConfig(width=8, modes=4, members=5), ["surface_angle", "com_angle", "speed"]
    weights = Emulator(config, build_scene(scene), figures).state_dict()
    save_model(folder / "model.pt", weights, ModelCard(asdict(config), {}, asdict(scene), {"figures": figures}))
    return folder / "model.pt"


@pytest.fixture(scope="module")
def benchmark(tmp_path_factory):
    """A benchmark that was killed after its first measurements and run again: what was there, and what was found."""
    folder = tmp_path_factory.mktemp("benchmark")
    overrides = [*OVERRIDES, f"root={folder}/results", f"dataset.root={folder}/data"]
    scene = checked_config(compose("benchmark", overrides), BenchmarkConfig).scene
    overrides.append(f"models=[shipped,{emulator_file(folder / 'stat', scene)}]")
    first = subprocess.Popen(
        [sys.executable, "-m", "gran_bench.benchmark", *overrides], stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    patience = time.monotonic() + 240
    while len(measurements(folder)) < 2:
        assert first.poll() is None, first.stdout.read().decode()
        assert time.monotonic() < patience
        time.sleep(0.01)
    workers = psutil.Process(first.pid).children()
    first.kill()
    first.communicate()
    _, alive = psutil.wait_procs(workers, timeout=30)
    before = measurements(folder)
    config = checked_config(compose("benchmark", overrides), BenchmarkConfig)
    return folder / "results", config, alive, before, run_benchmark(config)


def rows(found):
    return {row["name"]: row for row in found["methods"]}


def test_a_killed_benchmark_leaves_no_process_and_whole_files_that_the_next_keeps(benchmark):
    folder, _, alive, before, _ = benchmark
    assert alive == []
    after = measurements(folder)
    assert len(before) >= 2
    assert {path: after[path] for path in before} == before
    assert len(after) > len(before)
    assert all(json.loads(text)["wall_seconds"] > 0 for text in after.values())


def test_every_method_has_a_time_an_error_or_a_reason(benchmark):
    found = rows(benchmark[-1])
    for row in found.values():
        assert row["wall"] or row["failure"] or row["unfit_because"], row["name"]
        judged = row["floors"] is not None or row["statistics"] or row["failed"] or row["unfit_because"]
        assert judged or "numpy" in row["name"], row["name"]
    automatic = found["DEM 0.2 ms"]
    assert automatic["relative"]["median"] == pytest.approx(1.0)
    assert automatic["peak_bytes"] > automatic["own_bytes"] > 0
    assert automatic["floors"] < found["rigid rotation"]["floors"]
    surrogate = found["holdout30rpm (shipped)"]
    assert (surrogate["training_seconds"] > 600, surrogate["data_seconds"] > 10) == (True, True)
    assert found["interpolation, 40 and 50 rpm"]["data_seconds"] > 0
    assert found["DEM 0.2 ms, numpy engine"]["relative"]["median"] > 5


def test_an_emulator_is_judged_among_statistics_and_has_no_rank(benchmark):
    row = rows(benchmark[-1])["stat"]
    assert (row["kind"], row["floors"], row["failure"]) == ("emulator", None, "")
    assert row["wall"]["median"] < rows(benchmark[-1])["DEM 0.2 ms"]["wall"]["median"]
    assert row["statistics"]["speed_w1"]["members"] == 5
    assert row["statistics"]["speed_w1"]["mean_error"] > 1.0
    assert row["statistics"]["speed_w1"]["spread"] > 0.0


def test_a_coarse_grained_dem_starts_from_several_packings(benchmark):
    coarse = [row for name, row in rows(benchmark[-1]).items() if "coarse-grained" in name and not row["unfit_because"]]
    assert {row["packings"] for row in coarse} == {3}


def test_a_method_that_fails_is_a_marked_row(benchmark):
    failed = rows(benchmark[-1])["DEM 10 ms"]
    assert failed["failed"]
    assert failed["floors"] is None or failed["outside"]
    assert failed["failure"]
    assert failed["failure"][:40] in (benchmark[0] / PAGE).read_text("utf-8")


def test_stiffness_is_studied_and_figures_are_drawn(benchmark):
    folder, _, _, _, found = benchmark
    assert [point["at"] for point in found["stiffness"]["automatic"]] == [1e7, 1e8]
    assert all(point["wall"]["median"] > 0 for point in found["stiffness"]["automatic"])
    place = folder / "quick" / "drum_small"
    for name in ("time_error.png", "stiffness.png", "methods.csv", RESULTS):
        assert (place / name).stat().st_size > 500
    assert not list(place.rglob("*.npz"))


def test_a_finished_benchmark_measures_nothing_again_and_says_the_same(benchmark):
    folder, config, _, _, found = benchmark
    before = measurements(folder)
    again = run_benchmark(config)
    assert measurements(folder) == before
    assert again["methods"] == found["methods"]


def test_kept_results_are_told_anew_and_nothing_is_measured(benchmark):
    folder, config, _, _, found = benchmark
    before = measurements(folder)
    again = run_benchmark(replace(config, measure=False))
    assert measurements(folder) == before
    assert (again["methods"], again["reference"]) == (found["methods"], found["reference"])
    assert again["reference"]["accepted"] is None  # two replicas do not say how their errors scatter
