"""How the pieces of the fast engine are jitted."""

from __future__ import annotations

from pathlib import Path

from gran_bench import neighbors
from gran_bench.neighbors.kernel import cached, kernel

_ROOMS = Path(__file__).parents[1], Path(neighbors.__file__).parent
# What Python calls; it lets other threads run meanwhile.
entry = cached(*_ROOMS, nogil=True)
# A piece that two processes need, or that one compiles for the other (compiling.py): only jitted code calls it, but it
# is on disk.
shared = cached(*_ROOMS, no_cpython_wrapper=True, no_cfunc_wrapper=True)

__all__ = ["entry", "kernel", "shared"]
