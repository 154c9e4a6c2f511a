"""Threads that run one jitted loop together: a barrier that costs less than a step, and a way out of it.

A step of a small scene takes a tenth of a millisecond, so threads meet by spinning on shared memory, and hand their
core on only when the others are late. The barrier orders memory: what a thread wrote before it, all see after it.
"""

from __future__ import annotations

import sys

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from gran_bench.neighbors.kernel import kernel
from gran_bench.state import FloatArray

# Places of a gate, a cache line apart.
ARRIVED, ROUND, ABANDONED = 0, 8, 16
SPINS_BEFORE_YIELD = 2000  # a few microseconds


def new_gate() -> FloatArray:
    """A gate for one stretch, ``(24,)`` int64."""
    return np.zeros(24, np.int64)


@intrinsic
def _add_atomically(typing, gate, place, amount):
    """gate[place] += amount, seen by all threads in one order; returns what was there."""

    def emit(context, builder, signature, values):
        pointer = _element(context, builder, signature, values)
        amount = context.cast(builder, values[2], signature.args[2], types.int64)
        return builder.atomic_rmw("add", pointer, amount, "seq_cst")

    return types.int64(gate, place, amount), emit


@intrinsic
def _load_atomically(typing, gate, place):
    """gate[place] as it is now."""

    def emit(context, builder, signature, values):
        return builder.load_atomic(_element(context, builder, signature, values), "seq_cst", 8)

    return types.int64(gate, place), emit


@intrinsic
def _yield_core(typing):
    """Lets another thread of this machine run."""

    def emit(context, builder, signature, values):
        if sys.platform != "win32":
            function = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(ir.IntType(32), []), "sched_yield"
            )
            builder.call(function, [])
        return context.get_dummy_value()

    return types.void(), emit


def _element(context, builder, signature, values):
    array = cgutils.create_struct_proxy(signature.args[0])(context, builder, values[0])
    return builder.gep(array.data, [context.cast(builder, values[1], signature.args[1], types.int64)])


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


def abandon(gate: FloatArray) -> None:
    """Lets all threads through every barrier, because one of them will not come any more."""
    gate[ABANDONED] = 1
