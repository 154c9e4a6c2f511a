"""A head-on impact has an exact answer: Hertz (1882) without damping, the restitution that was set with it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gran_bench.dem.contact import ContactLaw, damping_coefficient, hertz_impact, restitution_of, sphere_mass
from gran_bench.scene import Plane

RADIUS = 0.025  # m
MASS = sphere_mass(2500.0, RADIUS)


def contact_time(scene, speed, share=0.5):
    """t_c of a pair (share ½) or of a wall (share 1)."""
    law = ContactLaw.between(scene.material, scene.material)
    return hertz_impact(law.effective_modulus, share * RADIUS, share * MASS, speed)[2]


@pytest.mark.parametrize(
    ("youngs_modulus", "speed", "overlap", "force", "duration"),
    [
        (1e7, 1.0, 1.732e-3, 59.04, 5.098e-3),
        (1e7, 5.0, 6.277e-3, 407.3, 3.695e-3),
        (7e10, 1.0, 50.18e-6, 2038.0, 147.7e-6),
    ],
)
def test_hertz_formulas_give_the_published_impacts(laboratory, youngs_modulus, speed, overlap, force, duration):
    law = ContactLaw.between(*2 * [laboratory(youngs_modulus=youngs_modulus).material])
    found = hertz_impact(law.effective_modulus, 0.5 * RADIUS, 0.5 * MASS, speed)
    assert found == pytest.approx((overlap, force, duration), rel=5e-4)


@pytest.mark.parametrize(("youngs_modulus", "speed"), [(1e7, 1.0), (1e7, 5.0), (7e10, 1.0)])
def test_elastic_impact_reaches_the_overlap_force_and_duration_of_hertz(
    laboratory, spheres, run, youngs_modulus, speed
):
    scene = laboratory(youngs_modulus=youngs_modulus)
    law = ContactLaw.between(scene.material, scene.material)
    overlap, force, duration = hertz_impact(law.effective_modulus, 0.5 * RADIUS, 0.5 * MASS, speed)
    step = duration / 400
    state = spheres([[0, 0, 0], [0.05, 0, 0]], [[0.5 * speed, 0, 0], [-0.5 * speed, 0, 0]])
    trajectory = run(scene, state, step, 440).trajectory
    acceleration = np.diff(trajectory.velocity[:, 1, 0]) / step
    touching = np.count_nonzero(trajectory.diagnostics["contact_count"]) * step
    assert trajectory.diagnostics["overlap_max"].max() == pytest.approx(overlap, rel=1e-4)
    assert MASS * acceleration.max() == pytest.approx(force, rel=1e-3)
    assert touching == pytest.approx(duration, abs=2 * step)


@pytest.mark.parametrize("restitution", [0.05, 0.3, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("speed", [0.01, 1.0, 5.0])
def test_the_restitution_that_was_set_comes_out(laboratory, spheres, run, restitution, speed):
    scene = laboratory(restitution=restitution)
    step = contact_time(scene, speed) / 200
    for phase in (0.0, 0.3, 0.6, 0.9):  # of a step, between the last state apart and first touch
        gap = phase * speed * step + 1e-12
        state = spheres([[0, 0, 0], [0.05 + gap, 0, 0]], [[0.5 * speed, 0, 0], [-0.5 * speed, 0, 0]])
        velocity = run(scene, state, step, 300, 300).final.velocity
        assert (velocity[1, 0] - velocity[0, 0]) / speed == pytest.approx(restitution, abs=1e-3)


@pytest.mark.parametrize("restitution", [0.3, 0.5, 0.9])
def test_the_restitution_of_a_wall_is_the_one_that_was_set(laboratory, spheres, run, restitution):
    scene = laboratory(walls=(Plane((0, 0, 0), (1, 0, 0)),), restitution=restitution)
    step = contact_time(scene, 2.0, share=1.0) / 200
    final = run(scene, spheres([[0.0251, 0, 0]], [[-2.0, 0, 0]]), step, 1200, 400).final
    assert final.velocity[0, 0] / 2.0 == pytest.approx(restitution, abs=1e-3)


def test_at_the_production_step_restitution_scatters_by_about_a_hundredth(laboratory, spheres, run):
    scene = laboratory(restitution=0.5)
    step = contact_time(scene, 4.43) / 19
    found = []
    for phase in np.linspace(0.0, 0.9, 10):
        gap = phase * 4.43 * step + 1e-12
        state = spheres([[0, 0, 0], [0.05 + gap, 0, 0]], [[4.43, 0, 0], [0, 0, 0]])
        velocity = run(scene, state, step, 60, 60).final.velocity
        found.append((velocity[1, 0] - velocity[0, 0]) / 4.43)
    assert np.mean(found) == pytest.approx(0.5, abs=5e-3)
    assert np.ptp(found) < 0.02


def test_unequal_spheres_part_with_the_restitution_too(laboratory, spheres, run):
    scene = laboratory(restitution=0.6)
    state = spheres([[0, 0, 0], [0.0601, 0, 0]], [[1, 0, 0], [-1, 0, 0]], radius=[0.01, 0.05])
    velocity = run(scene, state, contact_time(scene, 2.0) / 300, 900, 900).final.velocity
    assert (velocity[1, 0] - velocity[0, 0]) / 2.0 == pytest.approx(0.6, abs=1e-3)


def test_damping_and_restitution_are_each_others_inverse():
    for restitution in (0.02, 0.2, 0.5, 0.8, 0.99):
        assert restitution_of(damping_coefficient(restitution)) == pytest.approx(restitution, abs=1e-7)
    assert damping_coefficient(1.0) == 0.0


def test_cutting_the_attractive_tail_off_asks_for_more_damping_than_the_closed_form():
    # Antypov & Elliott's α(0.5) keeps the tail; without the tail it gives 0.550.
    closed_form = -math.sqrt(5.0) * math.log(0.5) / math.hypot(math.pi, math.log(0.5))
    assert restitution_of(closed_form) == pytest.approx(0.550, abs=1e-3)
    assert damping_coefficient(0.5) > closed_form


@pytest.mark.parametrize("restitution", [0.0, -0.1, 1.2, math.nan])
def test_an_impossible_restitution_is_refused(restitution):
    with pytest.raises(ValueError, match=r"choose a value in \(0, 1\]"):
        damping_coefficient(restitution)
