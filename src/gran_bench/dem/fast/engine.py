"""The fast engine: a stretch of steps on one or more threads, jitted from one neighbour search to the next.

What makes it fast:

- Bodies are rows of four doubles (position and radius, velocity and 1/m, spin and 1/I, force, torque), moved as SIMD
  vectors (rows.py). Particles are sorted in space when a stretch begins.
- Pairs are flat half lists, pruned often, searched for rarely; the histories of those that touch lie densely in their
  order (contact_list.py).
- A branchless filter packs the touching pairs; blocks of them are gathered into columns, computed there in SIMD, and
  scattered (contact_blocks.py). ``error_model="numpy"`` is what allows SIMD: a division may then not raise.
- Threads own chunks of neighbouring particles for the whole stretch and meet twice a step (barrier.py).

A stretch pauses wherever its state is asked for, and goes on as if it had not. One that starts from another's state,
forces and order goes on from there bit for bit (frame.py). Skin and number of threads change no bit either: lists are
in one order whatever the skin (contact_list.py), and the chunks, each with loads of its own that are added in one
order, depend on the number of particles alone.
"""

from __future__ import annotations

import math
import threading
from dataclasses import replace

import numpy as np

from gran_bench.dem.fast import barrier
from gran_bench.dem.fast.bodies import Known, as_given, bodies_in_order, contact_history, known_contacts
from gran_bench.dem.fast.contact_blocks import BUFFER_SIZE, block_buffer, take_peaks
from gran_bench.dem.fast.search import Lists, search, touching
from gran_bench.dem.fast.stretch import (
    DUE,
    FIRST_POSE,
    NEAR_I,
    NEAR_J,
    PAIRS,
    PAUSE,
    SEARCH,
    STEP,
    TRAVELLED,
    WALLS,
    WHOLE,
    march,
)
from gran_bench.dem.integrate import Divergence, Peaks, Physics, check_finite, into_period
from gran_bench.dem.walls import PATH
from gran_bench.state import FloatArray, Held, ParticleState

# Particles from which on a bed is cut into 2, 4, 8, 16 chunks: each large beside what lies at its rim.
CHUNK_SIZES = (1500, 8000, 32000, 128000)


def chunk_bounds(count: int) -> np.ndarray:
    """First particle of each chunk, and the end of the last, ``(C + 1,)``; a function of the number alone."""
    chunks = 2 ** sum(count >= size for size in CHUNK_SIZES)
    return np.array([count * c // chunks for c in range(chunks + 1)], np.int64)


def most_threads(count: int) -> int:
    """How many threads have work with so many particles."""
    return len(chunk_bounds(count)) - 1


def advance(state: ParticleState, physics: Physics, time_step: float, walls: FloatArray) -> ParticleState:
    """The state after a stretch of steps, its contact history included.

    Args:
        state: where the stretch starts.
        physics: laws, walls and gravity; skin, threads and precision.
        time_step: Δt, s.
        walls: ``(steps + 1, W, 22)`` poses of the walls at each force evaluation (walls.py).

    Raises:
        Divergence: a speed that crosses a quarter of a radius in a step, or is not finite.
    """
    if state.count == 0:
        return state
    stretch = Stretch(state, physics, time_step, walls)
    stretch.run(len(walls) - 1)
    return stretch.state()


class Stretch:
    """Steps that share an order of the particles; it pauses wherever its state is asked for.

    Args:
        state: where it starts; at least one particle.
        physics: laws and gravity; skin, threads and precision.
        time_step: Δt, s.
        walls: ``(steps + 1, W, 21)`` poses of the walls at each force evaluation (walls.py).
        held: forces and order that the state comes with; None where both are its own. Then forces load no history.

    Raises:
        Divergence: a speed that is not a number.
    """

    def __init__(
        self, state: ParticleState, physics: Physics, time_step: float, walls: FloatArray, held: Held | None = None
    ) -> None:
        self._given = state
        self._moving = tuple(
            np.asarray(array, np.float64) for array in (state.position, state.velocity, state.angular_velocity)
        )
        # Lists have room for displacements in proportion to speeds, so these must be numbers before any are made.
        check_finite(0, *self._moving)
        self._radius, self._material = np.asarray(state.radius, np.float64), np.asarray(state.material, np.uint8)
        self.precision = np.float32 if physics.single_precision else np.float64
        self._physics, self._time_step = physics, time_step
        self._bounds = chunk_bounds(state.count)
        chunks = len(self._bounds) - 1
        self.threads, self.gate = max(1, min(physics.threads, chunks)), barrier.new_gate()
        self._told = np.zeros((self.threads, 32))
        self._shared = self.gate, self._bounds, np.zeros(chunks, np.int64), self._told
        self._loads = tuple(_zeros(2, chunks, state.count + 2, 4))
        fastest = 0.25 * float(self._radius.min()) / time_step
        self._laws = physics.pair_laws, physics.wall_laws
        self._constants = (
            np.array(physics.gravity, np.float64), float(physics.period), float(time_step), fastest * fastest,
            physics.tangential, physics.rolling, self._unequal(), physics.full_radius,
        )  # fmt: skip
        self._shares: list[tuple[Lists, tuple] | None] = [None] * self.threads
        self._progress = np.array([(0, 0, 0, held is None, 1, 1, 1)] * self.threads)
        self.set_walls(walls)
        self._peaks = np.zeros((self.threads, 2, 3))
        self._begin(held)
        if held is None:
            self.run(0)
        elif not march.overloads:
            # What runs on from held forces compiles now too, and not in a step that is timed.
            Stretch(state, physics, time_step, walls)

    def _unequal(self) -> bool:
        """Whether radii or masses differ: contacts of equal spheres share R*, m* and I_r."""
        density = self._physics.density[self._material]
        return bool((self._radius != self._radius[0]).any() or (density != density[0]).any())

    def _begin(self, held: Held | None) -> None:
        """Sorts the bodies; their contacts, and forces that were held, follow."""
        physics, order = self._physics, None if held is None else held.order
        self.bodies = bodies_in_order(
            *self._moving, self._radius, self._material, physics.density, float(physics.period), order
        )
        self._known = [known_contacts(self._given.history, self.bodies.row, physics.rolling)] * self.threads
        self._known_at = [self._last_evaluation(0)] * self.threads
        if held is not None:
            for rows, load in zip(self._loads, (held.force, held.torque), strict=True):
                for chunk, begin, end in self._chunks():
                    rows[chunk, begin:end, :3] = load[self.bodies.order[begin:end]]

    def set_walls(self, walls: FloatArray) -> None:
        """Gives the poses of the steps to come, the first of them of this pause."""
        self._walls = np.array(walls, np.float64, order="C")
        self._progress[:, FIRST_POSE] = self._progress[:, STEP]
        # Lists know the way that walls go for as long as poses were given.
        self._lists_end = [bool(self._walls[:, :, PATH].any())] * self.threads

    def run(self, steps: int) -> None:
        """Goes on, so many steps.

        Raises:
            Divergence: a speed that crosses a quarter of a radius in a step, or is not finite.
        """
        self._progress[:, PAUSE] = self._progress[0, STEP] + steps
        culprit = run_together(self._march, self.threads, self.gate)[0]
        if culprit >= 0:
            position, velocity, spin = as_given(self.bodies)
            position = into_period(position, float(self._physics.period))
            raise Divergence(int(self.bodies.order[culprit]), int(self._progress[0, STEP]), position, velocity, spin)

    def _march(self, thread: int) -> int:
        """One thread's share of the steps up to the next pause; returns the row that diverged, or less than 0."""
        bounds, physics, progress = self._bounds, self._physics, self._progress[thread]
        sphere, velocity = self.bodies.sphere, self.bodies.velocity
        chunk, stop = (t * (len(bounds) - 1) // self.threads for t in (thread, thread + 1))
        if self._lists_end[thread]:
            self._drop_lists(thread)
        while True:
            if self._shares[thread] is None:
                row, last = int(progress[STEP] - progress[FIRST_POSE]), self._last_evaluation(thread)
                lists = search(
                    sphere, velocity, bounds, chunk, stop, self._walls, row, last, physics.skin,
                    float(physics.period), self._known[thread], physics.rolling,
                )  # fmt: skip
                self._shares[thread] = lists, self._room(sphere, velocity, stop - chunk, lists, last)
                self._told[thread, TRAVELLED] = np.inf
            lists, room = self._shares[thread]
            culprit = int(march(*self._of_march(thread, progress, lists, room)))
            for found, buffer in zip(self._peaks[thread], room[-2:], strict=True):
                np.maximum(found, take_peaks(buffer), out=found)
            if culprit != SEARCH:
                return culprit
            self._drop_lists(thread)

    def _drop_lists(self, thread: int) -> None:
        self._known[thread], self._known_at[thread] = self._touching(thread), self._last_evaluation(thread)
        self._shares[thread], self._lists_end[thread] = None, False

    def _last_evaluation(self, thread: int) -> int:
        return int(self._progress[thread, STEP] - self._progress[thread, DUE])

    def _touching(self, thread: int) -> tuple[Known, Known]:
        """Contacts of a thread that the last evaluation found touching; all threads' where that was before it began."""
        last, progress = self._last_evaluation(thread), self._progress[thread]
        if last == self._known_at[thread]:
            return self._known[thread]
        lists, room = self._shares[thread]
        inner, pairs, on_walls = room[2:5]
        return touching(
            lists, inner[NEAR_I], inner[NEAR_J], pairs[last % 2, 1 : progress[PAIRS]],
            on_walls[last % 2, 1 : progress[WALLS]], last,
        )  # fmt: skip

    def state(self) -> ParticleState:
        """The state of this pause, with its touching contacts and what they remember.

        Raises:
            Divergence: a value that is not finite.
        """
        position, velocity, spin = as_given(self.bodies._replace(**self._whole_velocities()))
        steps, threads = int(self._progress[0, STEP]), self.threads
        if self._last_evaluation(0) == self._known_at[0]:
            threads = 1
        check_finite(steps, position, velocity, spin)
        return replace(
            self._given,
            position=into_period(position, float(self._physics.period)),
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

    def _whole_velocities(self) -> dict[str, FloatArray]:
        """Velocities and spins with their step closed, as the kick of `stretch.march` would close it."""
        velocity, spin = self.bodies.velocity, self.bodies.spin
        if self._progress[0, WHOLE]:
            return {}
        half, closed = 0.5 * self._time_step, []
        for body, rows, field in zip((velocity, spin), self._loads, ((*self._physics.gravity, 0.0), None), strict=True):
            gain = body[:-2, 3:] * self._own(rows)
            if field is not None:
                gain += field
            gain *= half
            gain += body[:-2]
            closed.append(gain)
        return {"velocity": closed[0], "spin": closed[1]}

    def _own(self, rows: FloatArray) -> FloatArray:
        """``(N, 4)`` loads of the particles from the rows of their own chunks."""
        parts = [rows[chunk, begin:end] for chunk, begin, end in self._chunks()]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _chunks(self) -> list[tuple[int, int, int]]:
        return [(c, int(self._bounds[c]), int(self._bounds[c + 1])) for c in range(len(self._bounds) - 1)]

    def _room(self, sphere: FloatArray, velocity: FloatArray, chunks: int, lists: Lists, last: int) -> tuple:
        """What a thread with so many chunks keeps while its lists live; they know what touched in step ``last``."""
        pairs, walls = lists.slot.shape[1], lists.wall_slot.shape[1]
        inner = np.empty((4, pairs), np.uint32)
        inner[:, 0] = 0
        inner[NEAR_I, 0], inner[NEAR_J, 0] = (len(self._radius) + k for k in (0, 1))
        on_walls = np.empty((2, walls), np.uint32)
        on_walls[last % 2, lists.wall_memory] = np.arange(len(lists.wall_memory))
        constants = sphere[0, 3], velocity[0, 3], self._physics.pair_laws[0, 0]
        return (
            sphere.copy(), np.empty_like(sphere), inner, np.empty((2, pairs), np.uint32), on_walls, _zeros(walls, 4),
            np.ones(chunks + 1, np.int64),
            *(block_buffer(buffer, *constants) for buffer in _zeros(2, BUFFER_SIZE, dtype=self.precision)),
        )  # fmt: skip

    def _of_march(self, thread: int, progress: np.ndarray, lists: Lists, room: tuple) -> tuple:
        return (
            thread, self.threads, *self._shared, progress, *self.bodies[2:], *self._loads, *lists, *room,
            *self._laws, self._walls, *self._constants,
        )  # fmt: skip


def _zeros(*shape: int, dtype: type = np.float64) -> np.ndarray:
    """Zeros from the beginning of a cache line on: rows and columns that cross lines take a tenth longer.

    They come from the operating system: what is never touched costs nothing.
    """
    size, line = math.prod(shape) * np.dtype(dtype).itemsize, 64
    room = np.zeros(size + line, np.uint8)
    skipped = -room.__array_interface__["data"][0] % line
    return room[skipped : skipped + size].view(dtype).reshape(shape)


def run_together(run, threads: int, gate: np.ndarray) -> list:
    """``run(thread)`` of every thread, the first on the caller's own; an error lets the others through the barriers."""
    if threads == 1:
        return [run(0)]
    results: list = [None] * threads
    errors: list[BaseException] = []

    def guarded(thread: int) -> None:
        try:
            results[thread] = run(thread)
        except BaseException as error:
            errors.append(error)
            barrier.abandon(gate)

    others = [threading.Thread(target=guarded, args=(thread,), daemon=True) for thread in range(1, threads)]
    for other in others:
        other.start()
    guarded(0)
    for other in others:
        other.join()
    if errors:
        raise errors[0]
    return results
