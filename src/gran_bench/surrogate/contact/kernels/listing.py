"""Which pairs are near, which of those that once were still are, and who is near a wall, jitted."""

from pathlib import Path

import numpy as np

from gran_bench import dem, neighbors
from gran_bench.dem.fast.wall_list import shape_of, toward_wall
from gran_bench.neighbors.cells import beside
from gran_bench.neighbors.kernel import LANES, cached, clear_lowest, kernel, lowest_lane, near_lanes

jitted = cached(*(Path(room).parent for room in (__file__, dem.__file__, neighbors.__file__)), nogil=True)


@kernel
def _squared(first, i, second, j, period):  # pragma: no cover - jitted
    """Squared distance of two rows of centres, to the nearest image along y."""
    x, y, z = second[j, 0] - first[i, 0], second[j, 1] - first[i, 1], second[j, 2] - first[i, 2]
    if period > 0.0:
        y -= period * np.floor(y / period + 0.5)
    return x * x + y * y + z * z


@jitted
def farthest(sphere, before, period):  # pragma: no cover - jitted
    """The longest way between two states of ``(N, ≥ 3)`` centres, in their unit."""
    longest = 0.0
    for i in range(len(sphere)):
        longest = max(longest, _squared(sphere, i, before, i, period))
    return np.sqrt(longest)


@jitted
def closer(pairs, sphere, reach, period):  # pragma: no cover - jitted
    """Those of the ``(M, 2)`` pairs whose centres are closer than ``reach``, in their order."""
    found, count = np.empty((len(pairs), 2), np.int64), 0
    for c in range(len(pairs)):
        i, j = pairs[c, 0], pairs[c, 1]
        found[count, 0], found[count, 1] = i, j
        count += _squared(sphere, i, sphere, j, period) < reach * reach
    return found[:count].copy()


@jitted
def near_walls(shapes, sphere, reach, found):  # pragma: no cover - jitted
    """Fills in (wall, i), wall by wall, of those closer than ``reach``; how many, −1 where they don't fit.

    ``shapes`` are the first columns of the walls' poses, ``(W, 11)``.
    """
    count = 0
    for w in range(len(shapes)):
        shape = shape_of(shapes, w)
        for i in range(len(sphere)):
            if toward_wall(shape, sphere[i, 0], sphere[i, 1], sphere[i, 2])[0] < reach:
                if count == len(found):
                    return -1
                found[count, 0], found[count, 1] = w, i
                count += 1
    return count


@jitted
def pairs_in_order(sphere, reach, period, order, start, cell_of, cells, pairs):  # pragma: no cover - jitted
    """Fills in all (i, j), i < j, closer than ``reach``, sorted by i, then j; how many, −1 where they don't fit.

    ``order`` to ``cells`` are of :func:`gran_bench.neighbors.bin_cells`.
    """
    count, found, nx, ny = len(sphere), 0, cells[0], cells[1]
    place = np.zeros((4, count + LANES))  # by rank, side by side, for SIMD; of radius 0
    x, y, z, r = place[0], place[1], place[2], place[3]
    for rank in range(count):
        x[rank], y[rank], z[rank] = sphere[order[rank], 0], sphere[order[rank], 1], sphere[order[rank], 2]
    inverse = 1.0 / period if period > 0.0 else 0.0
    for i in range(count):
        column, line, layer = cell_of[i] % nx, (cell_of[i] // nx) % ny, cell_of[i] // (nx * ny)
        first = found
        xi, yi, zi = sphere[i, 0], sphere[i, 1], sphere[i, 2]
        for row in range(9):
            begin, end = beside(column, line, layer, row, start, cells, period)
            if found + end - begin > len(pairs):
                return -1
            for rank in range(begin, end, LANES):
                if period > 0.0:
                    hits = near_lanes(x, y, z, r, rank, xi, yi, zi, reach, period, inverse)
                else:
                    hits = near_lanes(x, y, z, r, rank, xi, yi, zi, reach, None, None)
                hits &= np.uint64(255) >> np.uint64(max(0, rank + LANES - end))
                while hits != 0:
                    j = order[rank + lowest_lane(hits)]
                    hits = clear_lowest(hits)
                    if j > i:
                        slot = found
                        while slot > first and pairs[slot - 1, 1] > j:
                            pairs[slot, 1] = pairs[slot - 1, 1]
                            slot -= 1
                        pairs[slot, 1], pairs[found, 0] = j, i
                        found += 1
    return found
