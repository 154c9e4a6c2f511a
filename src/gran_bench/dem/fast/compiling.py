"""The first compilation of the fast engine, shared by two processes.

Numba compiles one function at a time in a process, but what it compiled lies on disk for all. So while the caller
compiles the loop of steps, a process beside it compiles pieces of that loop, and most of what makes the lists. Whatever
keeps that process from its work (one core, no cache, no interpreter to start), the caller finds nothing on disk and
compiles it all.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numba
import numpy as np

import gran_bench
from gran_bench.dem.fast.contact_blocks import contact_laws
from gran_bench.dem.fast.contact_list import fill_margins, largest_displacement, sort_pairs
from gran_bench.dem.fast.stretch import kick, march, take_over
from gran_bench.dem.fast.wall_contacts import wall_forces
from gran_bench.neighbors.cells import find_pairs

# What the process beside compiles (compile_beside.py).
PIECES = (contact_laws, wall_forces, kick, take_over, largest_displacement)
LISTS = (fill_margins, find_pairs, sort_pairs)
# How much longer than the caller's own share its share may take: more, and it hangs.
PATIENCE = 3.0


def on_disk(entry: Callable) -> bool:
    """Whether Numba's cache knows a function; for which machine, only loading it tells."""
    folder = entry.stats.cache_path
    return folder is not None and any(Path(folder).glob(f"*{entry.py_func.__qualname__}-*.nbi"))


@contextmanager
def compiled_beside(precision: type) -> Iterator[None]:
    """While the body compiles the loop of steps, another process compiles what is in ``PIECES`` and ``LISTS``.

    Only where that is worth it: with two cores, and where nothing of the loop is on disk.

    Args:
        precision: dtype that the contact laws are computed in.
    """
    beside, began = None, time.perf_counter()
    if numba.config.NUMBA_NUM_THREADS > 1 and not any(map(on_disk, (march, *PIECES))):
        beside = _started(np.dtype(precision).name)
    try:
        yield
        if beside is not None:
            beside.wait(PATIENCE * (time.perf_counter() - began))
    except subprocess.TimeoutExpired:
        pass
    finally:
        if beside is not None:
            beside.kill()
            beside.wait()
            beside.stdin.close()


def _started(precision: str) -> subprocess.Popen | None:
    sources = str(Path(gran_bench.__file__).parent.parent)
    paths = [sources, *filter(None, [os.environ.get("PYTHONPATH")])]
    try:
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "gran_bench.dem.fast.compile_beside", precision],
            stdin=subprocess.PIPE,  # closed when the caller is gone, however it went
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
            start_new_session=True,  # Ctrl-C is for the caller, which then ends it
        )
    except OSError:
        return None
