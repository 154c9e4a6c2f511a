"""How pieces that run for every particle are jitted.

``error_model="numpy"`` is what lets loops with divisions run in SIMD: a division may then not raise.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

from numba import njit

# Called by jitted code alone: wrappers for Python would take a tenth of the time of the first compilation.
kernel = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)


def cached(*rooms: Path, **options) -> Callable[[Callable], Callable]:
    """Compile a function and keep it on disk, named by a digest of all source that it may depend on.

    Numba keys its cache by the file of the function alone; a kernel of another file that changed would be found under
    the old key. That code is in ``rooms``, folders with all below them; the options are those of ``numba.njit``.
    """
    files = [path for room in rooms for path in sorted(room.rglob("*.py"))]
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()

    def jitted(function: Callable) -> Callable:
        function.__qualname__ = f"{function.__name__}_{digest[:16]}"
        return njit(cache=True, error_model="numpy", **options)(function)

    return jitted


# What Python calls, of the searches and of the fast engine; it lets other threads run meanwhile.
entry = cached(*(Path(__file__).parents[1] / room for room in ("neighbors", "dem")), nogil=True)
