"""What a command says of its cost before the work, and that ``dry_run`` leaves nothing behind."""

import io
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from gran_bench import progress
from gran_bench.benchmark.command import run_benchmark
from gran_bench.compose import checked_config, compose
from gran_bench.config import (
    BenchmarkConfig,
    DatasetConfig,
    DemConfig,
    EvaluateConfig,
    RolloutConfig,
    StressConfig,
    TrainConfig,
)
from gran_bench.dataset import own_case, split_cases
from gran_bench.progress import Progress
from gran_bench.run import cost, experiment
from gran_bench.run.cost import Cost, data_cost, duration, flow_cost, makespan, softer
from gran_bench.run.experiment import run_evaluation, run_experiment
from gran_bench.run.pace import dem_pace, touching_bed
from gran_bench.shipped import shipped_model, shipped_scene
from gran_bench.stress.command import run_stress
from gran_bench.trainer import work_of_updates


def with_modulus(scene, modulus):
    """The scene of spheres and walls of another Young's modulus, Pa."""
    changed = replace(scene.material, youngs_modulus=modulus)
    return replace(scene, material=changed, wall_material=changed)


# ---- what is said ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("modulus", "frame"), [(1.0e7, 50), (6.3e10, 3954)])
def test_the_step_says_what_set_it(modulus, frame):
    scene = with_modulus(shipped_scene("drum"), modulus)
    spheres, step = flow_cost(scene, DemConfig()).lines
    assert "3000 spheres of 50 mm, 25 % of the room by volume" in spheres
    assert f", {frame} for a frame of 0.01 s = 0.14 √(d/g): the automatic step, 0.093 of the " in step
    assert f"s that a wave takes around the smallest sphere at E = {modulus:.3g} Pa" in step


def test_a_fast_drum_of_soft_spheres_is_bound_by_its_impacts():
    scene = with_modulus(shipped_scene("drum"), 1.0e5).at_speed(2000.0)
    assert "s of an impact at 105 m/s at E = 1e+05 Pa" in flow_cost(scene, DemConfig()).lines[1]


def test_a_step_that_is_asked_for_stands_beside_the_automatic_one():
    step = flow_cost(shipped_scene("drum"), DemConfig(time_step=1.0e-4)).lines[1]
    assert "100 for a frame of 0.01 s = 0.14 √(d/g): dem.time_step; 0.000201 s, 0.093 of the" in step


def test_stiff_spheres_name_the_price_and_what_softer_ones_change():
    (said,) = softer(with_modulus(shipped_scene("drum"), 6.3e10))
    assert "E = 6.3e10 Pa costs 79 times as much as 1e7" in said
    assert "at E = 1e8 Pa is 1.1 ± 0.3 ° steeper than at 1e7, and as fast within chance (results/verification)" in said
    assert softer(shipped_scene("drum")) == []


def test_values_in_another_unit_are_a_warning_each():
    scene = with_modulus(shipped_scene("drum"), 5.0e3)
    light = replace(scene.material, density=2.5)
    scene = replace(scene, material=light, filling=replace(scene.filling, diameter=6.0), drum_radius=500.0)
    assert flow_cost(scene, DemConfig()).lines[2:] == [
        "warning: scene.filling.diameter=6 m is unusual; lengths are in m",
        "warning: scene.material.density=2.5 kg/m³ is unusual; densities are in kg/m³",
        "warning: scene.material.youngs_modulus=5000 Pa is unusual; moduli are in Pa",
    ]
    assert len(flow_cost(shipped_scene("drum"), DemConfig()).lines) == 2


# ---- arithmetic, from a given pace -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("durations", "lanes", "ends"), [([3, 3, 3], 2, 6), ([4, 1, 1, 1], 2, 4), ([1, 2], 5, 2), ([], 2, 0)]
)
def test_jobs_that_take_turns_end_when_the_last_lane_does(durations, lanes, ends):
    assert makespan(durations, lanes) == ends


@pytest.mark.parametrize(("seconds", "said"), [(0.2, "0 s"), (89, "89 s"), (754, "13 min"), (12300, "3.4 h")])
def test_a_duration_has_two_figures(seconds, said):
    assert duration(seconds) == said


def test_data_take_beds_and_cases_at_the_pace_of_the_machine(monkeypatch, tmp_path):
    monkeypatch.setattr(cost, "dem_pace", lambda scene, dem: 1.0e-7)
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    scene = shipped_scene("drum")
    specs = split_cases(scene, DemConfig(), DatasetConfig()).all
    found = data_cost(scene, DemConfig(), specs, tmp_path, workers=2)
    # 3000 spheres, 1e-7 s a step of one: a bed of 1.5 s in 7500 steps and 1.6 times as long as that, a case in 20 000
    # steps; each process takes 2.5 s to start.
    assert found.seconds["data"] == pytest.approx(2.5 + 1.6 * 7500 * 3e-4 + 4 * (2.5 + 20_000 * 3e-4))
    assert "7 cases, 0 of them in" in found.lines[0]
    assert "7 to make, and 1 settled bed, 2 at a time" in found.lines[0]
    assert found.disk == pytest.approx(7 * 3000 * 401 * 36, rel=0.05)
    assert found.cheaper == ["dataset.workers=8 would make the same data in about 15 s instead of 40 s"]
    for spec in specs:
        spec.path(tmp_path).touch()
    assert data_cost(scene, DemConfig(), specs, tmp_path, workers=2).seconds == {}


def test_training_takes_as_many_frames_as_its_updates_look_ahead():
    assert sum(work_of_updates(RolloutConfig(frames=3), 100, None)) == 300
    grown = RolloutConfig(frames=2, final_frames=5, final_from=0.5)
    assert sum(work_of_updates(grown, 100, None)) == 50 * 2 + 50 * 5
    assert sum(work_of_updates(grown, 100, None, 90)) == 50


def test_costs_add_their_stages_and_disk_and_share_memory():
    both = Cost(["a"], {"data": 60.0}, 2e9, 1e9) + Cost(["b"], {"data": 30.0, "training": 600.0}, 1e9, 1e9, ["less"])
    assert str(both).splitlines()[:2] == ["a", "b"]
    assert str(both).splitlines()[2:] == [
        "takes about 12 min (data 1.5 min, training 10 min), 2 GB of memory, 2 GB of disk",
        "less",
    ]


@pytest.mark.parametrize("name", ["drum", "drum_slice", "hopper", "packing", "packing_binary", "collision"])
def test_the_sample_of_a_scene_touches_and_the_solver_takes_it(name):
    scene = shipped_scene(name)
    bed = touching_bed(scene)
    assert bed.count == scene.filling.count
    if not scene.filling.positions:
        gap = np.sort(np.linalg.norm(bed.position - bed.position[0], axis=1))[1]
        assert gap == pytest.approx(2.0 * scene.filling.largest_radius, rel=2e-3)
    assert dem_pace(scene, DemConfig()) > 0.0


def test_a_bed_that_is_denser_than_a_lattice_has_a_smaller_sample():
    scene = shipped_scene("drum_small")
    most = touching_bed(scene).count
    dense = replace(scene, filling=replace(scene.filling, count=4 * most + 3))
    assert touching_bed(dense).count in (most, 2 * most + 1)


# ---- dry_run ---------------------------------------------------------------------------------------------


@pytest.fixture
def empty(monkeypatch, tmp_path):
    """An empty folder, in which the command works."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_dry_run_of_a_training_says_all_and_makes_nothing(empty, capsys):
    config = checked_config(compose("train", ["+experiment=smoke", "dry_run=true"]), TrainConfig)
    assert run_experiment(config) == {}
    said = capsys.readouterr().out
    for words in ("scene drum_small: 300 spheres", "step: 0.0002 s, 50 for", "0 of them in", "training: contact, "):
        assert words in said
    assert "judging: 2 rollouts" in said
    assert "takes about" in said
    assert list(empty.iterdir()) == []


def test_a_job_of_a_sweep_does_not_tell_again_what_its_sweep_has_told(empty, capsys, monkeypatch):
    class Begun(Exception):
        """The work began."""

    def begin(*_: object) -> None:
        raise Begun

    monkeypatch.setattr(experiment, "ensure_cases", begin)
    for parent, told in ((None, True), ("0123", False)):
        config = checked_config(compose("train", ["+experiment=smoke"]), TrainConfig)
        config.tracking.parent = parent
        with pytest.raises(Begun):
            run_experiment(config)
        assert ("takes about" in capsys.readouterr().err) == told


def test_a_dry_run_of_an_evaluation_makes_nothing(empty, capsys):
    overrides = [f"checkpoint={shipped_model()}", "dry_run=true"]
    config = checked_config(compose("evaluate", overrides), EvaluateConfig)
    assert run_evaluation(config) == {}
    assert "judging: 6 rollouts of 401 frames" in capsys.readouterr().out
    assert list(empty.iterdir()) == []


def test_a_dry_run_of_a_benchmark_and_of_a_stress_test_make_nothing(empty, capsys):
    config = checked_config(
        compose(
            "benchmark",
            [
                "scene=drum_small",
                "dataset=small",
                "profile.single_multiples=[]",
                "profile.numpy_frames=0",
                "dry_run=true",
            ],
        ),
        BenchmarkConfig,
    )
    assert run_benchmark(config) == {}
    assert "timed runs to make" in capsys.readouterr().out
    assert run_stress(StressConfig(selection="short", dry_run=True)) == []
    assert "0 kept from an interrupted run; 2 at a time" in capsys.readouterr().out
    assert list(empty.iterdir()) == []


@pytest.mark.parametrize(
    "words",
    [
        "generate -m scene=drum_small,drum_slice dataset=small dry_run=true",
        "train -m +experiment=smoke seed=0,1 dry_run=true",
    ],
)
def test_a_dry_command_ends_well_and_leaves_no_file(empty, words):
    done = subprocess.run(
        [sys.executable, "-m", f"gran_bench.{words.split()[0]}", *words.split()[1:]],
        capture_output=True, text=True, check=False, timeout=180,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "takes about" in done.stdout
    assert list(empty.iterdir()) == []


def test_a_case_of_its_own_motion_counts_as_one(tmp_path):
    scene = shipped_scene("collision")
    found = data_cost(scene, DemConfig(), [own_case(scene, DemConfig(), DatasetConfig())], tmp_path, workers=2)
    assert found.lines[0].startswith("data: 1 case, 0 of them")


# ---- progress --------------------------------------------------------------------------------------------


def test_without_a_terminal_a_line_every_half_minute(monkeypatch):
    clock, log = [0.0], io.StringIO()
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(sys, "stderr", log)
    with Progress(total=40, desc="training", unit="update") as bar:
        for _ in range(40):
            clock[0] += 2.0
            bar.update()
            bar.refresh()
    lines = log.getvalue().splitlines()
    assert [line.split(",")[0] for line in lines] == ["training: 15 of 40 updates", "training: 30 of 40 updates"]
    assert "left" in lines[0]


def test_quick_work_and_hidden_progress_say_nothing_in_a_log(capsys):
    assert list(Progress(range(5), desc="rollout", unit="frame")) == [0, 1, 2, 3, 4]
    assert list(Progress(range(5), show=False)) == [0, 1, 2, 3, 4]
    assert capsys.readouterr().err == ""
