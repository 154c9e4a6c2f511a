"""Bodies of a stretch: sorted in space, as rows of four; and the contacts that they are known to have."""

import math
from typing import NamedTuple

import numpy as np

from gran_bench.dem.integrate import into_period
from gran_bench.neighbors.cells import bin_cells, extremes
from gran_bench.neighbors.kernel import entry
from gran_bench.state import ContactHistory, FloatArray

# Edge of the cells that particles are sorted by, in diameters of the largest.
CELL_EDGE = 1.1


class Known(NamedTuple):
    """Touching contacts of one kind, with pairs or with walls, and what they remember."""

    first: np.ndarray  # and second: ``(C,)`` particles or rows, first < second; or particle and wall
    second: np.ndarray
    slot: FloatArray  # ``(C, 4)`` elastic tangential force and overlap
    moment: FloatArray  # ``(C, 4)`` rolling moment and 0; ``(0, 4)`` where there is no rolling
    ledger: FloatArray  # ``(C, 4)`` ledger of `ContactHistory` and a place; ``(0, 4)`` where nobody asks


def known_contacts(history: ContactHistory, name: np.ndarray, rolling: bool) -> tuple[Known, Known]:
    """Pairs and walls of a state, with particle i called ``name[i]`` and the lower name first."""
    memory, known = _in_fours(history.force, history.overlap), []
    moment = _in_fours(history.rolling_moment, 0.0) if rolling else None
    ledger = _in_fours(history.ledger, 0.0) if history.ledger.shape[1] else None
    for part in (np.flatnonzero(history.second >= 0), np.flatnonzero(history.second < 0)):
        more = (np.zeros((0, 4)) if array is None else array[part] for array in (moment, ledger))
        known.append(Known(history.first[part], history.second[part], memory[part], *more))
    pairs, walls = known
    return renamed(pairs, walls._replace(second=-1 - walls.second), name)


def contact_history(pairs: Known, walls: Known, name: np.ndarray) -> ContactHistory:
    """What a state remembers: pairs and then walls, with row i called ``name[i]``."""
    pairs, walls = renamed(pairs, walls, name)
    both = pairs, walls._replace(second=-1 - walls.second)
    first, second, slot, *more = (np.concatenate(arrays) for arrays in zip(*both, strict=True))
    rolling, ledger = (array[:, :3].copy() if len(array) else None for array in more)
    return ContactHistory(first, second, slot[:, :3].copy(), slot[:, 3].copy(), rolling, ledger)


def renamed(pairs: Known, walls: Known, name: np.ndarray) -> tuple[Known, Known]:
    """Contacts with particle i called ``name[i]``, the lower name of a pair first, so that its memory may turn."""
    pairs = Known(*(array.copy() for array in pairs))
    rename_pairs(pairs.first, pairs.second, pairs.slot, pairs.moment, name)
    return pairs, walls._replace(first=np.take(name, walls.first))


@entry
def rename_pairs(first, second, slot, moment, name):
    """Gives pairs their names by ``name`` and turns what they remember, all in place."""
    for c in range(len(first)):
        one, other = name[first[c]], name[second[c]]
        first[c], second[c] = min(one, other), max(one, other)
        if other < one:
            for k in range(3):
                slot[c, k] *= -1.0
                if len(moment) > 0:
                    moment[c, k] *= -1.0


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
    sphere, rates, spins = zeros(3, count + 2, 4)
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
    return Bodies(order, row, sphere, rates, spins, zeros(count + 2, 4), materials)


def sorted_again(bodies: Bodies, period: float) -> tuple[Bodies, np.ndarray]:
    """The bodies in the order that :func:`bodies_in_order` would find now, y in the period; and their rows before."""
    count = len(bodies.order)
    sphere = into_period(np.take(bodies.sphere, bodies.row, axis=0), period)
    order = _order_in_space(sphere, sphere[:, 3], period)
    before = np.append(np.take(bodies.row, order), (count, count + 1))
    rows = zeros(3, count + 2, 4)
    for new, old in zip(rows, bodies[2:5], strict=True):
        take_rows(old, before, new)
    into_period(rows[0, :count], period)
    row = np.empty(count, np.int64)
    row[order] = np.arange(count)
    return Bodies(order, row, *rows, bodies.ahead, np.take(bodies.material, before)), before


@entry
def take_rows(old, before, new):
    """``new`` gets the rows of ``old`` by their numbers ``before``, ``(N + 2, 4)`` each."""
    for i in range(len(before)):
        for k in range(4):
            new[i, k] = old[before[i], k]


@entry
def take_loads(loads, before, bounds):
    """The same of ``(C, N + 2, 4)`` loads, in place: each row is its own chunk's, before and after."""
    own = np.empty((len(before), 4))
    for c in range(len(bounds) - 1):
        for i in range(bounds[c], bounds[c + 1]):
            for k in range(4):
                own[i, k], loads[c, i, k] = loads[c, i, k], 0.0
    for c in range(len(bounds) - 1):
        for i in range(bounds[c], bounds[c + 1]):
            for k in range(4):
                loads[c, i, k] = own[before[i], k]


def _order_in_space(position: FloatArray, radius: FloatArray, period: float) -> np.ndarray:
    low, high = extremes(position)
    extent = (high - low).tolist()
    # Slabs across the longest axis meet in the fewest pairs. A periodic axis would make the first meet the last.
    axes = [2, 1, 0] if extent[0] > extent[2] else [0, 1, 2]
    if period == 0.0 and extent[1] > extent[axes[2]]:
        axes[1], axes[2] = axes[2], 1
    return bin_cells(_in_fours(position[:, axes], 0.0), 2.0 * CELL_EDGE * float(radius.max()), period)[0]


@entry
def as_given(order, bounds, sphere, velocity, spin, force, torque, gravity, half, position, rates, spins):
    """Fills in position, velocity and spin, ``(N, 3)`` each, of the particles in the order in which they were given.

    Where ``half``, s, is not 0, the velocities get what is left of their step, as the kick of `stretch.march` would
    give it; ``force`` and ``torque`` are ``(C, N + 2, 4)``, by chunk.
    """
    for c in range(len(bounds) - 1):
        for row in range(bounds[c], bounds[c + 1]):
            i = order[row]
            for k in range(3):
                position[i, k], rates[i, k], spins[i, k] = sphere[row, k], velocity[row, k], spin[row, k]
                if half != 0.0:
                    rates[i, k] += half * (velocity[row, 3] * force[c, row, k] + gravity[k])
                    spins[i, k] += half * (spin[row, 3] * torque[c, row, k])


def _in_fours(vector: FloatArray, scalar: FloatArray | float) -> FloatArray:
    """Vectors and scalars as rows of four, which NumPy moves faster than rows of three."""
    rows = np.empty((len(vector), 4))
    rows[:, :3], rows[:, 3] = vector, scalar
    return rows


def zeros(*shape: int, dtype: type = np.float64) -> np.ndarray:
    """Zeros from the beginning of a cache line on: rows and columns that cross lines take a tenth longer."""
    size, line = math.prod(shape) * np.dtype(dtype).itemsize, 64
    room = np.zeros(size + line, np.uint8)
    skipped = -room.__array_interface__["data"][0] % line
    return room[skipped : skipped + size].view(dtype).reshape(shape)
