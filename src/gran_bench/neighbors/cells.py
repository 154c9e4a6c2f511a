"""Neighbour pairs from a jitted cell list: fast, with the answer of the KD-tree (tree.py)."""

from __future__ import annotations

import math

import numpy as np

from gran_bench.neighbors.kernel import entry, kernel
from gran_bench.neighbors.lanes import LANES, clear_lowest, lowest_lane, near_lanes
from gran_bench.neighbors.tree import IndexArray, check_period, wrapped
from gran_bench.state import FloatArray


def cell_pairs(position: FloatArray, reach: float, period: float = 0.0) -> IndexArray:
    """The same pairs as :func:`tree_pairs`, ``(M, 2)`` with i < j, sorted, from the jitted cell list.

    Args:
        position: ``(N, 3)`` m.
        reach: m.
        period: length of the periodic y axis, m; 0 for none.

    Raises:
        ValueError: a period that is shorter than twice the reach.
    """
    check_period(period, reach)
    sphere = np.zeros((len(position), 4))
    sphere[:, :3] = wrapped(position, period)
    first, second = list_pairs(sphere, reach, period)
    pairs = np.stack((first, second), axis=1).astype(np.int64)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def cell_neighbors(
    query: FloatArray, source: FloatArray, reach: float, period: float = 0.0
) -> tuple[IndexArray, IndexArray]:
    """The same neighbours as :func:`tree_neighbors` from the jitted cell list, sorted by query only.

    Args:
        query: ``(Q, 3)`` m.
        source: ``(S, 3)`` m.
        reach: m.
        period: length of the periodic y axis, m; 0 for none.

    Raises:
        ValueError: a period that is shorter than twice the reach.
    """
    check_period(period, reach)
    if len(query) == 0 or len(source) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return _list_neighbors(wrapped(np.concatenate((query, source)), period), len(query), reach, period)


@entry
def bin_cells(sphere, edge, period):
    """Counting sort of N centres into cells of at least ``edge`` m, x running fastest.

    Returns the ``(N,)`` particle of each rank, the ``(C + 1,)`` first rank of each cell, the ``(N,)`` cell of each
    rank, and the numbers of cells along x, y and z.
    """
    count = len(sphere)
    low, high = np.empty(3), np.empty(3)
    for axis in range(3):
        low[axis], high[axis] = sphere[0, axis], sphere[0, axis]
    for i in range(count):
        for axis in range(3):
            low[axis] = min(low[axis], sphere[i, axis])
            high[axis] = max(high[axis], sphere[i, axis])
    if period > 0.0:
        high[1] = low[1] + period  # one period holds all, wherever it starts
    # A few particles far out must not make more cells than particles can fill.
    budget = 4 * count + 4096
    cells, width = np.empty(3, np.int64), np.empty(3)
    scale = edge
    while True:
        total = 1.0
        for axis in range(3):
            total *= max(1.0, math.floor((high[axis] - low[axis]) / scale))
        if total <= budget:
            break
        scale *= 1.3
    for axis in range(3):
        span = high[axis] - low[axis]
        cells[axis] = max(1, int(span / scale))
        width[axis] = span / cells[axis] if span > 0.0 else 1.0
    if period > 0.0 and cells[1] < 3:
        cells[1] = 1  # two cells would meet on both sides; one cell leaves the images to the distance
        width[1] = period
    cell_of, start = np.empty(count, np.int64), np.zeros(cells[0] * cells[1] * cells[2] + 1, np.int64)
    for i in range(count):
        x = min(cells[0] - 1, int((sphere[i, 0] - low[0]) / width[0]))
        along = sphere[i, 1] - low[1]
        if period > 0.0:
            along -= period * math.floor(along / period)  # particles may have left their period since it was wrapped
        y = min(cells[1] - 1, int(along / width[1]))
        z = min(cells[2] - 1, int((sphere[i, 2] - low[2]) / width[2]))
        cell_of[i] = (z * cells[1] + y) * cells[0] + x
        start[cell_of[i] + 1] += 1
    for c in range(len(start) - 1):
        start[c + 1] += start[c]
    order, cell_of_rank, fill = np.empty(count, np.int64), np.empty(count, np.int64), start[:-1].copy()
    for i in range(count):
        rank = fill[cell_of[i]]
        fill[cell_of[i]] += 1
        order[rank], cell_of_rank[rank] = i, cell_of[i]
    return order, start, cell_of_rank, cells


@entry
def list_pairs(sphere, margin, period, begin=0, end=-1):
    """Half list of the pairs whose surfaces are closer than ``margin``: two ``(M,)`` uint32 arrays, first < second.

    Args:
        sphere: ``(N, 4)`` x, y, z and radius, m; radius 0 makes ``margin`` the distance of centres.
        margin: m.
        period: length of the periodic y axis, m; 0 for none.
        begin, end: only pairs whose first is in ``begin … end − 1``; all where ``end`` is negative.
    """
    count = len(sphere)
    stop = count if end < 0 else end
    if count < 2:
        return np.empty(0, np.uint32), np.empty(0, np.uint32)
    largest = 0.0
    for i in range(count):
        largest = max(largest, sphere[i, 3])
    order, start, _, cells = bin_cells(sphere, 2.0 * largest + margin, period)
    # In the order of the cells, so that what a cell may meet is a few runs of neighbours in memory, held against one
    # particle in SIMD. The last lanes of a run may lie beyond the last particle.
    x, y, z, r = np.empty(count + LANES), np.empty(count + LANES), np.empty(count + LANES), np.empty(count + LANES)
    for rank in range(count + LANES):
        i = order[min(rank, count - 1)]
        x[rank] = sphere[i, 0]
        y[rank] = sphere[i, 1]
        z[rank] = sphere[i, 2]
        r[rank] = sphere[i, 3]
    inverse_period = 1.0 / period if period > 0.0 else 0.0
    first, second = np.empty(8 * count + 64, np.uint32), np.empty(8 * count + 64, np.uint32)
    run_begin, run_end = np.empty(5, np.int64), np.empty(5, np.int64)
    found = 0
    for cell in range(len(start) - 1):
        own = start[cell + 1] - start[cell]
        if own == 0:
            continue
        met = _half_shell(cell, cells, start, period, run_begin, run_end)
        if stop - begin < count and not _any_between(order, run_begin, run_end, begin, stop):
            continue
        if found + own * met >= len(first):
            room = 2 * (len(first) + own * met)
            first, second = _enlarged(first, room), _enlarged(second, room)
        for a in range(start[cell], start[cell + 1]):
            i = order[a]
            for run in range(5):
                b = a + 1 if run == 0 else run_begin[run]
                while b < run_end[run]:
                    hits = near_lanes(x, y, z, r, b, x[a], y[a], z[a], r[a] + margin, period, inverse_period)
                    while hits != 0:
                        lane = b + lowest_lane(hits)
                        if lane >= run_end[run]:
                            break
                        j = order[lane]
                        low = min(i, j)
                        first[found], second[found] = low, max(i, j)
                        found += begin <= low < stop
                        hits = clear_lowest(hits)
                    b += LANES
    return first[:found].copy(), second[:found].copy()


@kernel
def _half_shell(cell, cells, start, period, run_begin, run_end):
    """The runs of ranks that a cell may meet: itself and the 13 of its 26 neighbours that come after it.

    Three cells of a row are one run, so the half shell is five: the rest of the row, the next row, and three rows of
    the layer above. Returns how many particles they hold.
    """
    nx, ny, nz = cells[0], cells[1], cells[2]
    column, line, layer = cell % nx, (cell // nx) % ny, cell // (nx * ny)
    left, right = max(0, column - 1), min(nx - 1, column + 1)
    run_begin[0], run_end[0] = start[cell], start[cell - column + right + 1]
    met = run_end[0] - run_begin[0]
    for row in range(1, 5):
        run_begin[row], run_end[row] = 0, 0
        to_layer = layer if row == 1 else layer + 1
        to_line = line + 1 if row == 1 else line + row - 3
        if to_layer >= nz:
            continue
        if to_line < 0 or to_line >= ny:
            if period == 0.0 or ny == 1:
                continue
            to_line = (to_line + ny) % ny
        base = (to_layer * ny + to_line) * nx
        run_begin[row], run_end[row] = start[base + left], start[base + right + 1]
        met += run_end[row] - run_begin[row]
    return met


@kernel
def _any_between(order, run_begin, run_end, begin, end):
    """Whether one of the particles of the five runs is in ``begin … end − 1``."""
    for run in range(5):
        for rank in range(run_begin[run], run_end[run]):
            if begin <= order[rank] < end:
                return True
    return False


@entry
def _list_neighbors(point, query_count, reach, period):
    """Query and source index of every hit, of ``(Q + S, 3)`` points of which the first Q ask."""
    order, start, cell_of_rank, cells = bin_cells(point, reach, period)
    rank_of, place = np.empty(len(point), np.int64), np.empty((len(point), 3))
    for rank in range(len(point)):
        rank_of[order[rank]] = rank
        place[rank] = point[order[rank]]
    nx, ny, nz = cells[0], cells[1], cells[2]
    query, source = np.empty(32 * query_count, np.int64), np.empty(32 * query_count, np.int64)
    found = 0
    for i in range(query_count):
        cell = cell_of_rank[rank_of[i]]
        x, y, z = cell % nx, (cell // nx) % ny, cell // (nx * ny)
        left, right = max(0, x - 1), min(nx - 1, x + 1)
        for row in range(9):
            layer, line = z + row // 3 - 1, y + row % 3 - 1
            if layer < 0 or layer >= nz:
                continue
            if line < 0 or line >= ny:
                if period == 0.0 or ny == 1:
                    continue
                line = (line + ny) % ny
            base = (layer * ny + line) * nx
            begin, end = start[base + left], start[base + right + 1]
            if found + end - begin > len(query):
                room = 2 * (len(query) + end - begin)
                query, source = _enlarged(query, room), _enlarged(source, room)
            for other in range(begin, end):
                dx = place[other, 0] - point[i, 0]
                dy = place[other, 1] - point[i, 1]
                dz = place[other, 2] - point[i, 2]
                if period > 0.0:
                    dy -= period * np.rint(dy / period)
                query[found], source[found] = i, order[other] - query_count
                found += order[other] >= query_count and dx * dx + dy * dy + dz * dz < reach * reach
    return query[:found].copy(), source[:found].copy()


@kernel
def _enlarged(array, room):
    larger = np.empty(room, array.dtype)
    for k in range(len(array)):  # a slice would take longer to compile than all the rest
        larger[k] = array[k]
    return larger
