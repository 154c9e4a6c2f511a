"""Who is compared: each method under a name of its own, a surrogate where it is fit, nothing that cannot be."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gran_bench.benchmark.command import model_files
from gran_bench.benchmark.contest import Contest, why_unfit
from gran_bench.compose import checked_config, compose
from gran_bench.config import BenchmarkConfig
from gran_bench.config.rules import ConfigError
from gran_bench.dem.time_step import TimeStepError, choose_time_step, largest_allowed_step
from gran_bench.shipped import shipped_model, shipped_scene
from gran_bench.surrogate.checkpoint import load_card


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
    assert {method.job["bed"] for method in same if "bed" in method.job} == {str(contest.case.settled_path("data"))}
    assert [modulus for modulus, _ in contest.stiffness_methods["largest"]] == [1e7, 1e8, 1e9, 7e10]
    assert [count for count, _ in contest.count_methods["holdout30rpm (shipped)"]] == [300, 1000, 3000, 6000]


def test_a_scene_with_a_motion_of_its_own_has_no_interpolation_and_no_studies():
    contest = Contest(benchmark_config("scene=packing"), model_files(["shipped"]))
    assert next(m for m in contest.methods if m.name == "interpolation").unfit_because
    assert (contest.stiffness_methods, contest.count_methods) == ({}, {})


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
