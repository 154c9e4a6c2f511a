"""The reference engine: the laws of the other files, vectorised, one step after the other, to be read and trusted."""

from dataclasses import replace

import numpy as np

from gran_bench.dem.contact import ContactForce, ContactLaw, contact_force, sphere_mass
from gran_bench.dem.energy import (
    IMPULSE,
    KINDS,
    LOSSES,
    LOST_NORMAL,
    LOST_SHEAR,
    SPECTRA,
    SPRINGS,
    TWIST,
    WORK,
    Work,
    bins_of,
    contact_losses,
    followed,
    rolling_losses,
)  # fmt: skip
from gran_bench.dem.integrate import Divergence, Peaks, Physics, check_finite, into_period
from gran_bench.dem.rolling import CONTACT_INERTIA, rolling_moment
from gran_bench.dem.seams import wall_touching
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
        self._radius, self._history = np.asarray(state.radius, np.float64), followed(state.history, physics.power)
        self._mass = sphere_mass(physics.density[state.material], self._radius)
        self._inertia = 0.4 * self._mass * self._radius**2
        # What the velocity still gains until the end of the step, if the acceleration stays.
        self._gain, self._spin_gain = np.zeros_like(self._velocity), np.zeros_like(self._spin)
        self._peaks, self._step, self._work = Peaks(), 0, Work.none(walls.shape[1])
        self.set_walls(walls)
        if held is None:
            self._evaluate(0.0)
        else:
            self._force, self._torque = held.force, held.torque

    def set_walls(self, walls: FloatArray) -> None:
        """Gives the poses of the steps to come, the first of them of this pause."""
        self._walls, self._first_pose = walls, self._step

    def run(self, steps: int) -> None:
        """Goes on, so many steps; a :class:`Divergence` where a speed crosses a quarter of a radius in a step."""
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

    def take_work(self) -> Work:
        """What walls and contacts did since it was last asked for."""
        work, self._work = self._work, Work.none(len(self._work.walls))
        return work

    def _kick(self) -> None:
        """Half a step of the velocities."""
        half = 0.5 * self._dt
        self._gain = half * (self._force / self._mass[:, None] + self._physics.gravity)
        self._velocity += self._gain
        self._spin_gain = half * self._torque / self._inertia[:, None]
        self._spin += self._spin_gain

    def _evaluate(self, duration: float) -> None:
        """Forces and torques, and the history, of this instant; slip loads the history for so many s."""
        self._force, self._torque = np.zeros_like(self._position), np.zeros_like(self._position)
        walls = self._walls[self._step - self._first_pose]
        parts = [self._pair_loads(duration)]
        on_walls, self._history = wall_touching(walls, self._position, self._radius, self._history)
        parts += [self._wall_loads(w, walls[w], *touching, duration) for w, touching in enumerate(on_walls)]
        names = ("first", "second", "force", "overlap", "rolling_moment", "ledger")
        before = self._history
        self._history = ContactHistory(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
        if self._physics.power and duration:
            self._close(before)
            self._work.steps += 1

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
            surface_spin_gain=slip_i[:, None] * self._spin_gain[i] + slip_j[:, None] * self._spin_gain[j],
            spin_gain=self._spin_gain[i] - self._spin_gain[j],
            time_step=duration,
        )  # fmt: skip
        self._force += _sums(i, contact.force, count) - _sums(j, contact.force, count)
        self._torque += _sums(i, arm[:, None] * contact.twist, count)
        self._torque += _sums(j, (distance - arm)[:, None] * contact.twist, count)
        if physics.rolling:
            self._torque += _sums(i, moment, count) - _sums(j, moment, count)
        return history

    def _wall_loads(
        self, index: int, pose: FloatArray, i: np.ndarray, distance: FloatArray, normal: FloatArray, duration: float
    ) -> ContactHistory:
        """Adds the loads of one wall; returns what its contacts remember."""
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
            surface_spin_gain=arm * self._spin_gain[i],
            spin_gain=self._spin_gain[i],
            time_step=duration,
        )  # fmt: skip
        if physics.power:
            self._count_wall(index, pose, point, contact.force, moment, duration)
        self._force[i] += contact.force
        self._torque[i] += arm * contact.twist
        if physics.rolling:
            self._torque[i] += moment
        return history

    def _contacts(
        self, first: np.ndarray, second: np.ndarray, laws: FloatArray, peak: str, diameter: FloatArray,
        spin: FloatArray, inertia: FloatArray, surface_spin_gain: FloatArray, spin_gain: FloatArray,
        **given: FloatArray | float,
    ) -> tuple[ContactForce, FloatArray, ContactHistory]:  # fmt: skip
        """What contacts of one kind do, by :func:`contact_force`, their rolling moments, and what they remember."""
        law, old = ContactLaw.from_constants(laws), _recall(self._history, first, second)
        contact = contact_force(law, history=old.force, overlap_before=old.overlap, **given)
        overlap, moment, remembered = given["overlap"], old.rolling_moment, old.rolling_moment
        if len(first):
            approach = np.einsum("mk,mk->m", given["velocity"], given["normal"]).max()
            found = Peaks(share=float((overlap / diameter).max()), approach=float(approach))
            self._peaks = Peaks(*map(max, self._peaks, found._replace(**{peak: float(overlap.max())})))
        if self._physics.rolling:
            moment, remembered = rolling_moment(
                old.rolling_moment, spin, given["normal"], overlap, old.overlap, given["effective_radius"], inertia,
                law.effective_modulus, law.rolling_friction, given["time_step"],
            )  # fmt: skip
        ledger = old.ledger
        if self._physics.power and len(first):
            ledger = self._count(int(peak != "overlap"), law, contact, moment, remembered, old, spin, spin_gain,
                                 surface_spin_gain, given)  # fmt: skip
        return contact, moment, ContactHistory(first, second, contact.history, overlap, remembered, ledger)

    def _count(
        self, kind: int, law: ContactLaw, contact: ContactForce, moment: FloatArray, remembered: FloatArray,
        old: ContactHistory, spin: FloatArray, spin_gain: FloatArray, surface_spin_gain: FloatArray, given: dict,
    ) -> FloatArray:  # fmt: skip
        """Counts what contacts of one kind lose; returns their rows of the ledger."""
        ledger, duration, normal = old.ledger.copy(), given["time_step"], given["normal"]
        losses, springs = np.zeros((len(ledger), len(LOSSES))), np.zeros(len(ledger))
        losses[:, :4], springs = contact_losses(
            law, contact, history=old.force, overlap_before=old.overlap, surface_spin_gain=surface_spin_gain, **given
        )
        if self._physics.rolling:
            losses[:, 4], holds = rolling_losses(
                law, normal=normal, overlap=given["overlap"], overlap_before=old.overlap,
                effective_radius=given["effective_radius"], spin=spin, spin_gain=spin_gain,
                history=old.rolling_moment, moment=moment, kept=remembered, time_step=duration,
            )  # fmt: skip
            springs = springs + holds
        ledger[:, SPRINGS] = springs
        if duration:
            self._work.lost[kind] += losses.sum(axis=0)
            ledger[:, LOST_NORMAL] += losses[:, 0]
            ledger[:, LOST_SHEAR] += losses[:, 1:4].sum(axis=1)
            approach = np.einsum("mk,mk->m", given["velocity"], normal)
            impact = np.where(approach > 0.0, 0.5 * given["effective_mass"] * approach**2, 0.0)
            self._spectrum(kind, "impact", impact[old.overlap == 0.0])
        return ledger

    def _count_wall(
        self, index: int, pose: FloatArray, point: FloatArray, force: FloatArray, moment: FloatArray, duration: float
    ) -> None:
        """Counts what a wall does to the spheres."""
        row = self._work.walls[index]
        row[IMPULSE] += duration * force.sum(axis=0)
        row[TWIST] += duration * np.cross(point, force).sum(axis=0)
        row[WORK] += duration * np.einsum("mk,mk->", force, surface_velocity(pose, point))
        if self._physics.rolling:
            row[TWIST] += duration * moment.sum(axis=0)
            row[WORK] += duration * moment.sum(axis=0) @ pose[SPIN]

    def _close(self, before: ContactHistory) -> None:
        """Counts the contacts that have ended, by what they have lost."""
        ended = ~np.isin(_names(before.first, before.second), _names(self._history.first, self._history.second))
        for kind in range(len(KINDS)):
            rows = before.ledger[ended & ((before.second < 0) == bool(kind))]
            self._work.lost[kind, LOSSES.index("release")] += rows[:, SPRINGS].sum()
            self._spectrum(kind, "normal", rows[:, LOST_NORMAL])
            self._spectrum(kind, "shear", rows[:, LOST_SHEAR] + rows[:, SPRINGS])

    def _spectrum(self, kind: int, name: str, energy: FloatArray) -> None:
        np.add.at(self._work.spectra[kind, SPECTRA.index(name)], bins_of(energy), 1)


def _sums(index: np.ndarray, values: FloatArray, count: int) -> FloatArray:
    """Sum of the ``(M, 3)`` values of each particle, ``(count, 3)``."""
    # Several times as fast as np.add.at.
    return np.stack([np.bincount(index, values[:, axis], count) for axis in range(3)], axis=1)


def _recall(history: ContactHistory, first: np.ndarray, second: np.ndarray) -> ContactHistory:
    """What is remembered of each contact (first, second); zeros, and an overlap of 0, where it is new."""
    force, overlap, moment = np.zeros((len(first), 3)), np.zeros(len(first)), np.zeros((len(first), 3))
    ledger = np.zeros((len(first), history.ledger.shape[1]))
    keys, old_keys = _names(first, second), _names(history.first, history.second)
    _, row, old = np.intersect1d(keys, old_keys, assume_unique=True, return_indices=True)
    ledger[row] = history.ledger[old]
    force[row], overlap[row], moment[row] = history.force[old], history.overlap[old], history.rolling_moment[old]
    return ContactHistory(first, second, force, overlap, moment, ledger)


def _names(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """One number for each contact; walls (negative seconds) included."""
    return first.astype(np.int64) * 2**32 + second
