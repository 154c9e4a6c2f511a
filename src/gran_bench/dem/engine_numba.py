"""The fast engine: a stretch of steps on one or more threads, jitted from one neighbour search to the next.

What makes it fast:

- Bodies are rows of four doubles (position and radius, velocity and 1/m, spin and 1/I, force, torque), moved as SIMD
  vectors (rows.py). Particles are sorted in space when a stretch begins.
- Pairs are flat half lists, pruned often, searched for rarely; the histories of those that touch lie densely in their
  order (contact_list.py).
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
from gran_bench.dem.bodies import Bodies, Known, as_given, bodies_in_order, contact_history, known_contacts
from gran_bench.dem.compiling import compiled_beside
from gran_bench.dem.contact_blocks import BUFFER_SIZE, block_buffer
from gran_bench.dem.integrate import Divergence, Physics, into_period
from gran_bench.dem.search import Lists, search, touching
from gran_bench.dem.stretch import DONE, EVALUATION, NEAR_I, NEAR_J, PAIRS, SEARCH, WALLS, march
from gran_bench.dem.wall_list import list_near
from gran_bench.state import FloatArray, ParticleState

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
    # Lists have room for displacements in proportion to speeds, so these must be numbers before any are made.
    velocity = np.asarray(state.velocity, np.float64)
    wild = np.flatnonzero(~np.isfinite(np.einsum("nk,nk->n", velocity, velocity)))
    if len(wild):
        raise Divergence(int(wild[0]), 0, state.position, state.velocity, state.angular_velocity)
    stretch = _Stretch(state, physics, time_step, walls)
    if not march.overloads:
        with compiled_beside(stretch.precision):
            stretch.begin()
            stretch.compile()
    else:
        stretch.begin()
    results = run_together(stretch.run, stretch.threads, stretch.gate)
    culprit, done, _ = results[0]
    position, velocity, spin = as_given(stretch.bodies)
    position = into_period(position, float(physics.period))
    if culprit >= 0:
        raise Divergence(int(stretch.bodies.order[culprit]), done, position, velocity, spin)
    contacts = contact_history([touched for *_, touched in results], stretch.bodies.order)
    return ParticleState(
        position, velocity, spin, state.radius, state.time + done * time_step, contacts, state.material
    )


class _Stretch:
    """What the threads of a stretch share, and what each of them does.

    Args:
        state, physics, time_step, walls: of :func:`advance`.
    """

    def __init__(self, state: ParticleState, physics: Physics, time_step: float, walls: FloatArray) -> None:
        self._moving = tuple(
            np.asarray(array, np.float64) for array in (state.position, state.velocity, state.angular_velocity)
        )
        self._radius, self._material = np.asarray(state.radius, np.float64), np.asarray(state.material, np.uint8)
        self._history = state.history
        self.precision = np.float32 if physics.single_precision else np.float64
        self._physics, self._walls = physics, np.array(walls, np.float64, order="C")
        self._bounds = chunk_bounds(state.count)
        chunks = len(self._bounds) - 1
        self.threads, self.gate = max(1, min(physics.threads, chunks)), barrier.new_gate()
        self._shared = self.gate, self._bounds, np.zeros(chunks, np.int64), np.zeros((self.threads, 32))
        self._loads = tuple(_zeros(2, chunks, state.count + 2, 4))
        fastest = 0.25 * float(self._radius.min()) / time_step
        self._constants = (
            physics.pair_laws, physics.wall_laws, self._walls, np.array(physics.gravity, np.float64),
            float(physics.period), float(time_step), fastest * fastest,
            physics.tangential, physics.rolling, self._unequal(), physics.full_radius,
        )  # fmt: skip

    def _unequal(self) -> bool:
        """Whether radii or masses differ: contacts of equal spheres share R*, m* and I_r."""
        density = self._physics.density[self._material]
        return bool((self._radius != self._radius[0]).any() or (density != density[0]).any())

    def begin(self) -> None:
        """Sorts the bodies."""
        physics = self._physics
        self.bodies = bodies_in_order(
            *self._moving, self._radius, self._material, physics.density, float(physics.period)
        )
        self._known = known_contacts(self._history, self.bodies.row, physics.rolling)

    def run(self, thread: int) -> tuple[int, int, tuple[Known, Known]]:
        """One thread's share: the row that diverged or −1, the completed steps, the touching contacts by row."""
        bounds, physics, known = self._bounds, self._physics, self._known
        sphere, velocity = self.bodies.sphere, self.bodies.velocity
        chunk, stop = (t * (len(bounds) - 1) // self.threads for t in (thread, thread + 1))
        progress = np.array([1, 0, 1, 1])
        while True:
            lists = search(
                sphere, velocity, bounds, chunk, stop, self._walls, int(progress[EVALUATION]), physics.skin,
                float(physics.period), known, physics.rolling,
            )  # fmt: skip
            room = self._room(sphere, velocity, stop - chunk, lists, int(progress[EVALUATION]) - 1)
            culprit = int(march(*self._of_march(thread, progress, self.bodies, lists, room)))
            if culprit >= 0:
                return culprit, int(progress[DONE]), known  # which nobody asks for
            inner, pairs, on_walls = room[2:5]
            searches = culprit == SEARCH
            last = int(progress[EVALUATION]) - 1 if searches else len(self._walls)
            known = touching(
                lists, inner[NEAR_I], inner[NEAR_J], pairs[last % 2, 1 : progress[PAIRS]],
                on_walls[last % 2, 1 : progress[WALLS]], last,
            )  # fmt: skip
            if not searches:
                return culprit, int(progress[DONE]), known

    def compile(self) -> None:
        """Compiles the loop of steps, and before it what it shares with the lists, with arrays of their kinds."""
        row, place, number = np.ones((1, 4)), np.zeros(1, np.uint32), np.zeros(1, np.int64)
        histories, margin = np.zeros((2, 1, 4)), np.zeros(1)
        bodies = Bodies(number, number, row, row, row, row, np.zeros(1, np.uint8))
        lists = Lists(
            *(place, place, place, place, histories, histories),
            *(place, place, place, number, histories, histories),
            *(margin, margin),
        )
        arguments = self._of_march(0, np.zeros(4, np.int64), bodies, lists, self._room(row, row, 1, lists, 0))
        # First what else needs a wall's distance: meanwhile, the process beside gets ahead.
        near = row, number, 0, 1, row, margin, margin, place[None], place, place, place, number
        list_near.compile(tuple(map(numba.typeof, near)))
        march.compile(tuple(map(numba.typeof, arguments)))

    def _room(self, sphere: FloatArray, velocity: FloatArray, chunks: int, lists: Lists, evaluation: int) -> tuple:
        """What a thread with so many chunks keeps while its lists live; they know what touched in ``evaluation``."""
        pairs, walls = lists.slot.shape[1], lists.wall_slot.shape[1]
        inner = np.empty((4, pairs), np.uint32)
        inner[:, 0] = 0
        inner[NEAR_I, 0], inner[NEAR_J, 0] = (len(self._radius) + k for k in (0, 1))
        on_walls = np.empty((2, walls), np.uint32)
        on_walls[evaluation % 2, lists.wall_memory] = np.arange(len(lists.wall_memory))
        constants = sphere[0, 3], velocity[0, 3], self._physics.pair_laws[0, 0]
        return (
            sphere.copy(), np.empty_like(sphere), inner, np.empty((2, pairs), np.uint32), on_walls, _zeros(walls, 4),
            np.ones(chunks + 1, np.int64),
            *(block_buffer(buffer, *constants) for buffer in _zeros(2, BUFFER_SIZE, dtype=self.precision)),
        )  # fmt: skip

    def _of_march(self, thread: int, progress: np.ndarray, bodies: Bodies, lists: Lists, room: tuple) -> tuple:
        return (
            thread, self.threads, *self._shared, progress, *bodies[2:], *self._loads, *lists, *room,
            *self._constants,
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
