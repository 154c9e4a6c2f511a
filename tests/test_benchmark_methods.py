"""Who is compared: each method under a name of its own, a surrogate where it is fit, nothing that cannot be."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gran_bench.benchmark import jobs
from gran_bench.benchmark.command import model_files
from gran_bench.benchmark.contest import Contest, why_unfit
from gran_bench.compose import checked_config, compose
from gran_bench.config import BenchmarkConfig, EmulatorConfig
from gran_bench.config.rules import ConfigError
from gran_bench.dem.time_step import TimeStepError, choose_time_step, largest_allowed_step
from gran_bench.emulator import network
from gran_bench.emulator.network import Emulator
from gran_bench.run.pace import touching_bed
from gran_bench.scene import build_scene
from gran_bench.shipped import shipped_model, shipped_scene
from gran_bench.surrogate.checkpoint import ModelCard, load_card, save_model


def benchmark_config(*overrides: str) -> BenchmarkConfig:
    return checked_config(compose("benchmark", overrides), BenchmarkConfig)


def test_the_largest_allowed_step_is_allowed_and_the_next_is_not():
    scene = shipped_scene("drum").at_speed(30.0)
    step = largest_allowed_step(scene)
    assert choose_time_step(scene, step)[0] == step
    with pytest.raises(TimeStepError):
        choose_time_step(scene, scene.frame_interval / (round(scene.frame_interval / step) - 1))


@pytest.mark.parametrize(
    ("scene", "reason"),
    [
        (shipped_scene("drum").at_speed(30.0), ""),
        (shipped_scene("drum_long").at_speed(30.0), ""),
        (shipped_scene("drum_ramp"), ""),
        (shipped_scene("packing"), ""),
        (shipped_scene("drum").at_speed(35.0), "it was trained at 35 rpm"),
        (shipped_scene("drum_mu05").at_speed(30.0), "another material"),
        (shipped_scene("packing_polydisperse"), "spheres of one size"),
        (shipped_scene("hopper"), "another diameter"),
    ],
    ids=lambda value: getattr(value, "name", value),
)
def test_a_surrogate_answers_for_scenes_of_its_own_material_that_it_never_saw(scene, reason):
    card, _ = load_card(shipped_model())
    found = why_unfit(card, scene, packing_seed=1)
    assert reason in found
    assert bool(found) == bool(reason)


def test_a_surrogate_does_not_start_from_the_packing_that_it_was_trained_on():
    card, _ = load_card(shipped_model())
    assert "packing 0" in why_unfit(card, shipped_scene("drum").at_speed(30.0), packing_seed=0)


def test_every_kind_of_method_is_compared_under_a_name_of_its_own():
    contest = Contest(benchmark_config(), model_files(["shipped"]))
    names = [method.name for method in contest.methods]
    assert len(names) == len(set(names))
    assert contest.automatic == "DEM 0.2 ms"
    assert {
        *("DEM 0.2 ms", "DEM 0.4 ms", "DEM 1 ms", "DEM 0.4 ms, float32", "DEM 1.25 ms, E = 1e6 Pa"),
        *("DEM 0.2 ms, numpy engine", "holdout30rpm (shipped)", "interpolation, 25 and 35 rpm"),
        *("rigid rotation", "ballistic"),
    } <= set(names)
    same = [method for method in contest.methods if "coarse-grained" not in method.name]  # those have their own
    beds = [method.job["beds"] for method in same if "beds" in method.job]
    assert all(one == [str(contest.case.settled_path("data"))] for one in beds)
    assert [modulus for modulus, _ in contest.stiffness_methods["largest"]] == [1e7, 1e9, 7e10]
    assert [count for count, _ in contest.count_methods["holdout30rpm (shipped)"]] == [1000, 3000, 6000]


def test_a_scene_with_a_motion_of_its_own_has_no_interpolation_and_no_studies():
    contest = Contest(benchmark_config("scene=packing"), model_files(["shipped"]))
    assert next(m for m in contest.methods if m.name == "interpolation").unfit_because
    assert (contest.stiffness_methods, contest.count_methods) == ({}, {})


def test_studies_are_made_of_the_scenes_that_the_profile_names():
    assert Contest(benchmark_config("scene=drum_low"), {}).count_methods == {}
    chosen = Contest(benchmark_config("scene=drum_low", "profile.study_scenes=[drum_low]"), {})
    assert [count for count, _ in chosen.count_methods["DEM"]] == [1000, 3000, 6000]
    assert chosen.stiffness_methods


@pytest.fixture(scope="module")
def emulator_file(tmp_path_factory) -> Path:
    """An emulator that has learned nothing, as a run leaves one."""
    torch.manual_seed(0)
    config = EmulatorConfig(width=8, modes=4, blocks=1, committee=1, members=5)
    figures = ["surface_angle", "com_angle", "speed", "mean_speed"]
    scene = checked_config(compose("benchmark", []), BenchmarkConfig).scene
    origin = {"figures": figures, "data_seconds": 30.0, "seconds": 60.0, "packing_seed": 0}
    card = ModelCard(asdict(config), {}, asdict(scene), origin)
    path = tmp_path_factory.mktemp("stat") / "model.pt"
    save_model(path, Emulator(config, build_scene(scene), figures).state_dict(), card)
    return path


@pytest.mark.parametrize(
    ("override", "unfit", "beyond"),
    [
        ("scene=drum", "", ""),
        ("scene=drum_ramp", "", ""),
        ("scene=drum_low", "", "spheres 1500, trained at 3000 ±"),
        ("scene=packing", "the drum's radius, m, is None", ""),
        ("scene=hopper", "the drum's radius, m, is None", ""),
        ("scene.filling.diameter=0.045", "the sphere's diameter, m, is 0.045", ""),
        ("scene.material.density=3000", "another material", ""),
        ("dataset.unseen_packing_seed=0 dataset.packing_seed=1", "it was trained on packing 0", ""),
    ],
)
def test_an_emulator_gives_statistics_where_it_fits_and_says_what_it_did_not_learn(
    emulator_file, override, unfit, beyond
):
    contest = Contest(benchmark_config(*override.split()), {"stat": emulator_file})
    method = next(one for one in contest.methods if one.name == "stat")
    assert method.kind == "emulator"
    assert unfit in method.unfit_because
    assert bool(unfit) == bool(method.unfit_because)
    assert beyond in method.beyond
    assert bool(beyond) == bool(method.beyond)
    assert (method.data_seconds, method.training_seconds) == (30.0, 60.0)
    assert "stat" not in contest.count_methods


def test_an_emulator_claims_an_ensemble_from_the_bed_of_its_round(emulator_file, monkeypatch):
    monkeypatch.setattr(jobs, "read_settled", lambda path: (touching_bed(shipped_scene("drum")), None))
    contest = Contest(benchmark_config("scene.end_time=1.7"), {"stat": emulator_file})
    job = next(one for one in contest.methods if one.name == "stat").job
    monkeypatch.setattr(network, "settled_angles", lambda scene, bed: np.array([20.0, 22.0]))
    claims = jobs.emulated(job, 1001)
    frames = contest.scene.frame_count
    assert {key: claims[key].shape for key in ("surface_angle", "com_angle", "speed_w1")} == {
        "surface_angle": (5, frames),
        "com_angle": (5, frames),
        "speed_w1": (5, frames, 24),
    }
    assert np.array_equal(claims["speed_w1"], jobs.emulated(job, 1001)["speed_w1"])
    assert not np.array_equal(claims["speed_w1"], jobs.emulated(job, 1002)["speed_w1"])
    assert jobs.prepare(job)(2, 1001).trajectory is None


def test_rounds_take_turns_with_the_beds(monkeypatch):
    scene = shipped_scene("packing")
    bed = touching_bed(scene)
    beds = [replace(bed, position=bed.position + 0.1 * k) for k in range(3)]
    starts = [jobs._start(scene, beds, seed).position - bed.position for seed in range(1001, 1007)]
    assert [round(float(start.mean()), 3) for start in starts] == [0.2, 0.0, 0.1, 0.2, 0.0, 0.1]


def test_a_methods_key_follows_its_job_and_its_conditions_and_not_its_folders(tmp_path):
    here, there = (
        next(iter(Contest(benchmark_config(f"dataset.root={root}"), {}).methods)) for root in ("data", tmp_path)
    )
    assert here.key("code") == there.key("code")
    assert here.key("code") != here.key("other code")
    slower = Contest(benchmark_config("scene.material.friction=0.4"), {}).methods[0]
    assert slower.key("code") != here.key("code")
    assert replace(here, seconds=0.1).key("code") != here.key("code")


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("profile.step_multiples=[2]", ["profile.step_multiples=[2.0]", "add 1"]),
        ("profile.soft_moduli=[1e6,1e6]", ["profile.soft_moduli", "twice"]),
        ("profile.judged_rounds=9", ["profile.judged_rounds=9", "profile.rounds=4"]),
        ("profile.rounds=0", ["profile.rounds=0", "≥ 1"]),
        ("dataset.holdout_speeds_rpm=[]", ["dataset.holdout_speeds_rpm=[]", "one held-out speed"]),
        ("profile.rouns=3", ["profile.rouns", "profile.rounds"]),
    ],
)
def test_what_cannot_be_compared_is_refused(override, words):
    with pytest.raises(ConfigError) as refused:
        checked_config(compose("benchmark", [f"++{override}"]), BenchmarkConfig)
    assert all(word in str(refused.value) for word in words)
    assert "\n" not in str(refused.value)


def test_two_models_of_one_name_are_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"two files of the folder .*"):
        model_files([str(tmp_path / "model.pt"), str(tmp_path / "other.pt")])
