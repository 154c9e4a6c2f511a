"""A process that compiles its share of the fast engine into Numba's cache: what makes lists, and pieces of the loop.

Started by :mod:`gran_bench.dem.fast.compiling`, not by people.
"""

from __future__ import annotations

import gc
import os
import sys
import threading

import numpy as np
from numba import typeof

from gran_bench.dem.fast.bodies import Known
from gran_bench.dem.fast.contact_blocks import BUFFER_SIZE, contact_laws
from gran_bench.dem.fast.contact_list import largest_displacement
from gran_bench.dem.fast.search import search
from gran_bench.dem.fast.stretch import kick, take_over
from gran_bench.dem.fast.wall_contacts import wall_forces
from gran_bench.dem.walls import COLUMNS


def compile_share(precision: str = "float64") -> None:
    """Compiles pieces of the loop, those that take longest first, and then what makes lists.

    For arrays of the kinds that the engine has; the lists are made of two spheres.

    Args:
        precision: dtype that the contact laws are computed in.
    """
    rows, loads, numbers, margin = np.ones((4, 4)), np.zeros((1, 4, 4)), np.array([0, 2]), np.ones(2)
    bodies, load = (rows, rows, rows, rows, np.zeros(4, np.uint8)), (loads[0], loads[0])
    places, buffer = np.zeros(2, np.uint32), np.zeros(BUFFER_SIZE, precision)
    histories, needs = (rows, rows, rows, rows), (True, True)
    for piece, *arguments in (
        (contact_laws, buffer, 0, *needs, 0.1),
        (
            wall_forces, *bodies, *load, places, places, places, numbers, places, 1, places, 1, rows, *histories,
            buffer, loads, rows, *needs, True, 0.1,
        ),
        (kick, rows, rows, rows, loads, loads, margin, numbers, 0, 1, np.zeros(3), 0.1, 0.1, True, 1.0),
        (take_over, loads, loads, numbers, numbers, 0, 1, True),
        (largest_displacement, rows, rows, margin, 0, 2),
    ):  # fmt: skip
        piece.compile(tuple(map(typeof, arguments)))
    nothing = np.zeros(0, np.int64)
    none = Known(nothing, nothing, np.zeros((0, 4)), np.zeros((0, 4)))
    search(rows, rows, numbers, 0, 1, np.zeros((1, 1, COLUMNS)), 0, -1, 0.1, 0.0, (none, none), False)


def main() -> None:
    """Compile, unless the caller is gone before it is done."""

    def end_with_the_caller() -> None:
        sys.stdin.buffer.read()
        os._exit(1)

    threading.Thread(target=end_with_the_caller, daemon=True).start()
    gc.disable()  # as the caller does, for the same reason
    compile_share(*sys.argv[1:])
    os._exit(0)  # not the usual way, which cannot end while a thread reads


if __name__ == "__main__":
    main()
