"""The fast engine: a whole stretch of steps, neighbour searches included, in one jitted call, on one or more threads.

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

import hashlib
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numba import njit

from gran_bench import neighbors
from gran_bench.dem import barrier
from gran_bench.dem.integrate import Divergence, Physics
from gran_bench.dem.stretch import bodies_in_order, run_chunks
from gran_bench.state import ContactHistory, FloatArray, ParticleState

# Particles from which on a bed is cut into 2, 4, 8, 16 chunks: each large beside what lies at its rim.
CHUNK_SIZES = (1500, 8000, 32000, 128000)


def chunk_bounds(count: int) -> np.ndarray:
    """First particle of each chunk, and the end of the last, ``(C + 1,)``; a function of the number alone."""
    chunks = 2 ** sum(count >= size for size in CHUNK_SIZES)
    return np.linspace(0, count, chunks + 1).astype(np.int64)


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
    history, bounds = state.history, chunk_bounds(state.count)
    position, velocity, spin = (
        np.array(array, np.float64) for array in (state.position, state.velocity, state.angular_velocity)
    )
    radius, material = np.array(state.radius, np.float64), np.array(state.material, np.uint8)
    bodies = _bodies_in_order(position, velocity, spin, radius, material, physics.density, physics.period)
    chunks = len(bounds) - 1
    threads = max(1, min(physics.threads, chunks))
    shape = (chunks, state.count + 2, 4)
    # Zeros of the operating system: what no chunk touches costs nothing.
    shared = (barrier.new_gate(), bounds, np.zeros(chunks, np.int64), np.zeros((threads, 32)))
    loads = np.zeros(shape), np.zeros(shape)
    known = np.column_stack((history.force, history.overlap, history.rolling_moment))
    what = (
        np.array(history.first, np.int64), np.array(history.second, np.int64), known,
        physics.pair_laws, physics.wall_laws, np.ascontiguousarray(walls), np.array(physics.gravity, np.float64),
        physics.period, physics.skin, float(time_step), physics.tangential, physics.rolling,
        np.zeros(0, np.float32 if physics.single_precision else np.float64),
    )  # fmt: skip

    def run(thread: int):
        return _run_chunks(thread, threads, *shared, position, velocity, spin, *bodies, *loads, *what)

    results = run_together(run, threads, shared[0])
    culprit, done = results[0][:2]
    if culprit >= 0:
        raise Divergence(int(bodies[0][culprit]), int(done), position, velocity, spin)
    first, second, memory = (np.concatenate([result[k] for result in results]) for k in (2, 3, 4))
    contacts = ContactHistory(first, second, memory[:, :3].copy(), memory[:, 3].copy(), memory[:, 4:].copy())
    return ParticleState(
        position, velocity, spin, state.radius, state.time + done * time_step, contacts, state.material
    )


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


def _compiled(function: Callable, **options) -> Callable:
    """The jitted function, cached on disk under the digest of everything that it is compiled from.

    Numba keys its cache by the file of the function alone; a kernel of another file that changed would be found under
    the old key. The function's name is part of the name of the cache.
    """
    files = [path for room in (__file__, neighbors.__file__) for path in sorted(Path(room).parent.glob("*.py"))]
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    function.__qualname__ = f"{function.__name__}_{digest[:16]}"
    return njit(cache=True, error_model="numpy", **options)(function)


_bodies_in_order = _compiled(bodies_in_order)
_run_chunks = _compiled(run_chunks, nogil=True)
