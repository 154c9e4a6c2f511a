"""A drum at −30 rpm is the mirror image of one at 30 rpm: in the DEM, in every metric and baseline, in data sets."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from beds import RADIUS, drum, flowing, inclined_bed, resting

from gran_bench.baselines import interpolated_statistics, neighbouring_speeds, rigid_rotation
from gran_bench.compose import checked_config, compose
from gran_bench.config import DatasetConfig, DemConfig, GenerateConfig, TrainConfig
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import DatasetError, split_cases
from gran_bench.dem.simulate import simulate
from gran_bench.evaluation.plan import Plan
from gran_bench.metrics import judge, summarise
from gran_bench.metrics.angle_of_repose import why_no_angle
from gran_bench.scene import Scene
from gran_bench.shipped import shipped_scene
from gran_bench.state import ParticleState, Trajectory
from gran_bench.surrogate.convolution.boundary import see_contacts, see_spheres

MIRROR, AXIAL = np.array([-1.0, 1.0, 1.0]), np.array([1.0, -1.0, -1.0])


def mirrored(run: Trajectory | ParticleState) -> Trajectory | ParticleState:
    """What a mirror across x = 0 shows; spins are axial vectors."""
    return replace(
        run,
        position=(run.position * MIRROR).astype(run.position.dtype),
        velocity=(run.velocity * MIRROR).astype(run.velocity.dtype),
        angular_velocity=(run.angular_velocity * AXIAL).astype(run.angular_velocity.dtype),
    )


def both(scene: Scene) -> tuple[Scene, Scene]:
    return scene.at_speed(30.0), scene.at_speed(-30.0)


def test_the_dem_mirrors():
    forwards, backwards = both(shipped_scene("drum_small", {"filling.count": 60}))
    rng, bed = np.random.default_rng(0), forwards.fresh_filling(0)
    bed = replace(bed, velocity=rng.normal(0, 0.5, bed.velocity.shape), time=forwards.start_time)
    dem, end = DemConfig(engine="numpy"), forwards.start_time + 0.05
    one = simulate(forwards, bed, end, dem=dem).final
    other = mirrored(simulate(backwards, mirrored(bed), end, dem=dem).final)
    assert np.abs(one.angular_velocity).max() > 1.0
    for field in ("position", "velocity", "angular_velocity"):
        assert np.abs(getattr(one, field) - getattr(other, field)).max() < 1e-8, field


def test_every_metric_of_the_mirror_image_is_the_same():
    forwards, backwards = both(drum())
    run = flowing(forwards, seed=2)
    one, other = summarise(run, forwards), summarise(mirrored(run), backwards)
    assert one.series["com_angle"].mean().defined
    for name, series in one.series.items():
        assert np.allclose(series.value, other.series[name].value, equal_nan=True, rtol=1e-6, atol=1e-6), name
    for field in ("sorted_speed", "layer_speed", "layer_velocity"):
        assert np.allclose(getattr(one, field), getattr(other, field), equal_nan=True, atol=1e-6), field
    # Along x, and only there, velocities have the other sign.
    assert np.allclose(one.sorted_component[0], -other.sorted_component[0][:, ::-1], atol=1e-6)
    assert np.allclose(one.sorted_component[1:], other.sorted_component[1:], atol=1e-6)
    same = {field: getattr(one.failures, field) for field in one.failures.__dataclass_fields__}
    assert {field: getattr(other.failures, field) for field in same} == same


def test_a_bed_that_has_climbed_with_a_backward_rotation_has_a_positive_angle():
    bed = inclined_bed(33.0) * MIRROR
    scene = drum(speed_rpm=-30.0, end_time=1.6)
    angles = {name: series.mean().number for name, series in summarise(resting(scene, bed), scene).series.items()
              if name.endswith("angle")}  # fmt: skip
    assert angles["surface_angle"] == pytest.approx(33.0, abs=1.0)
    assert angles["com_angle"] == pytest.approx(33.0, abs=1.5)


def test_beyond_the_critical_speed_there_is_no_angle_either_way():
    assert not why_no_angle(drum(-30.0))
    assert "at or above the critical speed of 43.4 rpm" in why_no_angle(drum(-50.0))


def test_the_judge_finds_no_distance_between_the_mirror_images():
    forwards, backwards = both(drum())
    runs = [flowing(forwards, seed=seed) for seed in (3, 4, 5)]
    ahead = judge(summarise(runs[0], forwards), [summarise(run, forwards) for run in runs[1:]], forwards)
    back = judge(
        summarise(mirrored(runs[0]), backwards), [summarise(mirrored(run), backwards) for run in runs[1:]], backwards
    )
    assert sum(row.error.defined for row in ahead.errors) > 5
    for one, other in zip(ahead.errors, back.errors, strict=True):
        assert (one.key, one.error.defined) == (other.key, other.error.defined)
        if one.error.defined:
            assert other.error.number == pytest.approx(one.error.number, rel=1e-4, abs=1e-6), one.key


def test_the_glued_bed_mirrors():
    forwards, backwards = both(drum(end_time=1.7))
    bed = inclined_bed(0.0)
    start = ParticleState(bed, np.zeros_like(bed), np.zeros_like(bed), np.full(len(bed), RADIUS), 1.5)
    one, other = rigid_rotation(forwards, start), mirrored(rigid_rotation(backwards, mirrored(start)))
    for field in ("position", "velocity", "angular_velocity"):
        assert np.abs(getattr(one, field) - getattr(other, field)).max() < 1e-5, field


@pytest.mark.parametrize("see", ["spheres", "contacts"])
def test_what_a_model_sees_of_the_walls_mirrors(see):
    forwards, backwards = both(drum())
    bed = torch.from_numpy(inclined_bed(20.0))
    flip = torch.from_numpy(MIRROR)

    def seen(scene: Scene, position: torch.Tensor) -> torch.Tensor:
        if see == "spheres":
            pairs = see_spheres(position, scene, 2.0, 0.06, 0.025)
        else:
            pairs = see_contacts(position, torch.zeros_like(position), scene, 2.0, 0.06)
        columns = [pairs.relative, *(a.index_select(0, pairs.source) for a in (pairs.normal, pairs.velocity))]
        near = pairs.near.index_select(0, pairs.query)[:, None]
        return torch.cat((near, *columns), dim=1)

    one, other = seen(forwards, bed), seen(backwards, bed * flip)
    assert one[:, 7:].abs().max() > 1.0  # the wall moves at 1.6 m/s
    other[:, 1:] *= flip.repeat(3)
    for rows in (one, other):
        rows.copy_(rows[np.lexsort(np.round(rows.numpy().T[:4], 9)[::-1])])
    assert torch.allclose(one, other, atol=1e-9)


# ---- data sets -----------------------------------------------------------------------------------------------


def train_config(*overrides: str) -> TrainConfig:
    return checked_config(compose("train", overrides), TrainConfig)


def test_a_data_set_may_turn_both_ways():
    speeds = ("dataset.training_speeds_rpm=[-20,-40,20]", "dataset.holdout_speeds_rpm=[-30]", "judge.speeds_rpm=[-30]")
    config = train_config(*speeds)
    split = split_cases(shipped_scene("drum"), config.dem, config.dataset)
    assert [case.scene.rotation.speeds_rpm[0] for case in split.all] == [-40.0, -30.0, -20.0, 20.0]
    assert split.holdout[0].label == "drum_-30rpm_seed0"
    plan = Plan(shipped_scene("drum"), config.dem, config.dataset, config.judge)
    assert plan.neighbours_rpm == (-40.0, -20.0)
    assert plan.speeds_rpm == [-30.0]


def test_the_step_is_checked_for_the_fastest_turn_either_way():
    """At −3000 rpm the wall hits a sphere at 160 m/s: as hard as at 3000 rpm."""
    made = {}
    for sign in ("", "-"):
        with pytest.raises(ValueError, match=r"dem\.time_step") as refused:
            checked_config(
                compose("generate", ["dem.time_step=0.0004", f"dataset.training_speeds_rpm=[20,{sign}3000]"]),
                GenerateConfig,
            )
        made[sign] = str(refused.value)
    assert made[""] == made["-"]


def test_a_speed_and_its_mirror_image_are_on_one_side_of_a_split():
    words = re.escape("dataset.holdout_speeds_rpm=[-20.0] has -20 rpm, whose mirror image dataset.training_speeds_rpm")
    with pytest.raises(ConfigError, match=words):
        train_config("dataset.holdout_speeds_rpm=[-20]")
    dataset = DatasetConfig(training_speeds_rpm=[20.0], holdout_speeds_rpm=[-20.0])
    with pytest.raises(DatasetError, match=r"-20 rpm, whose mirror image is in dataset.training_speeds_rpm"):
        split_cases(drum(), DemConfig(), dataset)
    with pytest.raises(ConfigError, match=r"judge.speeds_rpm=\[-30.0\] has -30 rpm, which no split"):
        train_config("judge.speeds_rpm=[-30]")


@pytest.mark.parametrize(
    ("speed", "training", "expected"),
    [
        (30.0, (20.0, 25.0, 40.0, 60.0), (25.0, 40.0)),
        (-30.0, (-20.0, -25.0, -40.0), (-40.0, -25.0)),
        (30.0, (-20.0, 40.0), None),
        (-30.0, (-40.0, 20.0, 60.0), None),
        (0.0, (-20.0, 20.0), (-20.0, 20.0)),
    ],
)
def test_only_speeds_of_one_sense_are_neighbours(speed, training, expected):
    assert neighbouring_speeds(speed, training) == expected


@pytest.mark.parametrize(
    ("training", "held_out", "rolled_out"),
    [
        ([20, 25, 35, 40, 50, 60], 30, [20, 25, 30, 35, 40]),
        ([10, 30], 20, [10, 20, 30]),
        ([-20, -40, 20], -30, [-40, -30, -20]),
        ([20, 25], 30, [20, 25, 30]),
    ],
)
def test_unless_chosen_the_speeds_around_the_judged_one_are_rolled_out(training, held_out, rolled_out):
    config = train_config(f"dataset.training_speeds_rpm={training}", f"dataset.holdout_speeds_rpm=[{held_out}]")
    assert Plan(shipped_scene("drum"), config.dem, config.dataset, config.judge).speeds_rpm == rolled_out


def test_statistics_are_not_interpolated_between_the_two_senses():
    ends = {rpm: summarise(flowing(drum(end_time=1.6)), drum(end_time=1.6)) for rpm in (-20.0, 40.0)}
    with pytest.raises(ValueError, match="speed_rpm=30 lies outside the training speeds -20, 40"):
        interpolated_statistics(30.0, ends)
    back = {-rpm: ends[-20.0] for rpm in (20.0, 40.0)}
    assert interpolated_statistics(-30.0, back).series["mean_speed"].mean() == ends[-20.0].series["mean_speed"].mean()
