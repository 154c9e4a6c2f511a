"""How the pieces of the fast engine are jitted, and the arrays that they ask for.

Pieces are called by jitted code alone, so they have no way in from Python: the wrappers for it would take a tenth of
the time that a user waits for the first compilation. ``error_model="numpy"`` is what lets loops with divisions run in
SIMD: a division may then not raise.
"""

import numpy as np
from numba import njit

kernel = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)


# One function for each kind of array: every way of writing np.empty would be compiled anew.


@kernel
def quads(count):
    """Room for so many rows of four, not cleared."""
    return np.empty((np.int64(count), 4))


@kernel
def places(count):
    """Room for so many particles, pairs or places, not cleared."""
    return np.empty(np.int64(count), np.uint32)


@kernel
def never(count):
    """As many −1."""
    array = np.empty(np.int64(count), np.int32)
    for k in range(count):
        array[k] = -1
    return array
