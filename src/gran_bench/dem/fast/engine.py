"""The fast engine: a stretch of steps on one or more threads, jitted from one neighbour search to the next.

Threads own chunks of neighbouring particles for the whole stretch and meet twice a step. Lists are in one order, and
the chunks, each with loads of its own that are added in one order, depend on the number of particles alone: so neither
pauses nor skin nor threads change a bit.
"""

from dataclasses import replace

import numpy as np

from gran_bench.dem.energy import Work, followed
from gran_bench.dem.fast import barrier
from gran_bench.dem.fast.bodies import Known, as_given, bodies_in_order, contact_history, known_contacts
from gran_bench.dem.fast.contact_blocks import take_peaks
from gran_bench.dem.fast.energy_blocks import Books
from gran_bench.dem.fast.lists import Lists, search, zeros
from gran_bench.dem.fast.stretch import DUE, FIRST_POSE, PAIRS, PAUSE, SEARCH, STEP, TRAVELLED, WALLS, WHOLE, march
from gran_bench.dem.integrate import Divergence, Peaks, Physics, check_finite, into_period
from gran_bench.dem.walls import PATH
from gran_bench.state import FloatArray, Held, ParticleState

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
    """Steps that share an order of the particles; it pauses wherever its state is asked for.

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
        self._bounds = chunk_bounds(state.count)
        chunks = len(self._bounds) - 1
        self.threads, self.gate = max(1, min(physics.threads, chunks)), barrier.new_gate()
        self._told, self._reach = np.zeros((self.threads, 32)), np.zeros(chunks, np.int64)
        self._loads = tuple(zeros(2, chunks, state.count + 2, 4))
        self._constants = (
            physics.gravity, physics.period, time_step, fastest * fastest,
            physics.tangential, physics.rolling, unequal, physics.full_radius,
        )  # fmt: skip
        order = None if held is None else held.order
        self.bodies = bodies_in_order(*moving, radius, material, physics.density, physics.period, order)
        self._lists: list[Lists | None] = [None] * self.threads
        history = followed(state.history, physics.power)
        self._known = [known_contacts(history, self.bodies.row, physics.rolling)] * self.threads
        self._books, self._counted = [None] * self.threads, 0
        if physics.power:
            self._books = Books.of_threads(self.threads, chunks, walls.shape[1], state.count + 2)
        self._progress = np.array([(0, 0, 0, held is None, 1, 1, 1)] * self.threads)
        self._known_at = [self._last_evaluation(0)] * self.threads
        self._peaks = np.zeros((self.threads, 2, 3))
        self.set_walls(walls)
        if held is None:
            self.run(0)
            return
        for rows, load in zip(self._loads, (held.force, held.torque), strict=True):
            for chunk, part in enumerate(self._chunks()):
                rows[chunk, part, :3] = load[self.bodies.order[part]]
        if not march.overloads:
            # What runs on from held forces compiles now too, and not in a step that is timed.
            Stretch(state, physics, time_step, walls)

    def set_walls(self, walls: FloatArray) -> None:
        """Gives the poses of the steps to come, the first of them of this pause."""
        self._walls = np.array(walls, np.float64, order="C")
        self._progress[:, FIRST_POSE] = self._progress[:, STEP]
        # Lists know the way that walls go for as long as poses were given.
        self._lists_end = [bool(self._walls[:, :, PATH].any())] * self.threads

    def run(self, steps: int) -> None:
        """Goes on, so many steps; a :class:`Divergence` where a speed crosses a quarter of a radius in a step."""
        self._progress[:, PAUSE] = self._progress[0, STEP] + steps
        culprit = barrier.run_together(self._march, self.threads, self.gate)[0]
        if culprit >= 0:
            position, velocity, spin = as_given(self.bodies)
            position = into_period(position, self._physics.period)
            raise Divergence(int(self.bodies.order[culprit]), int(self._progress[0, STEP]), position, velocity, spin)

    def _march(self, thread: int) -> int:
        """One thread's share of the steps up to the next pause; returns the row that diverged, or less than 0."""
        progress, bounds = self._progress[thread], self._bounds
        chunk, stop = (t * (len(bounds) - 1) // self.threads for t in (thread, thread + 1))
        if self._lists_end[thread]:
            self._drop_lists(thread)
        while True:
            if self._lists[thread] is None:
                self._lists[thread] = search(
                    self.bodies, bounds, chunk, stop, self._walls, int(progress[STEP] - progress[FIRST_POSE]),
                    self._last_evaluation(thread), self._physics, self._known[thread],
                )  # fmt: skip
                self._told[thread, TRAVELLED] = np.inf
            lists = self._lists[thread]
            culprit = march(
                thread, self.threads, self.gate, bounds, self._reach, self._told, progress, *self.bodies[2:],
                *self._loads, *lists, self._physics.pair_laws, self._physics.wall_laws, self._walls, *self._constants,
                self._books[thread],
            )  # fmt: skip
            for found, buffer in zip(self._peaks[thread], (lists.buffer, lists.wall_buffer), strict=True):
                np.maximum(found, take_peaks(buffer), out=found)
            if culprit != SEARCH:
                return int(culprit)
            self._drop_lists(thread)

    def _drop_lists(self, thread: int) -> None:
        self._known[thread], self._known_at[thread] = self._touching(thread), self._last_evaluation(thread)
        self._lists[thread], self._lists_end[thread] = None, False

    def _last_evaluation(self, thread: int) -> int:
        return int(self._progress[thread, STEP] - self._progress[thread, DUE])

    def _touching(self, thread: int) -> tuple[Known, Known]:
        """Contacts of a thread that the last evaluation found touching; all threads' where that was before it began."""
        last, progress = self._last_evaluation(thread), self._progress[thread]
        if last == self._known_at[thread]:
            return self._known[thread]
        return self._lists[thread].known(last % 2, progress[PAIRS], progress[WALLS])

    def state(self) -> ParticleState:
        """The state of this pause, with its touching contacts and what they remember; or a :class:`Divergence`."""
        position, velocity, spin = as_given(self.bodies._replace(**self._whole_velocities()))
        steps = int(self._progress[0, STEP])
        threads = 1 if self._last_evaluation(0) == self._known_at[0] else self.threads
        check_finite(steps, position, velocity, spin)
        return replace(
            self._given,
            position=into_period(position, self._physics.period),
            velocity=velocity,
            angular_velocity=spin,
            time=self._given.time + steps * self._time_step,
            history=contact_history([self._touching(thread) for thread in range(threads)], self.bodies.order),
        )

    def held(self) -> Held:
        """What goes on from this pause beside the state."""
        row = self.bodies.row
        force, torque = (self._own(rows)[row, :3] for rows in self._loads)
        return Held(self.bodies.sphere[row, :3], force, torque, self.bodies.order)

    def take_peaks(self) -> Peaks:
        """Largest overlaps and approach since they were last asked for."""
        pairs, walls = self._peaks.max(axis=0)
        self._peaks[:] = 0.0
        return Peaks(pairs[0], walls[0], max(pairs[1], walls[1]), max(pairs[2], walls[2]))

    def take_work(self) -> Work:
        """What walls and contacts did since it was last asked for."""
        steps, self._counted = int(self._progress[0, STEP]) - self._counted, int(self._progress[0, STEP])
        return self._books[0].take(steps)

    def _whole_velocities(self) -> dict[str, FloatArray]:
        """Velocities and spins with their step closed, as the kick of `stretch.march` would close it."""
        if self._progress[0, WHOLE]:
            return {}
        half, closed = 0.5 * self._time_step, {}
        gravity = np.array((*self._physics.gravity, 0.0))
        for name, rows, field in zip(("velocity", "spin"), self._loads, (gravity, None), strict=True):
            body = getattr(self.bodies, name)[:-2]
            gain = body[:, 3:] * self._own(rows)
            if field is not None:
                gain += field
            closed[name] = half * gain + body
        return closed

    def _own(self, rows: FloatArray) -> FloatArray:
        """``(N, 4)`` loads of the particles from the rows of their own chunks."""
        return np.concatenate([rows[chunk, part] for chunk, part in enumerate(self._chunks())])

    def _chunks(self) -> list[slice]:
        return [slice(*self._bounds[c : c + 2]) for c in range(len(self._bounds) - 1)]
