"""Without friction and damping nothing may be lost; with them nothing may be gained."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from gran_bench.dem.contact import ContactLaw, contact_force, sphere_mass
from gran_bench.neighbors import tree_pairs
from gran_bench.scene import Material, Plane

MASS = sphere_mass(2500.0, 0.025)
BOX = tuple(Plane(tuple(side * 0.15 * axis), tuple(-side * axis)) for axis in np.eye(3) for side in (-1.0, 1.0))


def energy(scene, trajectory, frame):
    """Kinetic, gravitational and elastic energy of a frame, ⅖ K δ^{5/2} a contact, J."""
    law = ContactLaw.between(scene.material, scene.material)
    position, velocity = trajectory.position[frame], trajectory.velocity[frame]
    kinetic = 0.5 * MASS * np.sum(velocity**2)
    height = -MASS * np.sum(position @ np.array(scene.gravity))
    pairs = tree_pairs(position, 0.05)
    overlap = 0.05 - np.linalg.norm(position[pairs[:, 0]] - position[pairs[:, 1]], axis=1)
    stiffness = 4.0 / 3.0 * law.effective_modulus
    elastic = 0.4 * stiffness * np.sqrt(0.0125) * np.sum(overlap**2.5)
    for wall in scene.walls:
        depth = np.maximum(0.0, 0.025 - (position - np.array(wall.point)) @ np.array(wall.normal))
        elastic += 0.4 * stiffness * np.sqrt(0.025) * np.sum(depth**2.5)
    return kinetic + height + elastic


@pytest.mark.parametrize("engine", ["numba"], indirect=True)  # long; the engines agree to rounding
def test_elastic_frictionless_spheres_in_a_box_keep_their_energy(laboratory, spheres, run):
    scene = laboratory(walls=BOX, gravity=9.81)
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(*3 * [[-0.09, 0.0, 0.09]]), axis=-1).reshape(-1, 3)
    state = spheres(grid, rng.normal(0.0, 1.0, grid.shape))
    trajectory = run(scene, state, 5e-5, 4000, 200).trajectory
    total = np.array([energy(scene, trajectory, frame) for frame in range(trajectory.frame_count)])
    assert trajectory.diagnostics["contact_count"].max() > 0
    assert np.abs(total / total[0] - 1.0).max() < 1e-3


def test_the_energy_error_of_an_elastic_impact_falls_with_the_square_of_the_step(laboratory, spheres, run):
    scene = laboratory()
    state = spheres([[0, 0, 0], [0.0501, 0, 0]], [[1, 0, 0], [-1, 0, 0]])
    error = []
    for step in (1e-4, 2.5e-5):
        trajectory = run(scene, state, step, round(2.5e-3 / step)).trajectory  # ends deep in the contact
        total = np.array([energy(scene, trajectory, frame) for frame in range(trajectory.frame_count)])
        error.append(np.abs(total / total[0] - 1.0).max())
    assert error[0] < 1e-3
    assert error[1] < error[0] / 8.0


def cycle_work(path, substeps=400):
    """Work done on one contact by a closed path of (overlap, tangential displacement), with its history, J."""
    material = Material(1e7, 0.3, 2500.0, 1.0, 50.0)  # no slip, no damping
    law = ContactLaw.between(material, material)
    normal = np.array([[1.0, 0.0, 0.0]])
    corners = np.array(path)
    # The contact is there when the path starts.
    history, before, work, force = np.zeros((1, 3)), corners[:1, 0], 0.0, np.zeros(3)
    for start, end in pairwise(corners):
        for k in range(1, substeps + 1):
            overlap = start[0] + (end[0] - start[0]) * k / substeps
            slip = (end[1] - start[1]) / substeps
            contact = contact_force(
                law,
                normal=normal,
                overlap=np.array([overlap]),
                effective_radius=np.array([0.0125]),
                effective_mass=np.array([0.5 * MASS]),
                velocity=np.array([[0.0, slip, 0.0]]),
                velocity_gain=np.zeros((1, 3)),
                surface_spin=np.zeros((1, 3)),
                history=history,
                overlap_before=before,
                time_step=1.0,
            )
            work -= 0.5 * (force[1] + contact.history[0, 1]) * slip
            history, before = contact.history, np.array([overlap])
            force = contact.history[0]
    return work


DEEP, SHALLOW, SHEAR = 2e-3, 0.5e-3, 1e-4


def test_shear_at_high_load_and_return_at_low_load_creates_no_energy():
    work = cycle_work([(SHALLOW, 0), (DEEP, 0), (DEEP, SHEAR), (SHALLOW, SHEAR), (SHALLOW, 0)])
    assert work > 0.0


def test_shear_at_low_load_and_return_at_high_load_creates_no_energy():
    work = cycle_work([(SHALLOW, 0), (SHALLOW, SHEAR), (DEEP, SHEAR), (DEEP, 0), (SHALLOW, 0)])
    assert work > 0.0


def test_shear_and_return_at_one_load_gives_all_work_back():
    stored = cycle_work([(DEEP, 0), (DEEP, SHEAR)])
    assert stored > 0.0
    assert cycle_work([(DEEP, 0), (DEEP, SHEAR), (DEEP, 0)]) == pytest.approx(0.0, abs=1e-9 * stored)


@pytest.mark.parametrize("engine", ["numba"], indirect=True)  # long; the engines agree to rounding
def test_a_bed_with_friction_and_damping_never_gains_energy(laboratory, spheres, run):
    scene = laboratory(walls=BOX, restitution=0.5, friction=0.5)
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid(*3 * [[-0.09, 0.0, 0.09]]), axis=-1).reshape(-1, 3)
    state = spheres(grid, rng.normal(0.0, 1.0, grid.shape), rng.normal(0.0, 20.0, grid.shape))
    figures = run(scene, state, 1e-4, 4000, 400).trajectory.diagnostics
    kinetic = figures["kinetic_energy_translational"] + figures["kinetic_energy_rotational"]
    # Elastic energy goes in and out between frames; the trend only down.
    assert kinetic[-1] < 0.2 * kinetic[0]
    assert kinetic.max() == kinetic[0]
