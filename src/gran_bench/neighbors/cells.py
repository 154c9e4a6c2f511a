"""Neighbour pairs from a jitted cell list: fast, with the answer of the KD-tree (tree.py)."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gran_bench.neighbors.kernel import LANES, WORD, clear_lowest, entry, kernel, lowest_lane, near_lanes
from gran_bench.neighbors.tree import IndexArray, check_period, wrapped
from gran_bench.state import FloatArray


def cell_neighbors(
    query: FloatArray, source: FloatArray, reach: float, period: float = 0.0
) -> tuple[IndexArray, IndexArray]:
    """Query and source index, ``(M,)`` each, of every source point closer than ``reach``, m, to every query point.

    They are sorted by query; a point among both is its own neighbour. Of ``(Q, 3)`` and ``(S, 3)`` m, and the length of
    the periodic y axis, m; 0 for none.

    Raises:
        ValueError: a period that is shorter than twice the reach.
    """
    check_period(period, reach)
    if len(query) == 0 or len(source) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    point = wrapped(np.concatenate((query, source)), period)
    order, *binned = bin_cells(point, reach, period)
    return _filled(
        np.int64, 32 * len(query),
        lambda *lists: find_neighbors(point, point[order], len(query), reach, period, order, *binned, *lists),
    )  # fmt: skip


def bin_cells(sphere: FloatArray, edge: float, period: float) -> tuple[IndexArray, IndexArray, IndexArray, IndexArray]:
    """Counting sort of ``(N, ≥ 3)`` centres, m, into cells of at least ``edge`` m, x running fastest.

    Returns:
        The ``(N,)`` particle of each rank, the ``(C + 1,)`` first rank of each cell, the ``(N,)`` cell of each
        particle, and the ``(3,)`` numbers of cells along x, y and z.

    Raises:
        ValueError: a coordinate or a size that is not finite, or a reach of nothing.
    """
    low, high = extremes(sphere).tolist()
    if period > 0.0:
        high[1] = low[1] + period  # one period holds all, wherever it starts
    span = [top - bottom for top, bottom in zip(high, low, strict=True)]
    if not (0.0 < edge < math.inf and all(math.isfinite(side / edge) for side in span)):
        raise ValueError(
            f"positions that span {span} m have no cells of {edge:g} m; all must be finite, and the reach above zero"
        )
    # A few particles far out must not make more cells than particles can fill.
    budget, scale = 4 * len(sphere) + 4096, edge
    while math.prod(max(1, math.floor(side / scale)) for side in span) > budget:
        scale *= 1.3
    cells = [max(1, int(side / scale)) for side in span]
    width = [side / number if side > 0.0 else 1.0 for side, number in zip(span, cells, strict=True)]
    if period > 0.0 and cells[1] < 3:
        # Two cells would meet on both sides; one cell leaves the images to the distance.
        cells[1], width[1] = 1, period
    order, cell_of = np.empty((2, len(sphere)), np.int64)
    start, cells = np.zeros(math.prod(cells) + 2, np.int64), np.array(cells)
    sort_into_cells(sphere, np.array(low), np.array(width), cells, period, cell_of, start, order)
    return order, start[:-1], cell_of, cells


@entry
def extremes(position):
    """Lowest and highest coordinates, ``(2, 3)``, of ``(N, ≥ 3)``; NaN along an axis where one is not finite."""
    # NumPy's reductions along short rows, or across them, take ten times as long.
    found = np.empty((2, 3))
    for k in range(3):
        low, high, sound = np.inf, -np.inf, True
        for i in range(len(position)):
            sound &= position[i, k] - position[i, k] == 0.0
            low, high = min(low, position[i, k]), max(high, position[i, k])
        found[0, k], found[1, k] = (low, high) if sound else (np.nan, np.nan)
    return found


@entry
def sort_into_cells(sphere, low, width, cells, period, cell_of, start, order):
    """Fills ``cell_of``, ``start``, zeros and one place too long, and ``order`` of :func:`bin_cells`."""
    for i in range(len(sphere)):
        x = min(cells[0] - 1, int((sphere[i, 0] - low[0]) / width[0]))
        along = sphere[i, 1] - low[1]
        if period > 0.0:
            along -= period * math.floor(along / period)  # particles may have left their period since it was wrapped
        y = min(cells[1] - 1, int(along / width[1]))
        z = min(cells[2] - 1, int((sphere[i, 2] - low[2]) / width[2]))
        cell_of[i] = (z * cells[1] + y) * cells[0] + x
        start[cell_of[i] + 2] += 1
    for c in range(2, len(start)):
        start[c] += start[c - 1]
    for i in range(len(sphere)):
        order[start[cell_of[i] + 1]] = i
        start[cell_of[i] + 1] += 1


def list_pairs(
    sphere: FloatArray, margin: float, period: float, begin: int = 0, end: int = -1
) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Half list of the pairs whose surfaces are closer than ``margin``: two ``(M,)`` arrays, first < second.

    Args:
        sphere, margin: ``(N, 4)`` x, y, z and radius, m; radius 0 makes ``margin`` the distance of centres, m.
        period, begin, end: of y, m, or 0; only pairs whose first is in ``begin … end − 1``, all where that is −1.

    Raises:
        ValueError: a coordinate or a size that is not finite, or a reach of nothing.
    """
    binned, stop = bin_pairs(sphere, margin, period), len(sphere) if end < 0 else end
    if binned is None:
        return np.empty(0, np.uint32), np.empty(0, np.uint32)
    return _filled(
        np.uint32, 8 * len(sphere) + 64, lambda *lists: find_pairs(sphere, margin, period, begin, stop, *binned, *lists)
    )


def bin_pairs(sphere: FloatArray, margin: float, period: float) -> tuple[IndexArray, IndexArray, IndexArray] | None:
    """Cells for :func:`find_pairs`: particles by rank, first rank of each cell, numbers of cells; or None: no pairs."""
    if len(sphere) < 2:
        return None
    order, start, _, cells = bin_cells(sphere, 2.0 * float(sphere[:, 3].max()) + margin, period)
    return order, start, cells


def _filled(dtype: type, room: int, fill: Callable[..., int]) -> tuple[np.ndarray, np.ndarray]:
    """Two arrays of what ``fill`` finds; where it has too little room, it says −1 and is called again with more."""
    while (found := fill(*(lists := np.empty((2, room), dtype)))) < 0:
        room *= 4
    return lists[0, :found].copy(), lists[1, :found].copy()


@entry
def find_pairs(sphere, margin, period, begin, stop, order, start, cells, first, second):
    """Fills ``first`` and ``second`` of :func:`list_pairs`; returns how many there are, or −1 where they do not fit."""
    # What a cell may meet is copied side by side, once for all its particles, which are each held against it in SIMD.
    shell, who = np.empty((4, len(order) + LANES)), np.empty(len(order) + LANES, np.int64)
    x, y, z, r = shell[0], shell[1], shell[2], shell[3]
    runs = np.empty((2, 5), np.int64)
    inverse_period = 1.0 / period if period > 0.0 else 0.0
    found, run_begin, run_end = 0, runs[0], runs[1]
    for cell in range(len(start) - 1):
        own = start[cell + 1] - start[cell]
        if own == 0:
            continue
        met = _half_shell(cell, cells, start, period, run_begin, run_end)
        if stop - begin < len(order) and not _any_between(order, run_begin, run_end, begin, stop):
            continue
        if found + own * met >= len(first):
            return -1
        place = 0
        for run in range(5):
            for rank in range(run_begin[run], run_end[run]):
                i = order[rank]
                x[place], y[place], z[place], r[place] = sphere[i, 0], sphere[i, 1], sphere[i, 2], sphere[i, 3]
                who[place] = i
                place += 1
        x[place : place + LANES] = np.inf  # the last lanes are near nobody
        for a in range(own):
            i = who[a]
            for b in range(a + 1, place, WORD):
                hits = np.uint64(0)
                for lane in range(0, min(WORD, place - b), LANES):
                    if period > 0.0:
                        near = near_lanes(x, y, z, r, b + lane, x[a], y[a], z[a], r[a] + margin, period, inverse_period)
                    else:
                        near = near_lanes(x, y, z, r, b + lane, x[a], y[a], z[a], r[a] + margin, None, None)
                    hits |= near << np.uint64(lane)
                while hits != 0:
                    j = who[b + lowest_lane(hits)]
                    low = min(i, j)
                    first[found], second[found] = low, max(i, j)
                    found += begin <= low < stop
                    hits = clear_lowest(hits)
    return found


@kernel
def _half_shell(cell, cells, start, period, run_begin, run_end):
    """Five runs of ranks: a cell and the 13 neighbours that come after it; returns how many particles they hold."""
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


@kernel
def beside(x, y, z, row, start, cells, period):
    """Ranks, from and to, in one of nine rows of three cells around a cell; none where the row is outside."""
    nx, ny, nz = cells[0], cells[1], cells[2]
    line, layer = y + row % 3 - 1, z + row // 3 - 1
    if layer < 0 or layer >= nz:
        return 0, 0
    if line < 0 or line >= ny:
        if period == 0.0 or ny == 1:
            return 0, 0
        line = (line + ny) % ny
    base = (layer * ny + line) * nx
    return start[base + max(0, x - 1)], start[base + min(nx - 1, x + 1) + 1]


@entry
def find_neighbors(point, place, query_count, reach, period, order, start, cell_of, cells, query, source):
    """Fills in query and source index of each hit; returns how many there are, or −1 where they do not fit.

    Of the points, as given and by rank as ``place``, the first ask for their neighbours.
    """
    found, nx, ny = 0, cells[0], cells[1]
    for i in range(query_count):
        x, y, z = cell_of[i] % nx, (cell_of[i] // nx) % ny, cell_of[i] // (nx * ny)
        for row in range(9):
            begin, end = beside(x, y, z, row, start, cells, period)
            if found + end - begin > len(query):
                return -1
            for other in range(begin, end):
                dx, dy, dz = place[other, 0] - point[i, 0], place[other, 1] - point[i, 1], place[other, 2] - point[i, 2]
                if period > 0.0:
                    dy -= period * np.rint(dy / period)
                query[found], source[found] = i, order[other] - query_count
                found += order[other] >= query_count and dx * dx + dy * dy + dz * dz < reach * reach
    return found
