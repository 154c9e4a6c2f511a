"""The reference engine: the laws of the other files, vectorised, one step after the other, to be read and trusted.

Pairs come from a KD-tree at every step; nothing is sorted, packed or remembered but the contacts themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gran_bench.dem.contact import ContactForce, ContactLaw, contact_force, sphere_mass
from gran_bench.dem.integrate import Divergence, Peaks, Physics, check_finite, into_period
from gran_bench.dem.rolling import CONTACT_INERTIA, rolling_moment
from gran_bench.dem.seams import Touching, wall_touching
from gran_bench.dem.walls import SPIN, surface_velocity
from gran_bench.neighbors import nearest_image, tree_pairs
from gran_bench.state import ContactHistory, FloatArray, Held, ParticleState


@dataclass
class _Bodies:
    """The particles while they move, ``(N, 3)`` and ``(N,)`` arrays, and what their contacts remember and reached."""

    position: FloatArray
    velocity: FloatArray
    velocity_gain: FloatArray
    spin: FloatArray
    radius: FloatArray
    mass: FloatArray
    inertia: FloatArray
    material: np.ndarray
    history: ContactHistory
    peaks: Peaks


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
    stretch = Stretch(state, physics, time_step, walls)
    stretch.run(len(walls) - 1)
    return stretch.state()


class Stretch:
    """What :class:`gran_bench.dem.fast.engine.Stretch` is, with the same arguments and methods."""

    def __init__(
        self, state: ParticleState, physics: Physics, time_step: float, walls: FloatArray, held: Held | None = None
    ) -> None:
        position, velocity, spin = (
            np.array(a, np.float64) for a in (state.position, state.velocity, state.angular_velocity)
        )
        check_finite(0, position, velocity, spin)
        radius = np.asarray(state.radius, np.float64)
        mass = sphere_mass(physics.density[state.material], radius)
        inertia = 0.4 * mass * radius**2
        self._given, self._physics, self._time_step = state, physics, time_step
        self._bodies = _Bodies(
            position, velocity, np.zeros_like(velocity), spin, radius, mass, inertia, state.material, state.history,
            Peaks(),
        )  # fmt: skip
        self._step, self._fastest = 0, 0.25 * radius.min() / time_step
        self.set_walls(walls)
        if held is None:
            self._force, self._torque = _loads(self._bodies, physics, 0.0, walls[0])
        else:
            self._force, self._torque = held.force, held.torque

    def set_walls(self, walls: FloatArray) -> None:
        """Gives the poses of the steps to come, the first of them of this pause."""
        self._walls, self._first_pose = walls, self._step

    def run(self, steps: int) -> None:
        """Goes on, so many steps."""
        bodies, physics, dt = self._bodies, self._physics, self._time_step
        for _ in range(steps):
            _kick(bodies, physics, self._force, self._torque, 0.5 * dt)
            _check_speeds(bodies, self._fastest, self._step)
            bodies.position += dt * bodies.velocity
            self._step += 1
            self._force, self._torque = _loads(bodies, physics, dt, self._walls[self._step - self._first_pose])
            _kick(bodies, physics, self._force, self._torque, 0.5 * dt)

    def state(self) -> ParticleState:
        """The state of this pause, with its touching contacts and what they remember."""
        bodies = self._bodies
        check_finite(self._step, bodies.position, bodies.velocity, bodies.spin)
        return replace(
            self._given,
            position=into_period(bodies.position.copy(), self._physics.period),
            velocity=bodies.velocity.copy(),
            angular_velocity=bodies.spin.copy(),
            time=self._given.time + self._step * self._time_step,
            history=bodies.history,
        )

    def held(self) -> Held:
        """What goes on from this pause beside the state."""
        return Held(self._bodies.position.copy(), self._force, self._torque, np.arange(self._given.count))

    def take_peaks(self) -> Peaks:
        """Largest overlaps and approach since they were last asked for."""
        peaks, self._bodies.peaks = self._bodies.peaks, Peaks()
        return peaks


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
    approach = np.einsum("mk,mk->m", bodies.velocity[i] - bodies.velocity[j], normal)
    _watch(bodies, contact.overlap, radius[i] + radius[j], approach, "overlap")
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
    approach = np.einsum("mk,mk->m", bodies.velocity[i] - surface_velocity(pose, point), normal)
    _watch(bodies, contact.overlap, 2.0 * bodies.radius[i], approach, "wall_overlap")
    force[i] += contact.force
    torque[i] += arm[:, None] * contact.twist
    rolling = old.rolling_moment
    if physics.rolling:
        inertia = CONTACT_INERTIA * bodies.mass[i] * bodies.radius[i] ** 2
        # What rolls on a turning wall rolls against the wall's own rotation.
        moment, rolling = _rolling(law, contact, old, bodies.spin[i] - pose[SPIN], inertia, time_step)
        torque[i] += moment
    return ContactHistory(i, np.full(len(i), -1 - index), contact.history, contact.overlap, rolling)


def _watch(bodies: _Bodies, overlap: FloatArray, diameter: FloatArray, approach: FloatArray, kind: str) -> None:
    """Keeps the most that contacts of one kind reached."""
    if len(overlap):
        found = Peaks(share=float((overlap / diameter).max()), approach=float(approach.max()))
        bodies.peaks = bodies.peaks.and_of(found._replace(**{kind: float(overlap.max())}))


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
