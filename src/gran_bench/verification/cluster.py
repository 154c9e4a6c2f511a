"""Clusters that fall in on themselves: momentum, the symmetries of space and time, and the two engines."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation as Turn

from gran_bench.scene import Cylinder, Material, Plane, Scene
from gran_bench.state import FloatArray, ParticleState
from gran_bench.verification import laboratory as lab
from gran_bench.verification.case import Case, Check

INWARD = 1.0  # m/s, of the rim of a cluster
STEPS = 400
STEP = {lab.SOFT: 1e-4, lab.STIFF: 4e-6}  # s, for the two engines
PLAIN = "engine numpy, the readable reference"
ARRAYS = ("position", "velocity", "angular_velocity")


def cluster(count: int, seed: int, gap: float, smallest: float) -> ParticleState:
    """A ball of ``count`` spheres of unequal size that fall towards their middle, with random velocities and spins.

    ``gap`` is the least distance of two surfaces, m; ``smallest`` a radius over that of the largest, ``RADIUS``.
    """
    rng, side = np.random.default_rng(seed), math.ceil(1.6 * count ** (1 / 3)) + 1
    line = (np.arange(side) - 0.5 * (side - 1)) * (2.0 * lab.RADIUS + gap)
    grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    grid += np.array([0.31, 0.17, 0.23]) * lab.RADIUS
    position = grid[np.argsort(np.linalg.norm(grid, axis=1), kind="stable")[:count]]
    reach = np.linalg.norm(position, axis=1).max()
    velocity = -INWARD * position / reach + rng.normal(0.0, INWARD / 3.0, position.shape)
    spin = rng.normal(0.0, 20.0, position.shape)
    return lab.spheres(position, velocity, spin, lab.RADIUS * rng.uniform(smallest, 1.0, count))


def rough_material(modulus: float) -> Material:
    """Inelastic, with sliding and rolling friction."""
    return lab.sphere_material(modulus, 0.5, 0.5, 0.05)


def momenta() -> Iterator[Check]:
    """Momentum and angular momentum over 10⁴ steps of a rough, inelastic cluster that falls in on itself."""
    # A stiff cluster starts almost in touch: its steps are a hundred times shorter.
    for modulus, gap, smallest, per_contact in ((lab.SOFT, 1e-4, 0.9, 40), (lab.STIFF, 1e-6, 0.999, 20)):
        state, material = cluster(200, 5, gap, smallest), rough_material(modulus)
        step = lab.on_sphere(material, float(state.radius.min())).duration(3.0 * INWARD) / per_contact
        trajectory = lab.run(lab.laboratory(material), state, step, 10_000, 100).trajectory
        mass = lab.mass_of(trajectory.radius)[:, None]
        linear = (mass * trajectory.velocity).sum(axis=1)
        own = 0.4 * mass * trajectory.radius[:, None] ** 2 * trajectory.angular_velocity
        angular = (own + mass * np.cross(trajectory.position, trajectory.velocity)).sum(axis=1)
        speeds, reaches = (np.linalg.norm(a[0], axis=1) for a in (trajectory.velocity, trajectory.position))
        linear_scale = float((mass[:, 0] * speeds).sum())
        angular_scale = float((mass[:, 0] * reaches * speeds).sum() + np.linalg.norm(own[0], axis=1).sum())
        seen = trajectory.diagnostics
        energy = seen["kinetic_energy_translational"] + seen["kinetic_energy_rotational"]
        if energy[-1] > 0.7 * energy[0]:
            raise RuntimeError("the cluster hardly touched, so that its momenta say nothing")
        label = f"E {modulus:g} Pa, {seen['contact_count'].mean():.1f} contacts at a time"
        for name, values, scale, unit in (
            ("momentum", linear, linear_scale, "of Σ m|v|"),
            ("angular momentum", angular, angular_scale, "of Σ m|x||v| + Σ I|ω|"),
        ):
            off = np.abs(values - values[0]).max()
            yield Check(f"change of {name} over 10⁴ steps, {label}", 0.0, off, 1e-12, "conserved", scale, unit)


Change = Callable[[ParticleState], ParticleState]


def _both(change: Change, undo: Change) -> Iterator[Check]:
    """Run a cluster as it is and changed, undo the change, and compare positions, velocities and spins."""
    for modulus, gap, step, smallest in ((lab.SOFT, 1e-4, 1e-4, 0.9), (lab.STIFF, 1e-6, 2e-6, 0.9999)):
        scene, state = lab.laboratory(rough_material(modulus)), cluster(60, 11, gap, smallest)
        # Frames at the same steps: an engine starts anew from each.
        plain = lab.run(scene, state, step, STEPS, STEPS // 20)
        other = undo(lab.run(scene, change(state), step, STEPS, STEPS // 20).final)
        touching = plain.trajectory.diagnostics["contact_count"].mean()
        if touching < 1.0:
            raise RuntimeError("the cluster hardly touched, so that it says nothing of contacts")
        # A velocity is a position over a contact time: it may be off by that much more.
        for field, name, tolerance, scale, unit in zip(
            ARRAYS, ("positions", "velocities", "spins"), (1e-10, 1e-7, 1e-7), (1.0, 1.0, 100.0),
            ("m", "m/s", "100 rad/s"), strict=True,
        ):  # fmt: skip
            off = np.abs(getattr(other, field) - getattr(plain.final, field)).max()
            quantity = f"{name} after {STEPS} steps, E {modulus:g} Pa, {touching:.0f} contacts at a time"
            yield Check(quantity, 0.0, off, tolerance, "symmetry of space and time", scale, unit)


def rotation() -> Iterator[Check]:
    """A cluster turned by an odd angle."""
    turn = Turn.from_rotvec([0.4, -1.1, 0.7]).as_matrix()

    def mapped(state: ParticleState, linear: FloatArray) -> ParticleState:
        return replace(state, **{name: getattr(state, name) @ linear.T for name in ARRAYS})

    return _both(lambda s: mapped(s, turn), lambda s: mapped(s, turn.T))


def permutation() -> Iterator[Check]:
    """A cluster with its spheres numbered otherwise."""
    order = np.random.default_rng(3).permutation(60)

    def reorder(state: ParticleState, rows: FloatArray) -> ParticleState:
        return replace(state, **{name: getattr(state, name)[rows] for name in (*ARRAYS, "radius")})

    return _both(lambda s: reorder(s, order), lambda s: reorder(s, np.argsort(order)))


def galilei() -> Iterator[Check]:
    """A cluster that moves as a whole."""
    drift = np.array([0.7, -0.4, 0.3])
    return _both(
        lambda s: replace(s, velocity=s.velocity + drift),
        lambda s: replace(s, velocity=s.velocity - drift, position=s.position - drift * s.time),
    )


def _drum_bed(modulus: float, time_step: float) -> tuple[Scene, ParticleState]:
    """A small bed in a turning drum with caps in the middle of its motion: old, new, sticking and sliding contacts."""
    radius, half, rng = 0.25, 0.1, np.random.default_rng(2)
    caps = (Plane((0.0, side * half, 0.0), (0.0, -side, 0.0)) for side in (-1.0, 1.0))
    material = rough_material(modulus)
    scene = lab.laboratory(
        material, (Cylinder((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), radius), *caps),
        wall_material=replace(material, friction=0.4, restitution=0.6), gravity=lab.DOWN, rpm=40.0,
    )  # fmt: skip
    spacing = 2.02 * lab.RADIUS
    line = np.arange(-4, 5) * spacing
    grid = np.stack(np.meshgrid(line, np.array([-1.0, 0.0, 1.0]) * spacing, line), axis=-1).reshape(-1, 3)
    grid = grid[(np.hypot(grid[:, 0], grid[:, 2]) < radius - lab.RADIUS) & (grid[:, 2] < 0.03)]
    velocity, spin = rng.normal(0.0, 0.3, grid.shape), rng.normal(0.0, 5.0, grid.shape)
    state = lab.spheres(grid, velocity, spin, lab.RADIUS * rng.uniform(0.8, 1.0, len(grid)))
    return scene, lab.run(scene, state, time_step, math.ceil(0.4 / time_step)).final


def _two_engines(steps: int) -> Iterator[tuple[str, ParticleState, ParticleState, ParticleState]]:
    """Of states in the middle of many contacts: a label, the state, and where each engine takes it."""
    for modulus, step in STEP.items():
        gap, smallest, begun = (1e-4, 0.9, 60) if modulus == lab.SOFT else (1e-6, 0.9999, 25)
        free = lab.laboratory(rough_material(modulus))
        falling = lab.run(free, cluster(200, 3, gap, smallest), step, begun).final
        for name, (scene, state) in (
            ("bed in a turning drum", _drum_bed(modulus, step)),
            ("free cluster", (free, falling)),
        ):
            fast, plain = (lab.run(scene, state, step, steps, engine=engine).final for engine in ("numba", "numpy"))
            yield f"{name}, E {modulus:g} Pa", state, fast, plain


def forces() -> Iterator[Check]:
    """Forces and torques of one step, seen in what they do to velocities and spins."""
    for label, state, fast, plain in _two_engines(1):
        for quantity, field in (("force", "velocity"), ("torque", "angular_velocity")):
            given = np.abs(getattr(plain, field) - getattr(state, field)).max()
            off = np.abs(getattr(fast, field) - getattr(plain, field)).max()
            name = f"{quantity} of one step, {label}, {len(plain.history)} contacts"
            yield Check(name, 0.0, off, 1e-12, PLAIN, given, "of the largest")


def hundred_steps() -> Iterator[Check]:
    """Positions after a hundred steps from one state."""
    for label, state, fast, plain in _two_engines(100):
        off, moved = (np.abs(one.position - plain.position).max() for one in (fast, state))
        name = f"positions after 100 steps, m, {label}, moved by up to {1e3 * moved:.2g} mm"
        yield Check(name, 0.0, off, 1e-10, PLAIN, 1.0, "m")


CASES = (
    Case("momentum", "a closed system keeps momentum and angular momentum over 10⁴ steps", momenta),
    Case("rotation", "turning everything turns the result", rotation),
    Case("permutation", "the numbering of the particles does not matter", permutation),
    Case("galilei", "a uniform motion of the whole does not matter", galilei),
    Case("engine-forces", "numba gives the forces of numpy to 1e-12", forces),
    Case("engine-steps", "numba stays with numpy for 100 steps to 1e-10 m", hundred_steps),
)
