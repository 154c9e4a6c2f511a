"""The fast engine: a stretch of steps on one or more threads, jitted from one neighbour search to the next.

Threads own chunks of neighbouring particles for the whole stretch and meet twice a step. Lists are in one order, and
the chunks, each with loads of its own that are added in one order, depend on the number of particles alone: so neither
pauses nor skin nor threads change a bit.
"""

from dataclasses import replace

import numpy as np

from gran_bench.dem.energy import Work, followed
from gran_bench.dem.fast import barrier
from gran_bench.dem.fast.bodies import (
    Known,
    as_given,
    bodies_in_order,
    contact_history,
    known_contacts,
    renamed,
    sorted_again,
    take_loads,
    zeros,
)
from gran_bench.dem.fast.contact_blocks import take_peaks
from gran_bench.dem.fast.energy_blocks import Books
from gran_bench.dem.fast.lists import KEPT, Lists, search
from gran_bench.dem.fast.stretch import DUE, FIRST_POSE, PAIRS, PAUSE, SEARCH, STEP, TRAVELLED, WALLS, WHOLE, march
from gran_bench.dem.integrate import Divergence, Peaks, Physics, check_finite, into_period
from gran_bench.dem.walls import PATH
from gran_bench.state import FloatArray, Held, Moving, ParticleState

# Particles from which on a bed is cut into 2, 4, 8, 16 chunks: each large beside what lies at its rim.
CHUNK_SIZES = (1500, 8000, 32000, 128000)


def chunk_bounds(count: int) -> np.ndarray:
    """First particle of each chunk, and the end of the last, ``(C + 1,)``; a function of the number alone."""
    chunks = 2 ** sum(count >= size for size in CHUNK_SIZES)
    return np.array([count * c // chunks for c in range(chunks + 1)], np.int64)


def advance(state: ParticleState, physics: Physics, time_step: float, walls: FloatArray) -> ParticleState:
    """The state after the steps that ``walls`` has poses of: a :class:`Stretch` from beginning to end."""
    stretch = Stretch(state, physics, time_step, walls)
    stretch.run(len(walls) - 1)
    return stretch.state()


class Stretch:
    """Steps of the same particles, which are sorted anew where that is asked for; it pauses wherever a state is.

    Args:
        state, physics, time_step: where it starts, one particle or more; laws, skin, threads, precision; Δt, s.
        walls: ``(steps + 1, W, 22)`` poses of the walls at each force evaluation (walls.py).
        held: forces and order that the state comes with; None where both are its own. Then forces load no history.

    Raises:
        Divergence: a speed that is not a number.
    """

    def __init__(
        self, state: ParticleState, physics: Physics, time_step: float, walls: FloatArray, held: Held | None = None
    ) -> None:
        moving = [np.asarray(a, np.float64) for a in (state.position, state.velocity, state.angular_velocity)]
        # Lists have room for displacements in proportion to speeds, so these must be numbers before any are made.
        check_finite(0, *moving)
        self._given, self._physics, self._time_step = state, physics, time_step
        radius, material = np.asarray(state.radius, np.float64), np.asarray(state.material, np.uint8)
        density, fastest = physics.density[material], 0.25 * float(radius.min()) / time_step
        # Contacts of equal spheres share R*, m* and I_r.
        unequal = bool((radius != radius[0]).any() or (density != density[0]).any())
        several = len(physics.pair_laws) > 1 or bool((physics.wall_laws != physics.wall_laws[:, :1]).any())
        self._diameter = 0.0 if unequal else 2.0 * float(radius[0])
        self._constants = (
            physics.gravity, physics.period, time_step, fastest * fastest,
            physics.tangential, physics.rolling, unequal, several, physics.full_radius,
        )  # fmt: skip
        self._bounds, self._peaks = chunk_bounds(state.count), np.zeros((2, 3))
        chunks = len(self._bounds) - 1
        self._loads, self._reach = tuple(zeros(2, chunks, state.count + 2, 4)), np.zeros(chunks, np.int64)
        self.threads, self._progress = 0, np.array([(0, 0, 0, held is None, 1, 1, 1)])
        order = None if held is None else held.order
        self.bodies = bodies_in_order(*moving, radius, material, physics.density, physics.period, order)
        if held is not None:
            self._load(*(load[self.bodies.order] for load in (held.force, held.torque)))
        self._books = Books.of_chunks(chunks, len(walls[0]), state.count + 2) if physics.power else [None] * chunks
        self._counted, history = 0, followed(state.history, physics.power)
        self._begin(known_contacts(history, self.bodies.row, physics.rolling), len(walls[0]))
        self.set_walls(walls)
        if held is None:
            self.run(0)
        elif not march.overloads:
            # What runs on from held forces compiles now too, and not in a step that is timed.
            Stretch(state, physics, time_step, walls)

    def set_walls(self, walls: FloatArray) -> None:
        """Gives the poses of the steps to come, the first of them of this pause."""
        self._walls = np.array(walls, np.float64, order="C")
        self._progress[:, FIRST_POSE] = self._progress[:, STEP]
        if self._walls[:, :, PATH].any():
            self._outdated = [True] * self.threads  # lists know the way that walls go for as long as poses were given

    def sort(self, physics: Physics) -> None:
        """Brings the particles into the order of where they are now; skin and threads are of ``physics`` from here on.

        As good as a stretch from the state and what is held at this pause, and several times as fast.
        """
        last, contacts = self.bodies, self._contacts()
        self._physics = physics
        self.bodies, before = sorted_again(last, physics.period)
        for loads in self._loads:
            take_loads(loads, before, self._bounds)
        self._begin(renamed(*contacts, np.take(self.bodies.row, last.order)), self._walls.shape[1])

    def _load(self, *loads: FloatArray) -> None:
        """Force and torque of each row, ``(N, 3)``, to the rows of its own chunk."""
        for rows, load in zip(self._loads, loads, strict=True):
            for chunk, part in enumerate(self._chunks()):
                rows[chunk, part, :3] = load[part]

    def _begin(self, known: tuple[Known, Known], walls: int) -> None:
        """Threads that all have ``known``, the contacts that the last evaluation found, and are to search."""
        physics, bounds, chunks = self._physics, self._bounds, len(self._bounds) - 1
        threads = max(1, min(physics.threads, chunks))
        if threads != self.threads:
            if self.threads:
                self._peaks = self._watched()
            self.threads, self._gate, self._told = threads, barrier.new_gate(), np.zeros((threads, 32))
            self._progress = np.repeat(self._progress[:1], threads, axis=0)
            self._shares = [(t * chunks // threads, (t + 1) * chunks // threads) for t in range(threads)]
            self._lists = [Lists.of(self.bodies, bounds, *share, walls, physics) for share in self._shares]
        last = self._last_evaluation()
        self._lists = [lists.remember(known, last) for lists in self._lists]
        self._known = [tuple(np.stack(contacts[:2]) for contacts in known)] * threads
        self._known_at, self._shared_at, self._outdated = [last] * threads, last, [True] * threads
        self._progress[:, PAIRS], self._progress[:, WALLS] = (len(contacts.first) + 1 for contacts in known)

    def run(self, steps: int) -> None:
        """Goes on, so many steps; a :class:`Divergence` where a speed crosses a quarter of a radius in a step."""
        self._progress[:, PAUSE] = self._progress[0, STEP] + steps
        culprit = barrier.run_together(self._march, self.threads, self._gate)[0]
        if culprit >= 0:
            position, velocity, spin = self._as_given(0.0)
            position = into_period(position, self._physics.period)
            raise Divergence(int(self.bodies.order[culprit]), int(self._progress[0, STEP]), position, velocity, spin)

    def _march(self, thread: int) -> int:
        """One thread's share of the steps up to the next pause; returns the row that diverged, or less than 0."""
        progress, bounds, physics = self._progress[thread], self._bounds, self._physics
        chunk, stop = self._shares[thread]
        while True:
            if self._outdated[thread]:
                self._note(thread)
                self._lists[thread] = search(
                    self._lists[thread], self.bodies, bounds, chunk, stop, self._walls,
                    int(progress[STEP] - progress[FIRST_POSE]), self._known_at[thread], physics, self._known[thread],
                )  # fmt: skip
                self._told[thread, TRAVELLED], self._outdated[thread] = np.inf, False
            culprit = march(
                thread, self.threads, self._gate, bounds, self._reach, self._told, progress, *self.bodies[2:],
                *self._loads, *self._lists[thread], physics.pair_laws, physics.wall_laws, self._walls,
                *self._constants, self._books[thread],
            )  # fmt: skip
            if culprit != SEARCH:
                return int(culprit)
            self._outdated[thread] = True

    def _last_evaluation(self, thread: int = 0) -> int:
        return int(self._progress[thread, STEP] - self._progress[thread, DUE])

    def _note(self, thread: int) -> None:
        """Keeps which contacts of a thread the last evaluation found touching, in the order of their histories."""
        last = self._last_evaluation(thread)
        if last != self._known_at[thread]:
            pairs, walls = self._progress[thread, PAIRS], self._progress[thread, WALLS]
            self._known[thread] = self._lists[thread].touched(last, pairs, walls)
            self._known_at[thread] = last

    def _rows(self, name: str) -> list[FloatArray]:
        """Of each thread, the rows of a history of its lists that the last evaluation wrote."""
        last, end = self._last_evaluation(), WALLS if name.startswith("wall_") else PAIRS
        # What was known when they began, all threads know.
        threads = 1 if last == self._shared_at else self.threads
        return [getattr(self._lists[t], name)[last % 2, 1 : self._progress[t, end]] for t in range(threads)]

    def _contacts(self) -> tuple[Known, Known]:
        """Pairs and walls that the last evaluation found touching, by rows."""
        for thread in range(self.threads):
            self._note(thread)
        known = self._known[:1] if self._last_evaluation() == self._shared_at else self._known
        return tuple(
            Known(*np.concatenate(names, axis=1), *(np.concatenate(self._rows(kind + name)) for name in KEPT))
            for kind, names in zip(("", "wall_"), zip(*known, strict=True), strict=True)
        )

    def moving(self, into: Moving | None = None) -> Moving:
        """Position, velocity and spin of this pause, ``(N, 3)`` each, in arrays if given; or a :class:`Divergence`."""
        moving = self._as_given(0.0 if self._progress[0, WHOLE] else 0.5 * self._time_step, into)
        check_finite(int(self._progress[0, STEP]), *moving)
        into_period(moving[0], self._physics.period)
        return moving

    def overlaps(self) -> tuple[FloatArray, FloatArray]:
        """Of the pairs and of the walls that touch, m."""
        return tuple(np.concatenate([slot[:, 3] for slot in self._rows(name)]) for name in ("slot", "wall_slot"))

    def state(self) -> ParticleState:
        """The state of this pause, with its touching contacts and what they remember; or a :class:`Divergence`."""
        position, velocity, spin = self.moving()
        return replace(
            self._given,
            position=position,
            velocity=velocity,
            angular_velocity=spin,
            time=self._given.time + int(self._progress[0, STEP]) * self._time_step,
            history=contact_history(*self._contacts(), self.bodies.order),
        )

    def held(self) -> Held:
        """What goes on from this pause beside the state."""
        row = self.bodies.row
        force, torque = (self._own(rows)[row, :3] for rows in self._loads)
        return Held(self.bodies.sphere[row, :3], force, torque, self.bodies.order)

    def take_peaks(self) -> Peaks:
        """Largest overlaps and approach since they were last asked for."""
        (pairs, walls), self._peaks = self._watched(), np.zeros((2, 3))
        return Peaks(pairs[0], walls[0], max(pairs[1], walls[1]), max(pairs[2], walls[2]))

    def take_work(self) -> Work:
        """What walls and contacts did since it was last asked for."""
        steps, self._counted = int(self._progress[0, STEP]) - self._counted, int(self._progress[0, STEP])
        return self._books[0].take(steps)

    def _watched(self) -> FloatArray:
        """Peaks of pairs and walls, ``(2, 3)``, which the buffers of the blocks then begin anew."""
        for lists in self._lists:
            for buffer, peaks in zip((lists.buffer, lists.wall_buffer), self._peaks, strict=True):
                take_peaks(buffer, peaks, self._diameter)
        return self._peaks

    def _as_given(self, half: float, into: Moving | None = None) -> Moving:
        """What moves, in the order in which it was given; velocities have ``half``, s, of their step to come."""
        bodies, count = self.bodies, len(self.bodies.order)
        into = tuple(np.empty((3, count, 3))) if into is None else into
        as_given(bodies.order, self._bounds, *bodies[2:5], *self._loads, self._physics.gravity, half, *into)
        return into

    def _own(self, rows: FloatArray) -> FloatArray:
        """``(N, 4)`` loads of the particles from the rows of their own chunks."""
        return np.concatenate([rows[chunk, part] for chunk, part in enumerate(self._chunks())])

    def _chunks(self) -> list[slice]:
        return [slice(*self._bounds[c : c + 2]) for c in range(len(self._bounds) - 1)]
