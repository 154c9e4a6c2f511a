"""Speed distributions: Wasserstein-1, definitions of velocity, components and layers."""

from __future__ import annotations

import numpy as np
import pytest
from beds import RADIUS, drum, flowing, inclined_bed, resting
from scipy.stats import wasserstein_distance

from gran_bench.metrics.angle_of_repose import SurfaceLine, surface_lines
from gran_bench.metrics.speeds import (
    depth_profile,
    layer_sums,
    sorted_frames,
    velocities,
    wasserstein,
    wasserstein_series,
)
from gran_bench.state import Trajectory

TIME = 1.5 + 0.01 * np.arange(20)


@pytest.mark.parametrize(("n", "m"), [(50, 50), (50, 73), (7, 1)])
def test_wasserstein_equals_an_independent_implementation(n, m):
    rng = np.random.default_rng(n)
    a, b = np.sort(rng.random(n)), np.sort(rng.random(m) ** 2)
    assert wasserstein(a, b) == pytest.approx(wasserstein_distance(a, b), abs=1e-12)


def test_a_shift_of_all_speeds_is_its_own_distance():
    speed = np.sort(np.random.default_rng(0).random(100))
    assert wasserstein(speed, speed + 0.25) == pytest.approx(0.25)
    assert np.isnan(wasserstein(speed, np.zeros(0)))


def test_the_distance_a_frame_ignores_which_sphere_has_which_speed():
    rng = np.random.default_rng(0)
    speed = rng.random((20, 30))
    shuffled = rng.permuted(speed, axis=1)
    assert wasserstein_series(TIME, sorted_frames(speed), TIME, sorted_frames(shuffled)).mean().number == 0.0


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_one_speed_that_is_not_finite_makes_its_state_invalid(bad):
    speed = np.random.default_rng(0).random((20, 30))
    broken = speed.copy()
    broken[3, 5] = bad
    series = wasserstein_series(TIME, sorted_frames(speed), TIME, sorted_frames(broken))
    assert np.flatnonzero(~series.valid).tolist() == [3]
    assert "1 of 20" in series.mean().note


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_state_that_is_not_finite_has_no_speeds_at_all(bad):
    ordered = sorted_frames(np.array([[3.0, 1.0, 2.0], [1.0, bad, 0.0]]))
    assert ordered[0].tolist() == [1.0, 2.0, 3.0]
    assert np.isnan(ordered[1]).all()


def test_mean_velocity_of_a_steady_motion_is_its_velocity_even_across_a_periodic_seam():
    scene = drum(periodic=True, length=0.2)
    time = 1.5 + 0.01 * np.arange(50)
    y = np.mod(0.08 + 0.7 * (time - 1.5) + 0.1, 0.2) - 0.1
    position = np.zeros((50, 1, 3))
    position[:, 0, 1] = y
    velocity = np.zeros_like(position)
    velocity[..., 1] = 0.7
    trajectory = Trajectory(time, position, velocity, None, np.full(1, RADIUS))
    assert np.abs(np.diff(y)).max() > 0.1  # it does cross the seam
    assert np.allclose(velocities(trajectory, "mean", scene.period)[..., 1], 0.7)


def test_means_do_not_give_instantaneous_velocities():
    still = resting(drum(), np.zeros((1, 3)), frames=3)
    mean = Trajectory(still.time, still.position, still.velocity, None, still.radius, velocity_kind="mean")
    with pytest.raises(ValueError, match="velocity_kind=mean"):
        velocities(mean, "instantaneous")
    with pytest.raises(ValueError, match="choose one of"):
        velocities(still, "median")


def test_layers_under_the_surface_have_their_own_speed():
    scene, angle = drum(), np.radians(30.0)
    bed = inclined_bed(30.0, depth=0.05)
    uphill = np.array([-np.cos(angle), 0.0, np.sin(angle)])
    normal = np.array([np.sin(angle), 0.0, np.cos(angle)])
    below = -0.05 - bed @ normal
    velocity = (below - 0.3)[:, None] * uphill  # downhill above, uphill 0.3 m under the top layer
    lines = surface_lines(bed[None], np.full(len(bed), RADIUS), scene)
    speed, along = depth_profile(layer_sums(bed[None], velocity[None], lines, scene))
    filled = np.isfinite(along)
    assert filled[:6].all()
    assert not filled[-1]
    assert along[0] == pytest.approx(-0.3, abs=0.01)
    assert np.all(np.diff(along[:6]) > 0.03)
    assert np.allclose(speed[:5], np.abs(along[:5]), atol=1e-3)


def test_a_layer_holds_what_is_near_the_middle_and_the_first_what_lies_on_the_line():
    scene, flat = drum(), SurfaceLine(0.0, 0.0, 0.0, 1.0, True)
    # On the line and half a diameter above it; a diameter and a half above (flying); too far along the surface.
    position = np.array([[[0.0, 0, -0.01], [0.0, 0, 0.025], [0.0, 0, 0.08], [0.31, 0, -0.01]]])
    velocity = np.array([[[-1.0, 0, 0], [-3.0, 0, 0], [-100.0, 0, 0], [-100.0, 0, 0]]])
    speed, along = depth_profile(layer_sums(position, velocity, [flat], scene))
    assert speed[0] == along[0] == pytest.approx(2.0)
    assert np.isnan(speed[1:]).all()


def test_layers_without_a_valid_surface_are_empty():
    scene = drum()
    trajectory = flowing(scene, frames=2)
    lines = surface_lines(trajectory.position, trajectory.radius, scene)
    assert not any(line.valid for line in lines)
    speed, _ = depth_profile(layer_sums(trajectory.position, trajectory.velocity, lines, scene))
    assert np.isnan(speed).all()
