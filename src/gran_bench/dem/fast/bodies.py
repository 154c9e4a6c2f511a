"""Bodies of a stretch: sorted in space, as rows of four; and the contacts that they are known to have."""

import math
from typing import NamedTuple

import numpy as np

from gran_bench.neighbors import bin_cells
from gran_bench.state import ContactHistory, FloatArray

# Edge of the cells that particles are sorted by, in diameters of the largest.
CELL_EDGE = 1.1


class Known(NamedTuple):
    """Touching contacts of one kind, with pairs or with walls, and what they remember."""

    first: np.ndarray  # and second: ``(C,)`` particles or rows, first < second; or particle and wall
    second: np.ndarray
    slot: FloatArray  # ``(C, 4)`` elastic tangential force and overlap
    moment: FloatArray  # ``(C, 4)`` rolling moment and 0; ``(0, 4)`` where there is no rolling
    ledger: FloatArray  # ``(C, 4)`` as of `ContactHistory`, or ``(C, 0)``


def known_contacts(history: ContactHistory, name: np.ndarray, rolling: bool) -> tuple[Known, Known]:
    """Pairs and walls of a state, with particle i called ``name[i]`` and the lower name first."""
    slot, moment = _in_fours(history.force, history.overlap), _in_fours(history.rolling_moment, 0.0)
    is_pair = history.second >= 0
    pairs, walls = (
        Known(history.first[part], history.second[part], slot[part], moment[part] if rolling else np.zeros((0, 4)),
              history.ledger[part])
        for part in (is_pair, ~is_pair)
    )  # fmt: skip
    return _renamed(pairs, walls, name)


def contact_history(parts: list[tuple[Known, Known]], name: np.ndarray) -> ContactHistory:
    """What a state remembers: contacts of each part in turn, pairs and then walls, with row i called ``name[i]``."""
    named = [known for pairs, walls in parts for known in _renamed(pairs, walls, name)]
    first, second, slot, moment, ledger = (np.concatenate(arrays) for arrays in zip(*named, strict=True))
    rolling = moment[:, :3].copy() if len(moment) else None
    return ContactHistory(first, second, slot[:, :3].copy(), slot[:, 3].copy(), rolling, ledger)


def _renamed(pairs: Known, walls: Known, name: np.ndarray) -> tuple[Known, Known]:
    """Contacts with other names, the lower one of a pair first (its memory turns), and walls as −1 − w or back."""
    first, second = name[pairs.first], name[pairs.second]
    turn = np.ones((len(first), 4))
    turn[second < first, :3] = -1.0
    slot, moment = pairs.slot * turn, pairs.moment * turn[: len(pairs.moment)]
    pairs = Known(np.minimum(first, second), np.maximum(first, second), slot, moment, pairs.ledger)
    return pairs, walls._replace(first=name[walls.first], second=-1 - walls.second)


class Bodies(NamedTuple):
    """Particles as rows, and two spare ones, which fill lanes that a block of contacts does not need."""

    order: np.ndarray  # and row: ``(N,)`` particle of each row, row of each particle
    row: np.ndarray
    sphere: FloatArray  # and velocity, spin: ``(N + 2, 4)`` rows (x, y, z, r), (v, 1/m), (ω, 1/I)
    velocity: FloatArray
    spin: FloatArray
    ahead: FloatArray  # ``(N + 2, 4)`` zeros
    material: np.ndarray  # ``(N + 2,)`` index


def bodies_in_order(
    position: FloatArray, velocity: FloatArray, spin: FloatArray, radius: FloatArray, material: np.ndarray,
    density: FloatArray, period: float, order: np.ndarray | None = None,
) -> Bodies:  # fmt: skip
    """Particles cell by cell, slab after slab along the longest axis, as rows; or in an order that is given.

    Two spare bodies that just touch follow.
    """
    count = len(position)
    if order is None:
        order = _order_in_space(position, radius, period)
    mass = 4.0 / 3.0 * math.pi * density[material] * (radius * radius * radius)
    inertia = 0.4 * mass * (radius * radius)
    sphere, rates, spins = (np.empty((count + 2, 4)) for _ in range(3))
    for rows, vector, scalar in (
        (sphere, position, radius), (rates, velocity, 1.0 / mass), (spins, spin, 1.0 / inertia),
    ):  # fmt: skip
        rows[:count] = _in_fours(vector, scalar)[order]
        rows[count:] = rows[0]
    sphere[count + 1, 0] += 2.0 * sphere[0, 3]
    rates[count:, :3] = spins[count:, :3] = 0.0
    materials = np.zeros(count + 2, np.uint8)
    materials[:count] = material[order]
    row = np.empty(count, np.int64)
    row[order] = np.arange(count)
    return Bodies(order, row, sphere, rates, spins, np.zeros((count + 2, 4)), materials)


def _order_in_space(position: FloatArray, radius: FloatArray, period: float) -> np.ndarray:
    # Column by column: along short rows NumPy's reductions take ten times as long.
    extent = [float(position[:, k].max() - position[:, k].min()) for k in range(3)]
    # Slabs across the longest axis meet in the fewest pairs. A periodic axis would make the first meet the last.
    axes = [2, 1, 0] if extent[0] > extent[2] else [0, 1, 2]
    if period == 0.0 and extent[1] > extent[axes[2]]:
        axes[1], axes[2] = axes[2], 1
    return bin_cells(_in_fours(position[:, axes], 0.0), 2.0 * CELL_EDGE * float(radius.max()), period)[0]


def as_given(bodies: Bodies) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position, velocity and spin, ``(N, 3)`` each, of the particles in the order in which they were given."""
    return tuple(rows[:, :3][bodies.row] for rows in (bodies.sphere, bodies.velocity, bodies.spin))


def _in_fours(vector: FloatArray, scalar: FloatArray | float) -> FloatArray:
    """Vectors and scalars as rows of four, which NumPy moves faster than rows of three."""
    rows = np.empty((len(vector), 4))
    rows[:, :3], rows[:, 3] = vector, scalar
    return rows
