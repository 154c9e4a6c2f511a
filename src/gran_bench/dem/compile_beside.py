"""A process that compiles its share of the fast engine into Numba's cache: what makes lists, and pieces of the loop.

Started by :mod:`gran_bench.dem.compiling`, not by people.
"""

from __future__ import annotations

import gc
import os
import sys
import threading

import numpy as np
from numba import typeof

from gran_bench.dem.bodies import Known, bodies_in_order
from gran_bench.dem.contact_list import largest_displacement
from gran_bench.dem.search import search
from gran_bench.dem.stretch import kick, take_over
from gran_bench.dem.wall_list import shape_of, toward_wall
from gran_bench.dem.walls import COLUMNS


def compile_share() -> None:
    """Makes the lists of two spheres with arrays of the kinds that the engine has; the rest is compiled for such kinds.

    The pieces of the loop come before what the caller does not need, so that they are there when it comes to them.
    """
    place, nothing = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), np.zeros(0, np.int64)
    bodies = bodies_in_order(
        place, np.zeros((2, 3)), np.zeros((2, 3)), np.full(2, 0.5), np.zeros(2, np.uint8), np.ones(1), 0.0
    )
    rows, loads, numbers, margin = bodies.sphere, np.zeros((1, 4, 4)), np.array([0, 2]), np.ones(2)
    for piece, *arguments in (
        (shape_of, rows, 0),
        (toward_wall, (0.0,) * 11, 0.0, 0.0, 0.0),
        (kick, rows, rows, rows, loads, loads, margin, numbers, 0, 1, np.zeros(3), 0.1, 0.1, True, 1.0),
        (take_over, loads, loads, numbers, numbers, 0, 1, True),
        (largest_displacement, rows, rows, margin, 0, 2),
    ):
        piece.compile(tuple(map(typeof, arguments)))
    none = Known(nothing, nothing, np.zeros((0, 4)), np.zeros((0, 4)))
    search(rows, bodies.velocity, numbers, 0, 1, np.zeros((1, 1, COLUMNS)), 1, 0.1, 0.0, (none, none), False)


def main() -> None:
    """Compile, unless the caller is gone before it is done."""

    def end_with_the_caller() -> None:
        sys.stdin.buffer.read()
        os._exit(1)

    threading.Thread(target=end_with_the_caller, daemon=True).start()
    gc.disable()  # as the caller does, for the same reason
    compile_share()
    os._exit(0)  # not the usual way, which cannot end while a thread reads


if __name__ == "__main__":
    main()
