"""A ball under gravity: the times and heights of its bounces (MFiX-DEM verification manual, DEM01)."""

from __future__ import annotations

import numpy as np
import pytest

from gran_bench.scene import Plane

FLOOR = Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def test_a_falling_ball_is_exact_before_it_touches(laboratory, spheres, run):
    trajectory = run(laboratory(gravity=9.81), spheres([[0, 0, 1.0]], [[0.3, 0, 0]]), 2e-4, 2000, 500).trajectory
    t = trajectory.time
    assert trajectory.position[:, 0, 2] == pytest.approx(1.0 - 0.5 * 9.81 * t**2, abs=1e-12)
    assert trajectory.position[:, 0, 0] == pytest.approx(0.3 * t, abs=1e-12)


@pytest.mark.parametrize("engine", ["numba"], indirect=True)  # long; the engines agree to rounding
def test_each_bounce_keeps_the_square_of_the_restitution_of_the_height(laboratory, spheres, run):
    scene = laboratory(walls=(FLOOR,), gravity=9.81, restitution=0.8, youngs_modulus=1e8)
    trajectory = run(scene, spheres([[0, 0, 0.5]]), 2.5e-5, 32000, 40).trajectory
    height = trajectory.position[:, 0, 2] - 0.025
    apex = [k for k in range(1, len(height) - 1) if height[k - 1] < height[k] >= height[k + 1]]
    assert len(apex) >= 1
    assert height[apex[0]] == pytest.approx(0.8**2 * 0.475, rel=0.01)
    fall = np.sqrt(2.0 * 0.475 / 9.81)
    # Fall, contact of a few milliseconds, rise at e times the speed.
    assert trajectory.time[apex[0]] == pytest.approx(fall * 1.8, abs=4e-3)


@pytest.mark.parametrize("engine", ["numba"], indirect=True)  # long; the engines agree to rounding
def test_a_ball_comes_to_rest_where_the_floor_carries_it(laboratory, spheres, run):
    scene = laboratory(walls=(FLOOR,), gravity=9.81, restitution=0.3)
    result = run(scene, spheres([[0, 0, 0.03]]), 1e-4, 10000, 10000)
    assert abs(result.final.velocity[0, 2]) < 1e-6
    carried = 4.0 / 3.0 * (1e7 / (2.0 * 0.91)) * np.sqrt(0.025) * result.final.history.overlap[0] ** 1.5
    assert carried == pytest.approx(2500 * 4.0 / 3.0 * np.pi * 0.025**3 * 9.81, rel=1e-4)
