"""The reference engine: the laws of the other files, vectorised, one step after the other, to be read and trusted.

A step of velocity Verlet is a kick, a drift, the forces of all contacts, and another kick (integrate.py).
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from gran_bench.dem.contact import ContactForce, ContactLaw, Contacts, contact_force, sphere_mass
from gran_bench.dem.energy import Work, count_contacts, count_ended, count_walls, followed
from gran_bench.dem.integrate import Divergence, Peaks, Physics, check_finite, into_period
from gran_bench.dem.rolling import CONTACT_INERTIA, rolling_moment
from gran_bench.dem.seams import wall_touching
from gran_bench.dem.vectors import dot, take_rows
from gran_bench.dem.walls import SPIN, surface_velocity
from gran_bench.neighbors import nearest_image, tree_pairs
from gran_bench.state import ContactHistory, FloatArray, Held, Moving, ParticleState

# Of the list of pairs, in diameters of the largest sphere, at most. A wider one takes fewer trees and longer steps.
SKIN = 0.3
# Indices, distances and directions where there is no wall.
NOBODY = np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3))


def advance(state: ParticleState, physics: Physics, time_step: float, walls: FloatArray) -> ParticleState:
    """The state after the steps that ``walls`` has poses of: a :class:`Stretch` from beginning to end."""
    stretch = Stretch(state, physics, time_step, walls)
    stretch.run(len(walls) - 1)
    return stretch.state()


class Stretch:
    """What :class:`gran_bench.dem.fast.engine.Stretch` is, with the same arguments and methods."""

    def __init__(
        self, state: ParticleState, physics: Physics, time_step: float, walls: FloatArray, held: Held | None = None
    ) -> None:
        # Columns lie together in memory: what runs along them is three times as fast as along rows of three.
        self._position, self._velocity, self._spin = (
            np.array(a, np.float64, order="F") for a in (state.position, state.velocity, state.angular_velocity)
        )
        check_finite(0, self._position, self._velocity, self._spin)
        self._given, self._physics, self._dt = state, physics, time_step
        self._radius = np.asarray(state.radius, np.float64)
        self._mass = sphere_mass(physics.density[state.material], self._radius)
        self._inertia = 0.4 * self._mass * self._radius**2
        self._about_contact = CONTACT_INERTIA * self._mass * self._radius**2
        # What the velocity still gains until the end of the step, if the acceleration stays.
        self._gain, self._spin_gain = np.zeros_like(self._velocity), np.zeros_like(self._spin)
        self._peaks, self._work, self._step = Peaks(), Work.none(len(walls[0])), 0
        self._history = followed(state.history, physics.power)
        self.set_walls(walls)
        self._list_pairs()
        if held is None:
            self._evaluate(0.0)
        else:
            self._load(held.force, held.torque)

    def set_walls(self, walls: FloatArray) -> None:
        """Gives the poses of the steps to come, the first of them of this pause."""
        self._walls, self._first_pose = walls, self._step

    def sort(self, physics: Physics) -> None:
        """Brings positions into their period; there is no order to renew."""
        into_period(self._position, physics.period)
        self._list_pairs()

    def run(self, steps: int) -> None:
        """Goes on, so many steps; a :class:`Divergence` where a speed crosses a quarter of a radius in a step."""
        fastest = 0.25 * self._radius.min() / self._dt
        for _ in range(steps):
            self._kick()
            squared = dot(self._velocity, self._velocity)
            if not squared.max() <= fastest**2:
                wild = int(np.argmax(~(squared <= fastest**2)))
                raise Divergence(wild, self._step, self._position, self._velocity, self._spin)
            self._position += self._dt * self._velocity
            self._step += 1
            self._evaluate(self._dt)
            self._kick()

    def moving(self, into: Moving | None = None) -> Moving:
        """Position, velocity and spin of this pause, ``(N, 3)`` each, in arrays if given."""
        moving = self._position, self._velocity, self._spin
        check_finite(self._step, *moving)
        into = tuple(np.empty((3, *self._position.shape))) if into is None else into
        for room, array in zip(into, moving, strict=True):
            room[:] = array
        into_period(into[0], self._physics.period)
        return into

    def overlaps(self) -> tuple[FloatArray, FloatArray]:
        """Of the pairs and of the walls that touch, m."""
        pairs = self._history.second >= 0
        return self._history.overlap[pairs], self._history.overlap[~pairs]

    def state(self) -> ParticleState:
        """The state of this pause, with its touching contacts and what they remember."""
        position, velocity, spin = self.moving()
        time = self._given.time + self._step * self._dt
        return replace(
            self._given,
            position=position, velocity=velocity, angular_velocity=spin, time=time, history=self._history,
        )  # fmt: skip

    def held(self) -> Held:
        """What goes on from this pause beside the state."""
        return Held(self._position.copy(), self._force, self._torque, np.arange(self._given.count))

    def take_peaks(self) -> Peaks:
        """Largest overlaps and approach since they were last asked for."""
        peaks, self._peaks = self._peaks, Peaks()
        return peaks

    def take_work(self) -> Work:
        """What walls and contacts did since it was last asked for."""
        work, self._work = self._work, Work.none(len(self._work.walls))
        return work

    def _kick(self) -> None:
        """Half a step of the velocities."""
        self._velocity += self._gain
        self._spin += self._spin_gain

    def _load(self, force: FloatArray, torque: FloatArray) -> None:
        """Forces and torques from now on, and what they give in half a step."""
        self._force, self._torque, half = force, torque, 0.5 * self._dt
        self._gain = half * (force / self._mass[:, None] + self._physics.gravity)
        self._spin_gain = (half / self._inertia)[:, None] * torque

    def _list_pairs(self) -> None:
        """Pairs that may touch until a sphere has moved by half the skin, and what they are."""
        radius, mass, about, physics = self._radius, self._mass, self._about_contact, self._physics
        diameter, kind = 2.0 * radius.max(), self._given.material
        self._skin, self._listed_at = min(physics.skin, SKIN * diameter), self._position.copy()
        i, j = self._pairs = tree_pairs(self._position, diameter + self._skin, physics.period).T.copy()
        self._pair_sizes = (
            np.asfortranarray(physics.pair_laws[kind[i], kind[j]]),
            radius[i] + radius[j],
            radius[i] * radius[j] / (radius[i] + radius[j]),
            mass[i] * mass[j] / (mass[i] + mass[j]),
            about[i] * about[j] / (about[i] + about[j]),
        )

    def _evaluate(self, duration: float) -> None:
        """Forces and torques, and the history, of this instant; slip loads the history for so many s."""
        moved = self._position - self._listed_at
        if 4.0 * dot(moved, moved).max() > self._skin**2:
            self._list_pairs()
        pairs, walls = self._touching_pairs(), self._touching_walls()
        every = Contacts(*map(_joined, zip(pairs, walls, strict=True)))
        law, rolling = ContactLaw.from_constants(every.law), self._physics.rolling
        names = ("force", "overlap", "rolling_moment")[: 2 + rolling]
        force, overlap, *moment = _recall(self._history, every.first, every.second, *names)
        contact = contact_force(
            law,
            normal=every.normal,
            overlap=every.overlap,
            effective_radius=every.effective_radius,
            effective_mass=every.effective_mass,
            velocity=every.velocity,
            velocity_gain=every.gain,
            surface_spin=every.surface_spin,
            history=force,
            overlap_before=overlap,
            time_step=duration,
        )
        first, second, of_pairs, count = every.first, pairs.second, slice(len(pairs.first)), len(self._radius)
        total = _sums(first, contact.force, count) - _sums(second, contact.force[of_pairs], count)
        torque = _sums(first, every.arm[:, None] * contact.twist, count)
        torque += _sums(second, pairs.other_arm[:, None] * contact.twist[of_pairs], count)
        kept = rolled = None
        if rolling:
            rolled = moment, kept = rolling_moment(
                *moment, every.spin, every.normal, every.overlap, overlap, every.effective_radius,
                every.effective_inertia, law.effective_modulus, law.rolling_friction, duration,
            )  # fmt: skip
            torque += _sums(first, moment, count) - _sums(second, moment[of_pairs], count)
        ledger = self._counted(every, contact, rolled, duration) if self._physics.power else None
        self._load(total, torque)
        self._history = ContactHistory(first, every.second, contact.history, every.overlap, kept, ledger)
        found = Peaks(
            overlap=float(pairs.overlap.max(initial=0.0)),
            wall_overlap=float(walls.overlap.max(initial=0.0)),
            share=float((every.overlap / every.diameter).max(initial=0.0)),
            approach=float(dot(every.velocity, every.normal).max(initial=0.0)),
        )
        self._peaks = Peaks(*map(max, self._peaks, found))

    def _counted(
        self, every: Contacts, contact: ContactForce, rolled: tuple[FloatArray, FloatArray] | None, duration: float
    ) -> FloatArray:
        """Counts the energy of a step (energy.py), before its loads; returns what its contacts have lost so far."""
        first, second, history, work = every.first, every.second, self._history, self._work
        names, walls = ("force", "overlap", "rolling_moment", "ledger"), np.flatnonzero(second < 0)
        before = ContactHistory(first, second, *_recall(history, first, second, *names))
        radius = self._radius if self._physics.full_radius else None
        ledger = count_contacts(work, every, contact, rolled, before, self._spin_gain, radius, duration)
        at_walls = Contacts(*(take_rows(array, walls) if len(array) else array for array in every))
        distance = self._radius[at_walls.first] - at_walls.overlap
        point, poses = take_rows(self._position, at_walls.first) + distance[:, None] * at_walls.normal, self._poses()
        moment = None if rolled is None else rolled[0][walls]
        count_walls(work, at_walls, contact.force[walls], moment, point, poses, duration)
        if duration:
            count_ended(work, history, ~np.isin(_numbers(history.first, history.second), _numbers(first, second)))
        return ledger

    def _poses(self) -> FloatArray:
        """Of the walls at this instant."""
        return self._walls[self._step - self._first_pose]

    def _touching_pairs(self) -> Contacts:
        """The listed pairs that touch."""
        i, j = self._pairs
        offset = nearest_image(take_rows(self._position, j) - take_rows(self._position, i), self._physics.period)
        distance = np.sqrt(dot(offset, offset))
        near = np.flatnonzero(distance < self._pair_sizes[1])
        i, j, offset, distance = (take_rows(array, near) for array in (i, j, offset, distance))
        law, reach, *effective = (take_rows(sizes, near) for sizes in self._pair_sizes)
        # Both lever arms end on the plane of the circle in which the spheres intersect.
        radius_i, radius_j = take_rows(self._radius, i), take_rows(self._radius, j)
        arm = 0.5 * (distance + (radius_i - radius_j) * reach / distance)
        # Those that slip is measured with; LAMMPS' are longer (contact.py).
        slip_i, slip_j = arm, distance - arm
        if self._physics.full_radius:
            slip_i, slip_j = radius_i, radius_j
        spin_i, spin_j = take_rows(self._spin, i), take_rows(self._spin, j)
        return Contacts(
            i, j, reach, law, *effective,
            normal=offset / distance[:, None],
            overlap=reach - distance,
            velocity=take_rows(self._velocity, i) - take_rows(self._velocity, j),
            gain=take_rows(self._gain, i) - take_rows(self._gain, j),
            spin=spin_i - spin_j if self._physics.rolling else NOBODY[2],
            surface_spin=slip_i[:, None] * spin_i + slip_j[:, None] * spin_j,
            arm=arm,
            other_arm=distance - arm,
        )  # fmt: skip

    def _touching_walls(self) -> Contacts:
        """What touches a wall, wall by wall; the history may go over between pieces of a surface."""
        poses, physics = self._poses(), self._physics
        touching, self._history = wall_touching(poses, self._position, self._radius, self._history)
        wall = np.repeat(np.arange(len(poses)), [len(i) for i, _, _ in touching])
        i, distance, normal = map(_joined, zip(*touching, strict=True)) if len(poses) else NOBODY
        pose, radius, spin = take_rows(poses, wall), take_rows(self._radius, i), take_rows(self._spin, i)
        velocity = surface_velocity(pose, take_rows(self._position, i) + distance[:, None] * normal)
        arm = radius if physics.full_radius else distance
        return Contacts(
            i, -1 - wall, 2.0 * radius, physics.wall_laws[self._given.material[i], wall],
            radius, take_rows(self._mass, i), take_rows(self._about_contact, i),
            normal=normal,
            overlap=radius - distance,
            velocity=take_rows(self._velocity, i) - velocity,
            gain=take_rows(self._gain, i),
            # What rolls on a turning wall rolls against the wall's own rotation.
            spin=spin - pose[:, SPIN] if physics.rolling else NOBODY[2],
            surface_spin=arm[:, None] * spin,
            arm=arm,
            other_arm=arm,
        )  # fmt: skip


def _joined(arrays: Iterable[np.ndarray]) -> np.ndarray:
    """One array of all rows."""
    return np.concatenate([array.T for array in arrays], axis=-1).T


def _sums(index: np.ndarray, values: FloatArray, count: int) -> FloatArray:
    """Sum of the ``(M, 3)`` values of each particle, ``(count, 3)``."""
    # Several times as fast as np.add.at.
    return np.stack([np.bincount(index, column, count) for column in values.T]).T


def _recall(history: ContactHistory, first: np.ndarray, second: np.ndarray, *names: str) -> list[FloatArray]:
    """What contacts (first, second) remember, by the names of the history; zeros where they are new."""
    keys, old_keys = _numbers(first, second), _numbers(history.first, history.second)
    _, known, old = np.intersect1d(keys, old_keys, assume_unique=True, return_indices=True)
    row = np.full(len(first), -1)  # the last row, which is zero
    row[known] = old
    kept = [getattr(history, name) for name in names]
    return [take_rows(_joined((array, np.zeros((1, *array.shape[1:])))), row) for array in kept]


def _numbers(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """One number for each contact; walls (negative seconds) included."""
    return first * 2**32 + second
