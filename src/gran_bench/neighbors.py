"""Neighbour pairs: a KD-tree (readable, exact) and a jitted cell list (fast), with the same answer.

A period L > 0 makes the y axis periodic: y lives in [−L/2, L/2) and distances take the nearest image.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gran_bench.state import FloatArray

IndexArray = NDArray[np.int64]


def tree_pairs(position: FloatArray, reach: float, period: float = 0.0) -> IndexArray:
    """All pairs closer than ``reach``, ``(M, 2)`` with i < j, sorted by i, then j.

    Args:
        position: ``(N, 3)`` m.
        reach: m.
        period: length of the periodic y axis, m; 0 for none.

    Raises:
        ValueError: a period that is shorter than twice the reach, so that images are ambiguous.
    """
    if len(position) == 0:
        return np.zeros((0, 2), np.int64)
    pairs = _tree(position, period, reach).query_pairs(reach, output_type="ndarray").astype(np.int64)
    # The tree counts a distance equal to the reach in; a neighbour list means closer.
    offset = nearest_image(position[pairs[:, 1]] - position[pairs[:, 0]], period)
    pairs = pairs[np.einsum("mk,mk->m", offset, offset) < reach**2]
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def tree_neighbors(
    query: FloatArray, source: FloatArray, reach: float, period: float = 0.0
) -> tuple[IndexArray, IndexArray]:
    """Every source point closer than ``reach`` to every query point, without a cap.

    Args:
        query: ``(Q, 3)`` m.
        source: ``(S, 3)`` m.
        reach: m.
        period: length of the periodic y axis, m; 0 for none.

    Returns:
        Query index and source index of each hit, ``(M,)`` each, sorted by query, then source. A point that is
        among both is its own neighbour.

    Raises:
        ValueError: a period that is shorter than twice the reach.
    """
    if len(query) == 0 or len(source) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    tree = _tree(source, period, reach)
    wrapped = _wrapped(query, period)
    hits = tree.query_ball_point(wrapped, reach, return_sorted=True)
    count = np.fromiter(map(len, hits), np.int64, len(hits))
    query_index = np.repeat(np.arange(len(query)), count)
    source_index = np.concatenate([np.asarray(h, np.int64) for h in hits]) if count.any() else np.zeros(0, np.int64)
    offset = nearest_image(source[source_index] - query[query_index], period)
    near = np.einsum("mk,mk->m", offset, offset) < reach**2
    return query_index[near], source_index[near]


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
    sphere[:, :3] = _wrapped(position, period)
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
    return _list_neighbors(_wrapped(np.concatenate((query, source)), period), len(query), reach, period)


def nearest_image(offset: FloatArray, period: float) -> FloatArray:
    """Relative vectors with y taken to the nearest image, ``(M, 3)`` m; the same array where nothing wraps."""
    if period > 0:
        offset = offset.copy()
        offset[:, 1] -= period * np.rint(offset[:, 1] / period)
    return offset


def check_period(period: float, reach: float) -> None:
    """Refuses a period in which a particle could meet two images of another.

    Raises:
        ValueError: a period that is shorter than twice the reach.
    """
    if period and period < 2.0 * reach:
        raise ValueError(
            f"the periodic length {period:g} m is shorter than twice the reach {reach:g} m; lengthen the scene"
        )


def _tree(position: FloatArray, period: float, reach: float) -> cKDTree:
    check_period(period, reach)
    if period == 0:
        return cKDTree(position)
    # cKDTree wants [0, L) on a periodic axis, and takes 0 as "does not wrap".
    return cKDTree(_shifted(position, period), boxsize=(0.0, period, 0.0))


def _shifted(position: FloatArray, period: float) -> FloatArray:
    shifted = np.array(position, dtype=np.float64)
    shifted[:, 1] = np.mod(shifted[:, 1] + 0.5 * period, period)
    shifted[shifted[:, 1] >= period, 1] = 0.0  # np.mod rounds −1e-17 up to the period itself
    return shifted


def _wrapped(position: FloatArray, period: float) -> FloatArray:
    """The coordinates that the searches use: as given, or with y wrapped into one period from 0."""
    return position if period == 0 else _shifted(position, period)


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
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
    # What a cell may meet lies side by side in memory, so that one particle is held against all of it in SIMD.
    name, hit, excess = np.empty(count, np.uint32), np.empty(count, np.uint32), np.empty(count)
    x, y, z, r = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    first, second = np.empty(8 * count + 64, np.uint32), np.empty(8 * count + 64, np.uint32)
    found = 0
    for cell in range(len(start) - 1):
        own = start[cell + 1] - start[cell]
        if own == 0:
            continue
        met = _gather_half_shell(cell, cells, start, order, sphere, period, name, x, y, z, r)
        if stop - begin < count and not _any_between(name, met, begin, stop):
            continue
        if found + own * met >= len(first):
            room = 2 * (len(first) + own * met) + 1
            first, second = _enlarged(first, room), _enlarged(second, room)
        for a in range(own):
            _excess_over_reach(x, y, z, r, a, met, margin, period, excess)
            hits = 0
            for b in range(a + 1, met):
                # Written always, kept only if near: no branch to mispredict.
                hit[hits] = b
                hits += excess[b] < 0.0
            i = name[a]
            for h in range(hits):
                j = name[hit[h]]
                first[found], second[found] = min(i, j), max(i, j)
                found += begin <= min(i, j) < stop
    return first[:found].copy(), second[:found].copy()


@njit(cache=True, error_model="numpy")
def _any_between(name, met, begin, end):
    """Whether one of the first ``met`` names is in ``begin … end − 1``."""
    for b in range(met):
        if begin <= name[b] < end:
            return True
    return False


@njit(cache=True, error_model="numpy")
def _excess_over_reach(x, y, z, r, a, met, margin, period, excess):
    """Squared distance of point a from the first ``met`` points, less the squared reach, into ``excess``."""
    xa, ya, za, ra = x[a], y[a], z[a], r[a] + margin
    if period > 0.0:
        for b in range(met):
            dx, dy, dz = x[b] - xa, y[b] - ya, z[b] - za
            dy -= period * np.rint(dy / period)
            reach = ra + r[b]
            excess[b] = dx * dx + dy * dy + dz * dz - reach * reach
    else:
        for b in range(met):
            dx, dy, dz = x[b] - xa, y[b] - ya, z[b] - za
            reach = ra + r[b]
            excess[b] = dx * dx + dy * dy + dz * dz - reach * reach


@njit(cache=True, error_model="numpy")
def _gather_half_shell(cell, cells, start, order, sphere, period, name, x, y, z, r):
    """The particles of a cell, then those of the 13 of its 26 neighbours that come after it; returns their number.

    Three cells of a row are one run of ranks, so the half shell is five runs: the rest of the row, the next row, and
    three rows of the layer above.
    """
    nx, ny, nz = cells[0], cells[1], cells[2]
    column, line, layer = cell % nx, (cell // nx) % ny, cell // (nx * ny)
    left, right = max(0, column - 1), min(nx - 1, column + 1)
    met = 0
    for row in range(5):
        if row == 0:
            begin, end = start[cell], start[cell - column + right + 1]
        else:
            to_layer = layer if row == 1 else layer + 1
            to_line = line + 1 if row == 1 else line + row - 3
            if to_layer >= nz:
                continue
            if to_line < 0 or to_line >= ny:
                if period == 0.0 or ny == 1:
                    continue
                to_line = (to_line + ny) % ny
            base = (to_layer * ny + to_line) * nx
            begin, end = start[base + left], start[base + right + 1]
        for rank in range(begin, end):
            i = order[rank]
            name[met], x[met], y[met], z[met], r[met] = i, sphere[i, 0], sphere[i, 1], sphere[i, 2], sphere[i, 3]
            met += 1
    return met


@njit(cache=True, error_model="numpy")
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


@njit(cache=True)
def _enlarged(array, room):
    larger = np.empty(room, array.dtype)
    for k in range(len(array)):  # a slice would take longer to compile than all the rest
        larger[k] = array[k]
    return larger
