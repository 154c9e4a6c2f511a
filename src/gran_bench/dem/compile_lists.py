"""A process that compiles what sorts bodies and makes lists for the fast engine, into Numba's cache.

Started by :mod:`gran_bench.dem.compiling`, not by people.
"""

from __future__ import annotations

import gc
import os
import sys
import threading

import numpy as np

from gran_bench.dem.bodies import bodies_in_order
from gran_bench.dem.search import search
from gran_bench.dem.walls import COLUMNS


def compile_lists() -> None:
    """Sorts two spheres and makes their lists with arrays of the kinds that the engine has."""
    place = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    known = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 7))
    _, sphere, *_ = bodies_in_order(
        place, np.zeros((2, 3)), np.zeros((2, 3)), np.full(2, 0.5), np.zeros(2, np.uint8), np.ones(1), 0.0, *known
    )
    search(sphere, np.array([0, 2]), 0, 1, np.zeros((1, 1, COLUMNS)), 1, 0.1, 0.0, *known, False)


def main() -> None:
    """Compile, unless the caller is gone before it is done."""

    def end_with_the_caller() -> None:
        sys.stdin.buffer.read()
        os._exit(1)

    threading.Thread(target=end_with_the_caller, daemon=True).start()
    gc.disable()  # as the caller does, for the same reason
    compile_lists()


if __name__ == "__main__":
    main()
