"""Baselines: free flight, a glued bed, and statistics between two speeds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from beds import RADIUS, drum, flowing, inclined_bed

from gran_bench.baselines import ballistic, interpolated_statistics, rigid_rotation
from gran_bench.metrics import judge, summarise
from gran_bench.metrics.angle_of_repose import center_of_mass_angles
from gran_bench.scene import Rotation
from gran_bench.state import ParticleState

SCENE = drum(end_time=1.9)


def settled(position, velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.0, 0.0)) -> ParticleState:
    fill = np.ones((len(position), 1))
    return ParticleState(np.asarray(position, float), fill * velocity, fill * spin, np.full(len(position), RADIUS), 1.5)


def test_free_flight_is_a_parabola_through_everything():
    start = settled([[0.0, 0.1, 0.2]], velocity=(0.5, 0.0, 1.0), spin=(0.0, 3.0, 0.0))
    run = ballistic(SCENE, start)
    assert run.frame_count == SCENE.frame_count == 41
    assert run.time[[0, -1]] == pytest.approx([1.5, 1.9])
    assert run.position[-1, 0] == pytest.approx([0.2, 0.1, 0.2 + 0.4 - 0.5 * 9.81 * 0.16], abs=1e-6)
    assert run.velocity[-1, 0] == pytest.approx([0.5, 0.0, 1.0 - 9.81 * 0.4], abs=1e-6)
    assert run.angular_velocity[-1, 0, 1] == 3.0
    assert np.array_equal(run.position[0], start.position.astype(np.float32))


def test_the_glued_bed_turns_by_the_walls_angle_and_climbs_as_the_metric_counts():
    start = settled(inclined_bed(0.0))
    run = rigid_rotation(SCENE, start)
    turned = np.degrees(SCENE.rotation.angle(1.5, 1.9))
    assert turned == pytest.approx(72.0)
    first, *_, last = np.degrees(center_of_mass_angles(run.position, run.radius, SCENE))
    assert last - first == pytest.approx(turned, abs=1e-3)
    distance = np.linalg.norm(run.position[:, :1] - run.position[:, 1:], axis=2)
    assert np.allclose(distance, distance[0], atol=1e-6)  # rigid


def test_the_glued_beds_velocity_is_the_derivative_of_its_position():
    ramp = replace(SCENE, rotation=Rotation((1.5, 1.9), (0.0, 60.0)), frame_interval=0.001)
    run = rigid_rotation(ramp, settled([[0.3, 0.0, -0.1]]))
    slope = np.gradient(run.position[:, 0].astype(float), run.time, axis=0)
    assert np.allclose(run.velocity[2:-2, 0], slope[2:-2], atol=2e-3)
    assert run.angular_velocity[-1, 0] == pytest.approx([0.0, 2.0 * np.pi, 0.0])


def test_the_settled_state_itself_is_kept():
    run = rigid_rotation(SCENE, settled([[0.3, 0.0, -0.1]]))
    assert not run.velocity[0].any()
    assert run.velocity[1].any()


def cases():
    """Two cases whose speeds differ by a factor, so that what lies between is known."""
    slow, fast = flowing(SCENE, seed=1), flowing(SCENE, seed=1)
    fast.velocity[:] *= 1.4
    return {25.0: summarise(slow, SCENE.at_speed(25.0)), 35.0: summarise(fast, SCENE.at_speed(35.0))}


def test_statistics_between_two_speeds_are_linear_in_the_speed():
    between = interpolated_statistics(30.0, cases())
    ends = cases()
    assert np.allclose(between.sorted_speed, 1.2 * ends[25.0].sorted_speed, rtol=1e-5)
    expected = 0.5 * (ends[25.0].series["com_angle"].value + ends[35.0].series["com_angle"].value)
    assert np.allclose(between.series["com_angle"].value, expected)
    quarter = interpolated_statistics(27.5, ends).series["mean_speed"].value
    assert np.allclose(quarter, 1.1 * ends[25.0].series["mean_speed"].value, rtol=1e-5)


def test_a_training_speed_gives_its_own_statistics():
    ends = cases()
    assert np.array_equal(interpolated_statistics(35.0, ends).sorted_speed, ends[35.0].sorted_speed)


def test_statistics_have_no_particles_and_the_judge_says_so():
    ends = cases()
    judgement = judge(interpolated_statistics(30.0, ends), list(ends.values()), SCENE)
    assert judgement.failures is None
    assert "without particles" in judgement.error("position_10").error.note
    assert judgement.error("speed_w1").error.defined
    assert not any(row.key == "none_outside" for row in judgement.requirements)


def test_an_angle_that_one_neighbour_lacks_is_undefined_between_them():
    run = flowing(SCENE, seed=1)
    ends = {40.0: summarise(run, SCENE.at_speed(40.0)), 50.0: summarise(run, SCENE.at_speed(50.0))}
    assert "critical speed" in interpolated_statistics(42.0, ends).series["com_angle"].mean().note


def test_nothing_is_extrapolated_and_nothing_unlike_is_mixed():
    with pytest.raises(ValueError, match="outside the training speeds 25, 35"):
        interpolated_statistics(40.0, cases())
    mixed = cases()
    mixed[35.0] = replace(mixed[35.0], velocity_kind="mean")
    with pytest.raises(ValueError, match="one velocity_kind"):
        interpolated_statistics(30.0, mixed)
    other = cases()
    other[35.0] = summarise(flowing(SCENE, spheres=50), SCENE)
    with pytest.raises(ValueError, match="one scene"):
        interpolated_statistics(30.0, other)
