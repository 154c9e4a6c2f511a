"""A closed system keeps its momentum and its angular momentum, also in soft, rough, spinning contacts."""

from __future__ import annotations

import numpy as np
import pytest

from gran_bench.dem.contact import sphere_mass


def momenta(position, velocity, spin, radius):
    """Linear momentum, and angular momentum about the origin with that of the spins."""
    mass = sphere_mass(2500.0, radius)[:, None]
    own = 0.4 * mass * radius[:, None] ** 2 * spin
    return (mass * velocity).sum(axis=0), (mass * np.cross(position, velocity) + own).sum(axis=0)


@pytest.mark.parametrize("radius", [[0.025, 0.025, 0.025], [0.02, 0.03, 0.025]])
@pytest.mark.parametrize("rolling_friction", [0.0, 0.2])
def test_momentum_and_angular_momentum_of_a_closed_system(laboratory, spheres, run, radius, rolling_friction):
    scene = laboratory(restitution=0.5, friction=0.5, rolling_friction=rolling_friction, youngs_modulus=1e6)
    state = spheres(
        [[0, 0, 0], [0.051, 0.01, 0], [0.02, 0.055, 0.01]],
        [[1.5, 0, 0.1], [-1.0, 0.2, 0], [0, -1.5, 0.3]],
        [[30, 10, -20], [0, 40, 5], [-15, 0, 25]],
        radius,
    )
    result = run(scene, state, 1e-4, 400, 100)
    figures = result.trajectory.diagnostics
    assert figures["overlap_max"].max() > 1e-3  # a soft contact did happen
    before = momenta(state.position, state.velocity, state.angular_velocity, state.radius)
    final = result.final
    after = momenta(final.position, final.velocity, final.angular_velocity, final.radius)
    assert after[0] == pytest.approx(before[0], abs=1e-13)
    assert after[1] == pytest.approx(before[1], abs=1e-14)
    assert not np.allclose(final.angular_velocity, state.angular_velocity)
