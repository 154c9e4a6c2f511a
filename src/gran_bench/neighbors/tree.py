"""Neighbour pairs from a KD-tree: readable and exact.

A period L > 0 makes the y axis periodic: y lives in [−L/2, L/2) and distances take the nearest image.
"""

import numpy as np
from numpy.typing import NDArray

from gran_bench.state import FloatArray

IndexArray = NDArray[np.int64]


def tree_pairs(position: FloatArray, reach: float, period: float = 0.0) -> IndexArray:
    """All pairs of ``(N, 3)`` centres closer than ``reach``, m: ``(M, 2)`` with i < j, sorted by i, then j.

    Raises:
        ValueError: a period that is shorter than twice the reach, so that images are ambiguous.
    """
    from scipy.spatial import cKDTree  # a third of a second to load, and only a reference needs it

    if len(position) == 0:
        return np.zeros((0, 2), np.int64)
    check_period(period, reach)
    # cKDTree wants [0, L) on a periodic axis, and takes 0 as "does not wrap".
    tree = cKDTree(wrapped(position, period), boxsize=(0.0, period, 0.0) if period else None)
    pairs = tree.query_pairs(reach, output_type="ndarray").astype(np.int64)
    # The tree counts a distance equal to the reach in; a neighbour list means closer.
    first, second = pairs.T
    offset = nearest_image(np.take(position, second, axis=0) - np.take(position, first, axis=0), period)
    near = np.flatnonzero(np.einsum("mk,mk->m", offset, offset) < reach**2)
    in_order = near[np.argsort((first * len(position) + second)[near])]
    return np.take(pairs, in_order, axis=0)


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
    if period == 0:
        return position
    shifted = np.array(position, dtype=np.float64)
    shifted[:, 1] = np.mod(shifted[:, 1] + 0.5 * period, period)
    shifted[shifted[:, 1] >= period, 1] = 0.0  # np.mod rounds −1e-17 up to the period itself
    return shifted
