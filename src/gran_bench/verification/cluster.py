"""Many spheres for the cases that have no formula: clusters that fall in on themselves, and a gas in a box."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gran_bench.scene import Cylinder, Plane, Rotation, Scene
from gran_bench.state import FloatArray, ParticleState
from gran_bench.verification.laboratory import RADIUS, laboratory, run, sphere_material, spheres


def cluster(count: int, seed: int, gap: float, inward: float, spin: float, smallest: float = 0.6) -> ParticleState:
    """A ball of ``count`` spheres of unequal size that fall towards their middle, with random velocities and spins.

    Args:
        count: N.
        seed: of sizes, places, velocities and spins.
        gap: least distance of two surfaces, m.
        inward: speed towards the middle at the rim, m/s; the random part is a third of it.
        spin: of random spins, rad/s.
        smallest: radius over that of the largest, ``RADIUS``.
    """
    rng, side = np.random.default_rng(seed), math.ceil(1.6 * count ** (1 / 3)) + 1
    line = (np.arange(side) - 0.5 * (side - 1)) * (2.0 * RADIUS + gap)
    grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    grid += np.array([0.31, 0.17, 0.23]) * RADIUS
    position = grid[np.argsort(np.linalg.norm(grid, axis=1), kind="stable")[:count]]
    reach = np.linalg.norm(position, axis=1).max()
    velocity = -inward * position / reach + rng.normal(0.0, inward / 3.0, position.shape)
    return spheres(
        position, velocity, rng.normal(0.0, spin, position.shape), RADIUS * rng.uniform(smallest, 1.0, count)
    )


def rough_material(modulus: float):
    """Inelastic, with sliding and rolling friction."""
    return sphere_material(modulus, 0.5, 0.5, 0.05)


def gas(side: int, seed: int, speed: float, width: float, modulus: float) -> tuple[Scene, ParticleState]:
    """Elastic smooth spheres in a box with elastic smooth walls, without gravity.

    Args:
        side: spheres along an edge.
        seed: of the velocities.
        speed: root mean square of a velocity component, m/s.
        width: of the box, m.
        modulus: E, Pa.
    """
    axes = np.eye(3)
    walls = tuple(
        Plane(tuple(sign * 0.5 * width * axis), tuple(-sign * axis), turns=False)
        for axis in axes
        for sign in (-1.0, 1.0)
    )
    line = (np.arange(side) - 0.5 * (side - 1)) * width / side
    grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    velocity = np.random.default_rng(seed).normal(0.0, speed, grid.shape)
    return laboratory(sphere_material(modulus), walls), spheres(grid, velocity)


def drum_bed(modulus: float, time_step: float, duration: float) -> tuple[Scene, ParticleState]:
    """A small bed in a turning drum with caps in the middle of its motion: old, new, sticking and sliding contacts."""
    radius, half = 0.25, 0.1
    walls = (
        Cylinder((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), radius),
        Plane((0.0, -half, 0.0), (0.0, 1.0, 0.0)),
        Plane((0.0, half, 0.0), (0.0, -1.0, 0.0)),
    )
    material = rough_material(modulus)
    scene = laboratory(
        material,
        walls,
        wall_material=replace(material, friction=0.4, restitution=0.6),
        gravity=(0.0, 0.0, -9.81),
        rotation=Rotation((0.0,), (40.0,)),
    )
    spacing = 2.02 * RADIUS
    line = np.arange(-4, 5) * spacing
    grid = np.stack(np.meshgrid(line, np.array([-1.0, 0.0, 1.0]) * spacing, line), axis=-1).reshape(-1, 3)
    inside = (np.hypot(grid[:, 0], grid[:, 2]) < radius - RADIUS) & (grid[:, 2] < 0.03)
    grid = grid[inside]
    rng = np.random.default_rng(2)
    state = spheres(
        grid, rng.normal(0.0, 0.3, grid.shape), rng.normal(0.0, 5.0, grid.shape),
        RADIUS * rng.uniform(0.8, 1.0, len(grid)),
    )  # fmt: skip
    return scene, run(scene, state, time_step, math.ceil(duration / time_step)).final


def mass_of(state_radius: FloatArray, density: float = 2500.0) -> FloatArray:
    """m = 4/3 π ρ R³ of each sphere, ``(N,)`` kg."""
    return 4.0 / 3.0 * np.pi * density * state_radius**3
