"""The fast engine: a stretch of steps on one or more threads, jitted from one neighbour search to the next.

What makes it fast:

- Bodies are rows of four doubles (position and radius, velocity and 1/m, spin and 1/I, force, torque), moved as SIMD
  vectors (rows.py). Particles are sorted in space when a stretch begins.
- Pairs are flat half lists, pruned often, searched for rarely; the history lives in the slot of its pair and moves only
  when pairs are searched for (contact_list.py).
- A branchless filter packs the touching pairs; blocks of them are gathered into columns, computed there in SIMD, and
  scattered (contact_blocks.py). ``error_model="numpy"`` is what allows SIMD: a division may then not raise.
- Threads own chunks of neighbouring particles for the whole stretch and meet twice a step (barrier.py).

A stretch depends on nothing but the state that it starts from: order, lists and forces are made anew. So a run that
stops at a frame and goes on from its float64 state is bit for bit the run that did not stop. Skin and number of threads
change no bit either: lists are in one order whatever the skin (contact_list.py), and the chunks, each with loads of its
own that are added in one order, depend on the number of particles alone.
"""

from __future__ import annotations

import math
import threading

import numba
import numpy as np

from gran_bench.dem import barrier
from gran_bench.dem.bodies import bodies_in_order
from gran_bench.dem.compiling import lists_compiled_beside
from gran_bench.dem.contact_blocks import BUFFER_SIZE
from gran_bench.dem.integrate import Divergence, Physics
from gran_bench.dem.search import search, touching
from gran_bench.dem.stretch import DONE, EVALUATION, SEARCH, march
from gran_bench.state import ContactHistory, FloatArray, ParticleState

# Particles from which on a bed is cut into 2, 4, 8, 16 chunks: each large beside what lies at its rim.
CHUNK_SIZES = (1500, 8000, 32000, 128000)
# Calls no contact by particle.
NOBODY = np.zeros(0, np.int64)


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
        walls: ``(steps + 1, W, 21)`` poses of the walls at each force evaluation (walls.py).

    Raises:
        Divergence: a speed that crosses a quarter of a radius in a step, or is not finite.
    """
    if state.count == 0:
        return state
    stretch = _Stretch(state, physics, time_step, walls)
    if not march.overloads:
        with lists_compiled_beside(march):
            stretch.compile()
    stretch.begin()
    results = run_together(stretch.run, stretch.threads, stretch.gate)
    culprit, done = results[0][:2]
    position, velocity, spin = stretch.moving
    if culprit >= 0:
        raise Divergence(int(stretch.bodies[0][culprit]), done, position, velocity, spin)
    first, second, memory = (np.concatenate([result[k] for result in results]) for k in (2, 3, 4))
    contacts = ContactHistory(first, second, memory[:, :3].copy(), memory[:, 3].copy(), memory[:, 4:].copy())
    return ParticleState(
        position, velocity, spin, state.radius, state.time + done * time_step, contacts, state.material
    )


class _Stretch:
    """What the threads of a stretch share, and what each of them does.

    Args:
        state, physics, time_step, walls: of :func:`advance`.
    """

    def __init__(self, state: ParticleState, physics: Physics, time_step: float, walls: FloatArray) -> None:
        self.moving = tuple(
            np.array(array, np.float64) for array in (state.position, state.velocity, state.angular_velocity)
        )
        self._radius, self._material = np.array(state.radius, np.float64), np.array(state.material, np.uint8)
        history = state.history
        self._known = (
            np.array(history.first, np.int64), np.array(history.second, np.int64),
            np.column_stack((history.force, history.overlap, history.rolling_moment)),
        )  # fmt: skip
        self._physics, self._walls = physics, np.array(walls, np.float64, order="C")
        self._bounds = chunk_bounds(state.count)
        chunks = len(self._bounds) - 1
        self.threads, self.gate = max(1, min(physics.threads, chunks)), barrier.new_gate()
        self._shared = self.gate, self._bounds, np.zeros(chunks, np.int64), np.zeros((self.threads, 32))
        self._loads = tuple(_zeros(2, chunks, state.count + 2, 4))
        fastest = 0.25 * float(self._radius.min()) / time_step
        self._constants = (
            physics.pair_laws, physics.wall_laws, self._walls, np.array(physics.gravity, np.float64),
            float(physics.period), physics.skin, float(time_step), fastest * fastest,
            physics.tangential, physics.rolling, bool((self._radius != self._radius[0]).any()), physics.full_radius,
        )  # fmt: skip

    def begin(self) -> None:
        """Sorts the bodies."""
        density, period = self._physics.density, float(self._physics.period)
        self.bodies = bodies_in_order(*self.moving, self._radius, self._material, density, period, *self._known)

    def run(self, thread: int) -> tuple:
        """One thread's share: the row that diverged or −1, the completed steps, the touching contacts."""
        bounds, physics, known = self._bounds, self._physics, self._known
        order, sphere = self.bodies[:2]
        chunk, stop = (t * (len(bounds) - 1) // self.threads for t in (thread, thread + 1))
        own = sphere[bounds[chunk] : bounds[stop]]
        room = self._room(own, stop - chunk)
        progress = np.array([1, 0])
        while True:
            evaluation = int(progress[EVALUATION])
            lists = search(
                sphere, bounds, chunk, stop, self._walls, evaluation, physics.skin, float(physics.period),
                *known, physics.rolling,
            )  # fmt: skip
            room[0][:] = own
            culprit = march(*self._of_march(thread, progress, self.bodies, lists, room))
            if culprit != SEARCH:
                return int(culprit), int(progress[DONE]), *touching(*lists, len(self._walls), order)
            known = touching(*lists, int(progress[EVALUATION]) - 1, NOBODY)

    def compile(self) -> None:
        """Compiles what is called after bodies and lists, with arrays of their kinds in the place of them."""
        row, place, number = np.zeros((1, 4)), np.zeros(1, np.uint32), np.zeros(1, np.int32)
        bodies = NOBODY, row, row, row, row, np.zeros(1, np.uint8)
        lists = place, place, place, row, row, number, place, place, NOBODY, row, row, number
        arguments = self._of_march(0, np.array([1, 0]), bodies, lists, self._room(row, 1))
        march.compile(tuple(map(numba.typeof, arguments)))
        touching.compile(tuple(map(numba.typeof, (*lists, 1, NOBODY))))

    def _room(self, own: FloatArray, chunks: int) -> tuple:
        """What a thread with such rows and so many chunks keeps from lists to lists."""
        precision = np.float32 if self._physics.single_precision else np.float64
        return own.copy(), np.empty_like(own), np.zeros(chunks + 1, np.int64), *_zeros(2, BUFFER_SIZE, dtype=precision)

    def _of_march(self, thread: int, progress: np.ndarray, bodies: tuple, lists: tuple, room: tuple) -> tuple:
        pairs, walls = len(lists[0]), len(lists[6])
        scratch = (
            np.arange(pairs, dtype=np.uint32), np.empty(pairs, np.uint32), np.empty(pairs + 4, np.uint32),
            np.empty(walls + 4, np.uint32), _zeros(walls + 4, 4),
        )  # fmt: skip
        return (
            thread, self.threads, *self._shared, progress, *self.moving, *bodies, *self._loads, *lists, *scratch,
            *room, *self._constants,
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
