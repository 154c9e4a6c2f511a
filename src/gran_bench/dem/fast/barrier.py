"""Threads that run one jitted loop together: they meet by spinning, and what one wrote before, all see after."""

import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from gran_bench.neighbors.kernel import emitted, kernel

# Places of a gate, a cache line apart.
ARRIVED, ROUND, ABANDONED = 0, 8, 16
SPINS_BEFORE_YIELD = 2000  # a few microseconds


def new_gate() -> np.ndarray:
    """A gate for one stretch, ``(24,)`` int64."""
    return np.zeros(24, np.int64)


@emitted(types.int64)
def _add_atomically(e, gate, place, amount):
    """gate[place] += amount, seen by all threads in one order; returns what was there."""
    return e.builder.atomic_rmw("add", e.address(gate, e.cast(place)), e.cast(amount), "seq_cst")


@emitted(types.int64)
def _load_atomically(e, gate, place):
    """gate[place] as it is now."""
    return e.builder.load_atomic(e.address(gate, e.cast(place)), "seq_cst", 8)


@emitted(types.void)
def _yield_core(e):
    """Lets another thread of this machine run."""
    if sys.platform != "win32":
        kind = ir.FunctionType(ir.IntType(32), [])
        e.builder.call(cgutils.get_or_insert_function(e.builder.module, kind, "sched_yield"), [])


@kernel
def meet(gate, threads):
    """Waits until all threads are here, or one of them gave up."""
    if threads == 1:
        return
    this_round = _load_atomically(gate, ROUND)
    if _add_atomically(gate, ARRIVED, 1) == threads - 1:
        _add_atomically(gate, ARRIVED, -threads)
        _add_atomically(gate, ROUND, 1)
        return
    spins = 0
    while _load_atomically(gate, ROUND) == this_round and _load_atomically(gate, ABANDONED) == 0:
        spins += 1
        if spins > SPINS_BEFORE_YIELD:
            _yield_core()


def run_together(run: Callable[[int], int], threads: int, gate: np.ndarray) -> list[int]:
    """``run(thread)`` of every thread, the first on the caller's own; an error lets the others through the barriers."""
    if threads == 1:
        return [run(0)]

    def guarded(thread: int) -> int:
        try:
            return run(thread)
        except BaseException:
            gate[ABANDONED] = 1
            raise

    with ThreadPoolExecutor(threads - 1) as pool:
        others = [pool.submit(guarded, thread) for thread in range(1, threads)]
        return [guarded(0), *(other.result() for other in others)]
