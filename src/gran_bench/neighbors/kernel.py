"""How pieces that run for every particle are jitted: divisions may not raise, so that loops with them run in SIMD."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

from numba import njit

# Called by jitted code alone: wrappers for Python would take a tenth of the time of the first compilation.
kernel = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)


def cached(*rooms: Path, **options) -> Callable[[Callable], Callable]:
    """Compile a function, with options of ``numba.njit``, and keep it on disk, named by a digest of its ``rooms``.

    Numba keys its cache by the function's own file: what changed in another would be found under the old key.
    """
    files = [path for room in rooms for path in sorted(room.rglob("*.py"))]
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()

    def jitted(function: Callable) -> Callable:
        function.__qualname__ = f"{function.__name__}_{digest[:16]}"
        return njit(cache=True, error_model="numpy", **options)(function)

    return jitted


# What Python calls, of the searches and of the fast engine; it lets other threads run meanwhile.
entry = cached(*(Path(__file__).parents[1] / room for room in ("neighbors", "dem")), nogil=True)
