"""The reference engine: the laws of the other files, vectorised, one step after the other, to be read and trusted.

Pairs come from a KD-tree at every step; nothing is sorted, packed or remembered but the contacts themselves.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gran_bench.dem.contact import ContactForce, ContactLaw, contact_force, sphere_mass
from gran_bench.dem.integrate import Divergence, Peaks, Physics, check_finite, into_period
from gran_bench.dem.rolling import CONTACT_INERTIA, rolling_moment
from gran_bench.dem.seams import Touching, wall_touching
from gran_bench.dem.walls import SPIN, surface_velocity
from gran_bench.neighbors import nearest_image, tree_pairs
from gran_bench.state import ContactHistory, FloatArray, Held, ParticleState


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
        self._position, self._velocity, self._spin = (
            np.array(a, np.float64) for a in (state.position, state.velocity, state.angular_velocity)
        )
        check_finite(0, self._position, self._velocity, self._spin)
        self._given, self._physics, self._dt = state, physics, time_step
        self._radius, self._history = np.asarray(state.radius, np.float64), state.history
        self._mass = sphere_mass(physics.density[state.material], self._radius)
        self._inertia = 0.4 * self._mass * self._radius**2
        # What the velocity still gains until the end of the step, if the acceleration stays.
        self._gain, self._peaks, self._step = np.zeros_like(self._velocity), Peaks(), 0
        self.set_walls(walls)
        if held is None:
            self._evaluate(0.0)
        else:
            self._force, self._torque = held.force, held.torque

    def set_walls(self, walls: FloatArray) -> None:
        """Gives the poses of the steps to come, the first of them of this pause."""
        self._walls, self._first_pose = walls, self._step

    def run(self, steps: int) -> None:
        """Goes on, so many steps.

        Raises:
            Divergence: a speed that crosses a quarter of a radius in a step, or is not finite.
        """
        fastest = 0.25 * self._radius.min() / self._dt
        for _ in range(steps):
            self._kick()
            wild = np.flatnonzero(~(np.linalg.norm(self._velocity, axis=1) <= fastest))
            if len(wild):
                raise Divergence(int(wild[0]), self._step, self._position, self._velocity, self._spin)
            self._position += self._dt * self._velocity
            self._step += 1
            self._evaluate(self._dt)
            self._kick()

    def state(self) -> ParticleState:
        """The state of this pause, with its touching contacts and what they remember."""
        check_finite(self._step, self._position, self._velocity, self._spin)
        return replace(
            self._given,
            position=into_period(self._position.copy(), self._physics.period),
            velocity=self._velocity.copy(),
            angular_velocity=self._spin.copy(),
            time=self._given.time + self._step * self._dt,
            history=self._history,
        )

    def held(self) -> Held:
        """What goes on from this pause beside the state."""
        return Held(self._position.copy(), self._force, self._torque, np.arange(self._given.count))

    def take_peaks(self) -> Peaks:
        """Largest overlaps and approach since they were last asked for."""
        peaks, self._peaks = self._peaks, Peaks()
        return peaks

    def _kick(self) -> None:
        """Half a step of the velocities."""
        half = 0.5 * self._dt
        self._gain = half * (self._force / self._mass[:, None] + self._physics.gravity)
        self._velocity += self._gain
        self._spin += half * self._torque / self._inertia[:, None]

    def _evaluate(self, duration: float) -> None:
        """Forces and torques, and the history, of this instant; slip loads the history for so many s."""
        self._force, self._torque = np.zeros_like(self._position), np.zeros_like(self._position)
        walls = self._walls[self._step - self._first_pose]
        parts = [self._pair_loads(duration)]
        on_walls, self._history = wall_touching(walls, self._position, self._radius, self._history)
        parts += [self._wall_loads(w, walls[w], touching, duration) for w, touching in enumerate(on_walls)]
        names = ("first", "second", "force", "overlap", "rolling_moment")
        self._history = ContactHistory(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def _pair_loads(self, duration: float) -> ContactHistory:
        """Adds the loads of all touching pairs; returns what they remember."""
        radius, mass, velocity, spin, gain = self._radius, self._mass, self._velocity, self._spin, self._gain
        physics, count = self._physics, len(self._radius)
        pairs = tree_pairs(self._position, 2.0 * radius.max(), physics.period)
        offset = nearest_image(self._position[pairs[:, 1]] - self._position[pairs[:, 0]], physics.period)
        distance = np.linalg.norm(offset, axis=1)
        touching = distance < radius[pairs[:, 0]] + radius[pairs[:, 1]]
        i, j = pairs[touching].T
        offset, distance = offset[touching], distance[touching]
        # Both lever arms end on the plane of the circle in which the spheres intersect.
        arm = 0.5 * (distance + (radius[i] ** 2 - radius[j] ** 2) / distance)
        # Those that slip is measured with; LAMMPS' are longer (contact.py).
        slip_i, slip_j = (radius[i], radius[j]) if physics.full_radius else (arm, distance - arm)
        about_contact = CONTACT_INERTIA * mass * radius**2
        contact, moment, history = self._contacts(
            i, j, physics.pair_laws[self._given.material[i], self._given.material[j]], "overlap", radius[i] + radius[j],
            spin[i] - spin[j], about_contact[i] * about_contact[j] / (about_contact[i] + about_contact[j]),
            normal=offset / distance[:, None],
            overlap=radius[i] + radius[j] - distance,
            effective_radius=radius[i] * radius[j] / (radius[i] + radius[j]),
            effective_mass=mass[i] * mass[j] / (mass[i] + mass[j]),
            velocity=velocity[i] - velocity[j],
            velocity_gain=gain[i] - gain[j],
            surface_spin=slip_i[:, None] * spin[i] + slip_j[:, None] * spin[j],
            time_step=duration,
        )  # fmt: skip
        self._force += _sums(i, contact.force, count) - _sums(j, contact.force, count)
        self._torque += _sums(i, arm[:, None] * contact.twist, count)
        self._torque += _sums(j, (distance - arm)[:, None] * contact.twist, count)
        if physics.rolling:
            self._torque += _sums(i, moment, count) - _sums(j, moment, count)
        return history

    def _wall_loads(self, index: int, pose: FloatArray, touching: Touching, duration: float) -> ContactHistory:
        """Adds the loads of one wall; returns what its contacts remember."""
        i, distance, normal = touching
        radius, mass, spin, physics = self._radius[i], self._mass[i], self._spin[i], self._physics
        point = self._position[i] + distance[:, None] * normal
        arm = (radius if physics.full_radius else distance)[:, None]
        laws = physics.wall_laws[self._given.material[i], index]
        contact, moment, history = self._contacts(
            i, np.full(len(i), -1 - index), laws, "wall_overlap", 2.0 * radius,
            # What rolls on a turning wall rolls against the wall's own rotation.
            spin - pose[SPIN], CONTACT_INERTIA * mass * radius**2,
            normal=normal,
            overlap=radius - distance,
            effective_radius=radius,
            effective_mass=mass,
            velocity=self._velocity[i] - surface_velocity(pose, point),
            velocity_gain=self._gain[i],
            surface_spin=arm * spin,
            time_step=duration,
        )  # fmt: skip
        self._force[i] += contact.force
        self._torque[i] += arm * contact.twist
        if physics.rolling:
            self._torque[i] += moment
        return history

    def _contacts(
        self, first: np.ndarray, second: np.ndarray, laws: FloatArray, peak: str, diameter: FloatArray,
        spin: FloatArray, inertia: FloatArray, **given: FloatArray | float,
    ) -> tuple[ContactForce, FloatArray, ContactHistory]:  # fmt: skip
        """What contacts of one kind do, their rolling moments and what they remember; the most of them is kept.

        Spin and inertia are those of rolling; what is ``given`` goes to :func:`contact_force`.
        """
        law, old = ContactLaw.from_constants(laws), _recall(self._history, first, second)
        contact = contact_force(law, history=old.force, overlap_before=old.overlap, **given)
        overlap, moment, remembered = given["overlap"], old.rolling_moment, old.rolling_moment
        if len(first):
            approach = np.einsum("mk,mk->m", given["velocity"], given["normal"]).max()
            found = Peaks(share=float((overlap / diameter).max()), approach=float(approach))
            self._peaks = self._peaks.and_of(found._replace(**{peak: float(overlap.max())}))
        if self._physics.rolling:
            moment, remembered = rolling_moment(
                old.rolling_moment, spin, given["normal"], overlap, old.overlap, given["effective_radius"], inertia,
                law.effective_modulus, law.rolling_friction, given["time_step"],
            )  # fmt: skip
        return contact, moment, ContactHistory(first, second, contact.history, overlap, remembered)


def _sums(index: np.ndarray, values: FloatArray, count: int) -> FloatArray:
    """Sum of the ``(M, 3)`` values of each particle, ``(count, 3)``."""
    # Several times as fast as np.add.at.
    return np.stack([np.bincount(index, values[:, axis], count) for axis in range(3)], axis=1)


def _recall(history: ContactHistory, first: np.ndarray, second: np.ndarray) -> ContactHistory:
    """What is remembered of each contact (first, second); zeros, and an overlap of 0, where it is new."""
    force, overlap, moment = np.zeros((len(first), 3)), np.zeros(len(first)), np.zeros((len(first), 3))
    # One number for each contact; walls (negative seconds) included.
    keys, old_keys = (a.astype(np.int64) * 2**32 + b for a, b in ((first, second), (history.first, history.second)))
    _, row, old = np.intersect1d(keys, old_keys, assume_unique=True, return_indices=True)
    force[row], overlap[row], moment[row] = history.force[old], history.overlap[old], history.rolling_moment[old]
    return ContactHistory(first, second, force, overlap, moment)
