"""Bodies of a stretch: sorted in space, as rows of four (jitted)."""

from __future__ import annotations

import math

import numpy as np

from gran_bench.dem.kernel import entry, kernel, places, quads
from gran_bench.neighbors import bin_cells

# Edge of the cells that particles are sorted by, in diameters of the largest.
CELL_EDGE = 1.1


@entry()
def bodies_in_order(position, velocity, spin, radius, material, density, period, first, second, known):
    """Particles cell by cell, slab after slab along the longest axis, and rows of four in that order.

    Two spare bodies that just touch follow, far away; they fill lanes that a block does not need.

    Args:
        position, velocity, spin: ``(N, 3)``.
        radius, material: ``(N,)`` m and index.
        density: ``(S,)`` kg/m³.
        period: of y, m; 0 for none.
        first, second, known: ``(C,)``, ``(C,)``, ``(C, 7)`` contacts by particle; called by row here, in place.

    Returns:
        ``(N,)`` particle of each row; ``(N + 2, 4)`` rows (x, y, z, r), (v, 1/m), (ω, 1/I) and zeros; ``(N + 2,)``
        materials.
    """
    count = len(position)
    low, high, largest = position[0].copy(), position[0].copy(), 0.0
    for i in range(count):
        largest = max(largest, radius[i])
        for k in range(3):
            low[k], high[k] = min(low[k], position[i, k]), max(high[k], position[i, k])
    # Slabs across the longest axis meet in the fewest pairs. A periodic axis would make the first meet the last.
    axes = np.array([0, 1, 2])
    if high[0] - low[0] > high[2] - low[2]:
        axes[0], axes[2] = 2, 0
    if period == 0.0 and high[1] - low[1] > high[axes[2]] - low[axes[2]]:
        axes[1], axes[2] = axes[2], 1
    place = quads(count)
    for i in range(count):
        for k in range(3):
            place[i, k] = position[i, axes[k]]
    order = bin_cells(place, 2.0 * CELL_EDGE * largest, period)[0]
    sphere, rates, spins, ahead = quads(count + 2), quads(count + 2), quads(count + 2), quads(count + 2)
    ahead[:] = 0.0
    materials = np.zeros(count + 2, np.uint8)
    for row in range(count):
        i = order[row]
        mass = 4.0 / 3.0 * math.pi * density[material[i]] * radius[i] ** 3
        for k in range(3):
            sphere[row, k], rates[row, k], spins[row, k] = position[i, k], velocity[i, k], spin[i, k]
        sphere[row, 3], rates[row, 3], spins[row, 3] = radius[i], 1.0 / mass, 1.0 / (0.4 * mass * radius[i] ** 2)
        materials[row] = material[i]
    for spare in (count, count + 1):
        for k in range(4):
            sphere[spare, k], rates[spare, k], spins[spare, k] = sphere[0, k], 0.0, 0.0
        rates[spare, 3], spins[spare, 3] = rates[0, 3], spins[0, 3]
    sphere[count + 1, 0] += 2.0 * sphere[0, 3]
    rank = places(count)
    for row in range(count):
        rank[order[row]] = row
    rename(first, second, known, rank)
    return order, sphere, rates, spins, ahead, materials


@kernel
def rename(first, second, known, name):
    """Calls the particles of contacts ``name[i]`` instead of i, in place; the lower name first, walls as they are."""
    for c in range(len(first)):
        a, b = name[first[c]], second[c]
        if b >= 0:
            b = name[b]
            if b < a:
                a, b = b, a
                for k in (0, 1, 2, 4, 5, 6):
                    known[c, k] = -known[c, k]
        first[c], second[c] = a, b
