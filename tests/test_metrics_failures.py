"""Overlap, escapes, values that are not finite, energy, mixing and position errors: each against a hand calculation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from beds import RADIUS, drum, flowing, inclined_bed, resting

from gran_bench.metrics import judge, summarise
from gran_bench.metrics.bed import (
    mixing,
    overlap_series,
    pair_overlaps,
    rotational_energy,
    sphere_masses,
    translational_energy,
)
from gran_bench.metrics.outside import count_failures
from gran_bench.metrics.position_error import (
    divergence_horizon,
    mean_spread,
    separation,
    short_horizon_errors,
    spread_starts,
)
from gran_bench.scene import Plane


def test_overlap_of_two_spheres_and_across_a_periodic_seam():
    pair = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.049]])
    assert pair_overlaps(pair, np.full(2, RADIUS)) == pytest.approx([0.001])
    assert len(pair_overlaps(pair * 2, np.full(2, RADIUS))) == 0
    seam = np.array([[0.0, -0.099, 0.0], [0.0, 0.053, 0.0]])
    assert pair_overlaps(seam, np.full(2, RADIUS), period=0.2) == pytest.approx([0.002])


def test_overlap_series_has_pairs_and_walls_and_zero_where_nothing_touches():
    scene = drum()
    position = np.zeros((2, 3, 3))
    position[0] = [[0.0, 0.0, -0.477], [0.0, 0.0, -0.429], [0.0, 0.476, 0.0]]  # 2 mm in a wall and in a pair; 1 mm
    position[1] = [[0.0, 0.0, -0.3], [0.0, 0.0, 0.0], [0.0, 0.3, 0.0]]
    trajectory = resting(scene, position[0], frames=2)
    trajectory.position[1] = position[1]
    series = overlap_series(trajectory, scene)
    assert series["overlap_mean"].value == pytest.approx([0.002, 0.0], abs=1e-7)
    assert series["wall_overlap_mean"].value == pytest.approx([0.0015, 0.0], abs=1e-7)
    assert series["wall_overlap_max"].value == pytest.approx([0.002, 0.0], abs=1e-7)


def test_the_engines_own_overlap_is_preferred():
    scene = drum()
    names = ("overlap_mean", "overlap_max", "wall_overlap_mean", "wall_overlap_max")
    measured = {name: np.full(2, 1e-4 * i) for i, name in enumerate(names)}
    trajectory = replace(resting(scene, inclined_bed(0.0), frames=2), diagnostics=measured)
    assert {name: series.value[0] for name, series in overlap_series(trajectory, scene).items()} == {
        name: value[0] for name, value in measured.items()
    }


def test_escapes_are_counted_by_how_far():
    scene = drum(end_time=1.52)  # three states
    position = np.array([[0.0, 0.0, -0.474], [0.0, 0.0, 0.479], [0.482, 0.0, 0.0], [0.0, 0.51, 0.0]])
    count = count_failures(resting(scene, position), scene)
    assert (count.outside, count.outside_tolerated, count.outside_radius) == (9, 6, 3)
    assert count.outside_spheres == 1
    assert count.farthest == pytest.approx(0.035, abs=1e-6)
    assert not count.diverged
    assert count.share(count.outside) == 75.0


def test_without_end_caps_nothing_is_outside_along_the_axis():
    scene = drum(periodic=True)
    assert not any(isinstance(wall, Plane) for wall in scene.walls)
    count = count_failures(resting(scene, np.array([[0.0, 0.499, 0.0]]), frames=2), scene)
    assert count.outside == 0


def test_values_that_are_not_finite_are_counted_and_not_taken_for_inside_or_outside():
    scene = drum(end_time=1.6)
    trajectory = resting(scene, inclined_bed(0.0))
    trajectory.position[3:, 0] = np.nan
    trajectory.velocity[5, 1] = np.inf
    trajectory.angular_velocity[1, 2] = np.nan
    count = count_failures(trajectory, scene)
    assert count.non_finite_states == 9
    assert count.non_finite_sphere_states == 8 + 1 + 1
    assert count.first_non_finite == pytest.approx(1.51)
    assert count.diverged
    assert (count.outside, count.farthest) == (0, 0.0)


def test_a_sphere_that_is_not_finite_does_not_hide_another_that_is_outside():
    scene = drum(end_time=1.51)
    trajectory = resting(scene, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.6]]))
    trajectory.position[:, 0] = np.nan
    count = count_failures(trajectory, scene)
    assert (count.outside_radius, count.non_finite_sphere_states) == (2, 2)
    assert count.farthest == pytest.approx(0.125, abs=1e-6)


def test_a_rollout_that_ended_early_has_diverged():
    scene = drum()
    assert count_failures(resting(scene, inclined_bed(0.0)[:5], frames=3), scene).diverged


def test_energy_of_one_sphere():
    mass = sphere_masses(np.array([RADIUS]), 2500.0)
    assert mass == pytest.approx([2500.0 * 4 / 3 * np.pi * RADIUS**3])
    one, scene = resting(drum(), np.zeros((1, 3)), frames=1), drum()
    moving = replace(one, velocity=[[[3.0, 0.0, 4.0]]], angular_velocity=[[[3.0, 0.0, 4.0]]])
    assert translational_energy(moving, scene).value == pytest.approx(12.5 * mass)
    assert rotational_energy(moving, scene).value == pytest.approx(5.0 * mass * RADIUS**2)
    assert "no spin" in rotational_energy(replace(one, angular_velocity=None), scene).mean().note


def test_mixing_runs_from_two_halves_to_random():
    scene = drum()
    bed = inclined_bed(0.0)
    trajectory = resting(scene, bed, frames=3)
    trajectory.position[1] = np.random.default_rng(0).permutation(bed)
    trajectory.position[2, 0] = np.nan
    entropy = mixing(trajectory, scene)
    assert entropy.value[0] < 0.1
    assert 0.95 < entropy.value[1] <= 1.0
    assert np.isnan(entropy.value[2])


def test_separation_is_to_the_nearest_image():
    a, b = np.zeros((1, 2, 3)), np.zeros((1, 2, 3))
    a[0, :, 1], b[0, :, 1] = 0.095, -0.095
    assert separation(a, b) == pytest.approx([0.19])
    assert separation(a, b, period=0.2) == pytest.approx([0.01])


def test_spread_and_horizon_of_replicas():
    base = np.zeros((5, 4, 3))
    drift = base.copy()
    drift[..., 0] = np.array([0.0, 0.001, 0.004, 0.006, 0.02])[:, None]
    spread = mean_spread([base, drift, base])
    assert spread == pytest.approx(np.array([0.0, 0.001, 0.004, 0.006, 0.02]) * 2 / 3)
    assert divergence_horizon(spread, 0.05) == 4  # the first beyond 5 mm
    assert divergence_horizon(spread, 0.5) is None
    with pytest.raises(ValueError, match="two or more"):
        mean_spread([base])


def test_short_horizon_errors_of_a_model_that_stands_still():
    scene = drum()
    truth = resting(scene, np.zeros((4, 3)), frames=30)
    truth.position[..., 0] = 0.001 * np.arange(30)[:, None]
    errors = short_horizon_errors(
        lambda start, frames: np.repeat(truth.position[start : start + 1], frames, axis=0), truth, [0, 7, 19]
    )
    assert {k: e.number for k, e in errors.items()} == pytest.approx({1: 0.001, 3: 0.003, 10: 0.01}, rel=1e-5)


def test_a_prediction_that_is_not_finite_is_a_failure_and_not_left_out():
    truth = flowing(drum(), frames=30)

    def predict(start, frames):
        future = truth.position[start + 1 : start + 1 + frames].copy()
        if start == 7:
            future[2:] = np.nan
        return future

    errors = short_horizon_errors(predict, truth, [0, 7])
    assert errors[1].number == 0.0
    assert not errors[3].defined
    assert "1 of 2 starts, first from frame 7" in errors[3].note


def test_starts_must_leave_room_for_the_horizon():
    truth = flowing(drum(), frames=30)
    with pytest.raises(ValueError, match="0 to 19"):
        short_horizon_errors(lambda start, frames: truth.position, truth, [20])
    assert spread_starts(401, 20)[0] == 0
    assert spread_starts(401, 20)[-1] == 390
    assert len(spread_starts(401, 20)) == 20
    assert spread_starts(13, 20) == [0, 1, 2]
    with pytest.raises(ValueError, match="too few"):
        spread_starts(10, 5)


def test_a_flow_that_is_wild_but_finite_is_finite_in_every_figure_and_in_the_count():
    scene = drum(end_time=1.6)
    wild, calm = flowing(scene, seed=3), [flowing(scene, seed=1), flowing(scene, seed=2)]
    wild.position[4:, 0] = np.float32(3e38)  # the square of each is beyond single precision
    wild.velocity[4:, 0] = np.float32(-3e38)
    wild.angular_velocity[4:, 0] = np.float32(3e38)
    for kind in ("instantaneous", "mean"):
        candidate = summarise(wild, scene, kind)
        assert candidate.failures.non_finite_states == 0
        assert np.isfinite(candidate.sorted_speed).all()
        for name in ("mean_speed", "translational_energy", "rotational_energy", "mixing", "center_height"):
            assert candidate.series[name].valid.all(), name
        judgement = judge(candidate, [summarise(run, scene, kind) for run in calm], scene)
        found = {row.key: row for row in judgement.requirements}
        assert found["all_finite"].verdict == "pass"
        assert found["speed_w1"].verdict == "fail"
        assert found["speed_w1"].figure.number > 1e34
        assert not any("not finite" in row.error.note for row in judgement.errors)


def test_what_the_soft_walls_of_the_dem_let_in_stands_beside_what_a_model_has_outside():
    scene = drum(end_time=1.52)
    touching, escaped = (np.array([[0.0, 0.0, -0.474], [0.0, 0.0, z]]) for z in (0.476, 0.51))
    replicas = [resting(scene, touching), resting(scene, touching * [1.0, 1.0, 0.9])]
    lines = str(judge(resting(scene, escaped), replicas, scene))
    assert "reach into a wall: 50 % of sphere states (of the DEM, whose walls are soft: 25 %)" in lines
    assert "3 by > r (1 sphere)" in lines
