"""Neighbour pairs from a KD-tree: readable and exact.

A period L > 0 makes the y axis periodic: y lives in [−L/2, L/2) and distances take the nearest image.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gran_bench.state import FloatArray

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

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
    inside = wrapped(query, period)
    hits = tree.query_ball_point(inside, reach, return_sorted=True)
    count = np.fromiter(map(len, hits), np.int64, len(hits))
    query_index = np.repeat(np.arange(len(query)), count)
    source_index = np.concatenate([np.asarray(h, np.int64) for h in hits]) if count.any() else np.zeros(0, np.int64)
    offset = nearest_image(source[source_index] - query[query_index], period)
    near = np.einsum("mk,mk->m", offset, offset) < reach**2
    return query_index[near], source_index[near]


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


def wrapped(position: FloatArray, period: float) -> FloatArray:
    """The coordinates that the searches use: as given, or with y wrapped into one period from 0."""
    return position if period == 0 else _shifted(position, period)


def _tree(position: FloatArray, period: float, reach: float) -> cKDTree:
    from scipy.spatial import cKDTree  # a third of a second to load, and only a reference needs it

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
