"""The reference engine: the laws of the other files, vectorised, one step after the other, to be read and trusted.

Pairs come from a KD-tree at every step; nothing is sorted, packed or remembered but the contacts themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gran_bench.dem.contact import ContactForce, ContactLaw, contact_force, sphere_mass
from gran_bench.dem.integrate import Divergence, Physics, into_period
from gran_bench.dem.rolling import CONTACT_INERTIA, rolling_moment
from gran_bench.dem.seams import Touching, wall_touching
from gran_bench.dem.walls import SPIN, surface_velocity
from gran_bench.neighbors import nearest_image, tree_pairs
from gran_bench.state import ContactHistory, FloatArray, ParticleState


@dataclass
class _Bodies:
    """The particles while they move, ``(N, 3)`` and ``(N,)`` arrays, and what their contacts remember."""

    position: FloatArray
    velocity: FloatArray
    velocity_gain: FloatArray
    spin: FloatArray
    radius: FloatArray
    mass: FloatArray
    inertia: FloatArray
    material: np.ndarray
    history: ContactHistory


def advance(state: ParticleState, physics: Physics, time_step: float, walls: FloatArray) -> ParticleState:
    """The state after a stretch of steps, its contact history included.

    Args:
        state: where the stretch starts.
        physics: laws and gravity.
        time_step: Δt, s.
        walls: ``(steps + 1, W, 22)`` pose of each wall at each force evaluation (see walls.py).

    Raises:
        Divergence: a speed that crosses a quarter of a radius in a step, or is not finite.
    """
    if state.count == 0:
        return state
    position, velocity, spin = (
        np.array(a, np.float64) for a in (state.position, state.velocity, state.angular_velocity)
    )
    radius = np.asarray(state.radius, np.float64)
    mass = sphere_mass(physics.density[state.material], radius)
    inertia = 0.4 * mass * radius**2
    bodies = _Bodies(
        position, velocity, np.zeros_like(velocity), spin, radius, mass, inertia, state.material, state.history
    )
    steps, fastest = len(walls) - 1, 0.25 * radius.min() / time_step
    force, torque = _loads(bodies, physics, 0.0, walls[0])
    for step in range(steps):
        _kick(bodies, physics, force, torque, 0.5 * time_step)
        _check_speeds(bodies, fastest, step)
        bodies.position += time_step * bodies.velocity
        force, torque = _loads(bodies, physics, time_step, walls[step + 1])
        _kick(bodies, physics, force, torque, 0.5 * time_step)
    if steps:
        _check_speeds(bodies, fastest, steps)
    return ParticleState(
        into_period(bodies.position, physics.period),
        bodies.velocity,
        bodies.spin,
        state.radius,
        state.time + steps * time_step,
        bodies.history,
        state.material,
    )


def _kick(bodies: _Bodies, physics: Physics, force: FloatArray, torque: FloatArray, duration: float) -> None:
    gain = duration * (force / bodies.mass[:, None] + physics.gravity)
    bodies.velocity += gain
    # What the second half of the step will add, if the acceleration stays.
    bodies.velocity_gain = gain
    bodies.spin += duration * torque / bodies.inertia[:, None]


def _check_speeds(bodies: _Bodies, fastest: float, steps: int) -> None:
    wild = np.flatnonzero(~(np.linalg.norm(bodies.velocity, axis=1) <= fastest))
    if len(wild):
        raise Divergence(int(wild[0]), steps, bodies.position, bodies.velocity, bodies.spin)


def _loads(bodies: _Bodies, physics: Physics, time_step: float, walls: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Force and torque on each particle, ``(N, 3)`` each; the history becomes that of this instant."""
    force, torque = np.zeros_like(bodies.position), np.zeros_like(bodies.position)
    parts = [_pair_loads(bodies, physics, time_step, force, torque)]
    on_walls, bodies.history = wall_touching(walls, bodies.position, bodies.radius, bodies.history)
    for index, touching in enumerate(on_walls):
        parts.append(_wall_loads(bodies, physics, index, walls[index], touching, time_step, force, torque))
    names = ("first", "second", "force", "overlap", "rolling_moment")
    bodies.history = ContactHistory(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
    return force, torque


def _pair_loads(
    bodies: _Bodies, physics: Physics, time_step: float, force: FloatArray, torque: FloatArray
) -> ContactHistory:
    """Adds the loads of all touching pairs; returns what they remember."""
    radius = bodies.radius
    pairs = tree_pairs(bodies.position, 2.0 * radius.max(), physics.period)
    offset = nearest_image(bodies.position[pairs[:, 1]] - bodies.position[pairs[:, 0]], physics.period)
    distance = np.linalg.norm(offset, axis=1)
    touching = distance < radius[pairs[:, 0]] + radius[pairs[:, 1]]
    i, j = pairs[touching].T
    offset, distance = offset[touching], distance[touching]
    normal = offset / distance[:, None]
    # Both lever arms end on the plane of the circle in which the spheres intersect.
    arm = 0.5 * (distance + (radius[i] ** 2 - radius[j] ** 2) / distance)
    # Those that slip is measured with; LAMMPS' are longer (contact.py).
    slip_i, slip_j = (radius[i], radius[j]) if physics.full_radius else (arm, distance - arm)
    old = _recall(bodies.history, i, j)
    law = ContactLaw.from_constants(physics.pair_laws[bodies.material[i], bodies.material[j]])
    contact = contact_force(
        law,
        normal=normal,
        overlap=radius[i] + radius[j] - distance,
        effective_radius=radius[i] * radius[j] / (radius[i] + radius[j]),
        effective_mass=bodies.mass[i] * bodies.mass[j] / (bodies.mass[i] + bodies.mass[j]),
        velocity=bodies.velocity[i] - bodies.velocity[j],
        velocity_gain=bodies.velocity_gain[i] - bodies.velocity_gain[j],
        surface_spin=slip_i[:, None] * bodies.spin[i] + slip_j[:, None] * bodies.spin[j],
        history=old.force,
        overlap_before=old.overlap,
        time_step=time_step,
    )
    force += _sums(i, contact.force, len(force)) - _sums(j, contact.force, len(force))
    torque += _sums(i, arm[:, None] * contact.twist, len(torque))
    torque += _sums(j, (distance - arm)[:, None] * contact.twist, len(torque))
    rolling = old.rolling_moment
    if physics.rolling:
        about_contact = CONTACT_INERTIA * bodies.mass * radius**2
        inertia = about_contact[i] * about_contact[j] / (about_contact[i] + about_contact[j])
        moment, rolling = _rolling(law, contact, old, bodies.spin[i] - bodies.spin[j], inertia, time_step)
        torque += _sums(i, moment, len(torque)) - _sums(j, moment, len(torque))
    return ContactHistory(i, j, contact.history, contact.overlap, rolling)


def _wall_loads(
    bodies: _Bodies,
    physics: Physics,
    index: int,
    pose: FloatArray,
    touching: Touching,
    time_step: float,
    force: FloatArray,
    torque: FloatArray,
) -> ContactHistory:
    """Adds the loads of one wall; returns what its contacts remember."""
    i, distance, normal = touching
    point = bodies.position[i] + distance[:, None] * normal
    arm = bodies.radius[i] if physics.full_radius else distance
    old = _recall(bodies.history, i, np.full(len(i), -1 - index))
    law = ContactLaw.from_constants(physics.wall_laws[bodies.material[i], index])
    contact = contact_force(
        law,
        normal=normal,
        overlap=bodies.radius[i] - distance,
        effective_radius=bodies.radius[i],
        effective_mass=bodies.mass[i],
        velocity=bodies.velocity[i] - surface_velocity(pose, point),
        velocity_gain=bodies.velocity_gain[i],
        surface_spin=arm[:, None] * bodies.spin[i],
        history=old.force,
        overlap_before=old.overlap,
        time_step=time_step,
    )
    force[i] += contact.force
    torque[i] += arm[:, None] * contact.twist
    rolling = old.rolling_moment
    if physics.rolling:
        inertia = CONTACT_INERTIA * bodies.mass[i] * bodies.radius[i] ** 2
        # What rolls on a turning wall rolls against the wall's own rotation.
        moment, rolling = _rolling(law, contact, old, bodies.spin[i] - pose[SPIN], inertia, time_step)
        torque[i] += moment
    return ContactHistory(i, np.full(len(i), -1 - index), contact.history, contact.overlap, rolling)


def _rolling(
    law: ContactLaw,
    contact: ContactForce,
    old: ContactHistory,
    spin: FloatArray,
    inertia: FloatArray,
    time_step: float,
) -> tuple[FloatArray, FloatArray]:
    return rolling_moment(
        old.rolling_moment,
        spin,
        contact.normal,
        contact.overlap,
        old.overlap,
        contact.effective_radius,
        inertia,
        law.effective_modulus,
        law.rolling_friction,
        time_step,
    )


def _sums(index: np.ndarray, values: FloatArray, count: int) -> FloatArray:
    """Sum of the ``(M, 3)`` values of each particle, ``(count, 3)``."""
    # Several times as fast as np.add.at.
    return np.stack([np.bincount(index, values[:, axis], count) for axis in range(3)], axis=1)


def _recall(history: ContactHistory, first: np.ndarray, second: np.ndarray) -> ContactHistory:
    """What is remembered of each contact (first, second); zeros, and an overlap of 0, where it is new."""
    force, overlap, moment = np.zeros((len(first), 3)), np.zeros(len(first)), np.zeros((len(first), 3))
    _, row, old_row = np.intersect1d(
        _contact_key(first, second),
        _contact_key(history.first, history.second),
        assume_unique=True,
        return_indices=True,
    )
    force[row], overlap[row] = history.force[old_row], history.overlap[old_row]
    moment[row] = history.rolling_moment[old_row]
    return ContactHistory(first, second, force, overlap, moment)


def _contact_key(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """One number for each contact; walls (negative seconds) included."""
    return first.astype(np.int64) * 2**32 + second.astype(np.int64)
