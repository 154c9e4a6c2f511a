"""How the pieces of the fast engine are jitted, and the arrays that they ask for.

Pieces are called by jitted code alone, so they have no way in from Python: the wrappers for it would take a tenth of
the time that a user waits for the first compilation. ``error_model="numpy"`` is what lets loops with divisions run in
SIMD: a division may then not raise.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numba import njit

from gran_bench import neighbors

kernel = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)


def entry(**options) -> Callable[[Callable], Callable]:
    """What Python calls: jitted, and cached on disk under the digest of everything that it may be compiled from.

    Numba keys its cache by the file of the function alone; a kernel of another file that changed would be found under
    the old key. The function's name is part of the name of the cache.
    """
    files = [path for room in (__file__, neighbors.__file__) for path in sorted(Path(room).parent.glob("*.py"))]
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()

    def jitted(function: Callable) -> Callable:
        function.__qualname__ = f"{function.__name__}_{digest[:16]}"
        return njit(cache=True, error_model="numpy", **options)(function)

    return jitted


# A piece that two processes need, or that one compiles for the other: not called from Python, but cached on disk.
shared = entry(no_cpython_wrapper=True, no_cfunc_wrapper=True)


@kernel
def places(count):
    """Room for so many particles, pairs or places, not cleared."""
    return np.empty(np.int64(count), np.uint32)
