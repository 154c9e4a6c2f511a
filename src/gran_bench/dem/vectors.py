"""Products of many vectors at once, rows of arrays ``(M, 3)``, faster than NumPy's own along short rows."""

import numpy as np

from gran_bench.state import FloatArray


def dot(first: FloatArray, second: FloatArray) -> FloatArray:
    """Scalar products of rows, ``(M,)`` of ``(M, 3)``; reductions along short rows take three times as long."""
    x, y, z = (first * second).T
    return x + y + z


def cross(first: FloatArray, second: FloatArray) -> FloatArray:
    """Vector products of rows, ``(M, 3)``; np.cross takes longer."""
    (ax, ay, az), (bx, by, bz) = first.T, second.T
    return np.stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)).T


def take_rows(array: np.ndarray, index: np.ndarray) -> np.ndarray:
    """``array[index]`` of rows, several times as fast."""
    return np.take(array.T, index, axis=-1).T
