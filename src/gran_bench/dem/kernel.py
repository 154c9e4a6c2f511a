"""How the pieces of the fast engine are jitted: called by jitted code alone, so without a way in from Python.

``error_model="numpy"`` is what lets loops with divisions run in SIMD: a division may then not raise. The wrappers that
let Python call a piece would take a tenth of the time that a user waits for the first compilation.
"""

from numba import njit

kernel = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
