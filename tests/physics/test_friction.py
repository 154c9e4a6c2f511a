"""Sliding, rolling and oblique impact: where Coulomb's law and the lever arm show."""

from __future__ import annotations

import numpy as np
import pytest

from gran_bench.dem.contact import ContactLaw, sphere_mass
from gran_bench.scene import Cylinder, Plane, Rotation

FLOOR = Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
RADIUS, GRAVITY = 0.025, 9.81
MASS = sphere_mass(2500.0, RADIUS)


def resting_overlap(scene):
    """Overlap at which the floor carries a sphere, K δ^{3/2} = m g, m."""
    law = ContactLaw.between(scene.material, scene.wall_material)
    return (MASS * GRAVITY / (4.0 / 3.0 * law.effective_modulus * np.sqrt(RADIUS))) ** (2.0 / 3.0)


@pytest.mark.parametrize("friction", [0.1, 0.3])
def test_a_sliding_ball_rolls_at_five_sevenths_of_its_speed(laboratory, spheres, run, friction):
    # MFiX-DEM verification manual, DEM03: rolling sets in at t = 2u₀/7μg with u = 5/7 u₀.
    scene = laboratory(walls=(FLOOR,), gravity=GRAVITY, friction=friction, restitution=0.5, youngs_modulus=1e8)
    speed, height = 0.5, RADIUS - resting_overlap(scene)
    stop = 2.0 * speed / (7.0 * friction * GRAVITY)
    step = stop / 1000
    trajectory = run(scene, spheres([[0, 0, height]], [[speed, 0, 0]]), step, 1200, 20).trajectory
    u, spin = trajectory.velocity[:, 0, 0], trajectory.angular_velocity[:, 0, 1]
    sliding = trajectory.time < 0.9 * stop
    slip_ratio = -np.diff(u[sliding]) / np.diff(trajectory.time[sliding]) / (friction * GRAVITY)
    assert slip_ratio[1:] == pytest.approx(1.0, abs=1e-3)
    assert u[-1] == pytest.approx(5.0 / 7.0 * speed, rel=2e-3)
    assert spin[-1] * height == pytest.approx(u[-1], rel=5e-3)
    rolling = np.flatnonzero(spin * height >= 0.999 * u)[0]
    assert trajectory.time[rolling] == pytest.approx(stop, abs=25 * step)


@pytest.mark.parametrize("restitution", [0.5, 1.0])
def test_a_grazing_impact_slides_all_through(laboratory, spheres, run, restitution):
    # Chung & Ooi (2011), test 4: Δv_t = μ (1 + e) v_n, and the same impulse turns the sphere.
    friction, normal_speed, speed = 0.1, 0.5, 5.0
    scene = laboratory(walls=(FLOOR,), friction=friction, restitution=restitution)
    state = spheres([[0, 0, RADIUS + 1e-6]], [[speed, 0, -normal_speed]])
    final = run(scene, state, 1e-5, 1500, 1500).final
    impulse = friction * (1.0 + restitution) * normal_speed
    assert final.velocity[0, 2] == pytest.approx(restitution * normal_speed, abs=1e-3)
    assert speed - final.velocity[0, 0] == pytest.approx(impulse, rel=2e-3)
    # The arm is R − δ, so the spin falls short of 5/2 Δv_t/R by the overlap.
    assert final.angular_velocity[0, 1] == pytest.approx(2.5 * impulse / RADIUS, rel=0.06)
    assert final.angular_velocity[0, 1] < 2.5 * impulse / RADIUS


def test_two_spheres_in_an_oblique_impact_spin_alike(laboratory, spheres, run):
    scene = laboratory(friction=0.4, restitution=0.8)
    final = run(scene, spheres([[0, 0, 0], [0.0501, 0, 0]], [[0.5, 0.4, 0], [-0.5, -0.4, 0]]), 2e-5, 500, 500).final
    assert final.angular_velocity[0] == pytest.approx(final.angular_velocity[1], rel=1e-9)
    assert final.velocity[0] == pytest.approx(-final.velocity[1], rel=1e-9)
    assert final.angular_velocity[0, 2] < 0.0  # contact pushes the first towards −y at its +x side


def test_a_turning_floor_drags_along_its_surface(laboratory, spheres, run):
    rotation = Rotation((0.0,), (60.0,), (0.0, 0.0, 1.0))
    scene = laboratory(walls=(FLOOR,), gravity=GRAVITY, friction=0.2, restitution=0.5, rotation=rotation)
    state = spheres([[0.3, 0, RADIUS - resting_overlap(scene)]])
    final = run(scene, state, 1e-4, 100, 100).final
    # ω × x points to +y at x > 0; sliding friction gives μ g.
    assert final.velocity[0, 1] == pytest.approx(0.2 * GRAVITY * 0.01, rel=0.02)
    assert abs(final.velocity[0, 0]) < 1e-4


def test_a_turning_drum_carries_its_bed_towards_minus_x(laboratory, spheres, run):
    drum = Cylinder((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.5)
    scene = laboratory(
        walls=(drum,), gravity=GRAVITY, friction=0.3, restitution=0.5, rotation=Rotation((0.0,), (30.0,))
    )
    final = run(scene, spheres([[0, 0, -0.475 - 2e-4]]), 1e-4, 100, 100).final
    assert final.velocity[0, 0] == pytest.approx(-0.3 * GRAVITY * 0.01, rel=0.05)


def test_a_bed_that_turns_as_one_body_slips_nowhere(laboratory, spheres, run):
    # Slip is that of the contact point, R − δ/2 from the centres of a pair and R − δ from a sphere at a wall. Measured
    # with full radii it is ω δ here: it loads the contacts up to the Coulomb limit, and the spheres spin slower.
    speed = 4.0 * np.pi
    drum = Cylinder((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.5)
    scene = laboratory(walls=(drum,), friction=0.3, restitution=0.5, rotation=Rotation((0.0,), (120.0,)))
    law = ContactLaw.between(scene.material, scene.wall_material)
    modulus, outer, inner = 4.0 / 3.0 * law.effective_modulus, 0.475, 0.425
    for _ in range(20):  # where the contacts carry the centrifugal forces
        carried = MASS * speed**2 * np.array([outer + inner, inner])
        at_wall, between = (carried / (modulus * np.sqrt([RADIUS, RADIUS / 2]))) ** (2.0 / 3.0)
        outer = 0.475 + at_wall
        inner = outer - 0.05 + between
    state = spheres(
        [[outer, 0, 0], [inner, 0, 0]], [[0, 0, -speed * outer], [0, 0, -speed * inner]], [[0, speed, 0]] * 2
    )
    final = run(scene, state, 1e-4, 500, 500).final  # later the column topples, as it must
    assert final.angular_velocity[:, 1] == pytest.approx(speed, rel=1e-4)
    assert np.linalg.norm(final.history.force, axis=1).max() < 1e-2 * scene.material.friction * carried.min()
    assert at_wall / RADIUS > 0.01  # what full radii would make of the spin


def test_a_wall_that_does_not_turn_drags_nothing(laboratory, spheres, run):
    still = Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), turns=False)
    rotation = Rotation((0.0,), (60.0,), (0.0, 0.0, 1.0))
    scene = laboratory(walls=(still,), gravity=GRAVITY, friction=0.2, restitution=0.5, rotation=rotation)
    final = run(scene, spheres([[0.3, 0, RADIUS - resting_overlap(scene)]]), 1e-4, 100, 100).final
    assert np.abs(final.velocity[0, :2]).max() < 1e-12


@pytest.mark.parametrize("engine", ["numba"], indirect=True)  # long; the engines agree to rounding
@pytest.mark.parametrize(("slope", "moves"), [(5.0, False), (15.0, True)])
def test_rolling_friction_holds_a_sphere_on_a_slope_up_to_its_coefficient(laboratory, spheres, run, slope, moves):
    # tan 5° < μ_r = 0.17 < tan 15°.
    angle = np.radians(slope)
    incline = Plane((0, 0, 0), (float(np.sin(angle)), 0.0, float(np.cos(angle))))
    scene = laboratory(walls=(incline,), gravity=GRAVITY, friction=0.8, rolling_friction=0.17, restitution=0.3)
    start = (RADIUS - resting_overlap(scene)) * np.array(incline.normal)
    final = run(scene, spheres([start]), 1e-4, 3000, 3000).final
    travelled = np.linalg.norm(final.position[0] - start)
    free_rolling = 0.5 * 5.0 / 7.0 * GRAVITY * np.sin(angle) * 0.3**2
    assert (travelled > 0.1 * free_rolling) == moves


@pytest.mark.parametrize("engine", ["numba"], indirect=True)  # long; the engines agree to rounding
def test_without_rolling_friction_a_sphere_rolls_down_with_five_sevenths_of_gravity(laboratory, spheres, run):
    angle = np.radians(10.0)
    incline = Plane((0, 0, 0), (float(np.sin(angle)), 0.0, float(np.cos(angle))))
    scene = laboratory(walls=(incline,), gravity=GRAVITY, friction=0.8, restitution=0.3)
    start = (RADIUS - resting_overlap(scene)) * np.array(incline.normal)
    final = run(scene, spheres([start]), 1e-4, 3000, 3000).final
    assert np.linalg.norm(final.velocity[0]) == pytest.approx(5.0 / 7.0 * GRAVITY * np.sin(angle) * 0.3, rel=0.01)
