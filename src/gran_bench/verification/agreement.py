"""Whether two samples of independent runs have the same mean: intervals, and what few runs can tell.

A run of a chaotic flow is one draw. With n draws of standard deviation s the mean is known to t s/√n, t Student's
quantile of n − 1 degrees of freedom; the difference of two means to Welch's interval.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from gran_bench.state import FloatArray


@dataclass(frozen=True)
class Interval:
    """A mean and how well it is known.

    Attributes:
        middle: the estimate.
        standard_error: of it.
        half_width: of the 95 % interval.
    """

    middle: float
    standard_error: float
    half_width: float

    @property
    def standard_errors_from_zero(self) -> float:
        """|middle| in standard errors; infinite where the error is zero and the middle is not."""
        if self.standard_error == 0.0:
            return math.inf if self.middle else 0.0
        return abs(self.middle) / self.standard_error


def mean_of(values: FloatArray) -> Interval:
    """Mean of n independent values with Student's 95 % interval.

    Args:
        values: ``(n,)``, n ≥ 2.

    Raises:
        ValueError: fewer than two values.
    """
    values = _sample(values)
    error = float(values.std(ddof=1)) / math.sqrt(len(values))
    return Interval(float(values.mean()), error, _quantile(len(values) - 1) * error)


def difference_of(first: FloatArray, second: FloatArray) -> Interval:
    """Mean of the first sample minus that of the second, unpaired, with Welch's 95 % interval.

    Args:
        first: ``(n,)``, n ≥ 2.
        second: ``(m,)``, m ≥ 2.

    Raises:
        ValueError: fewer than two values.

    Source: Welch (1947), Biometrika 34, 28–35.
    """
    one, other = mean_of(first), mean_of(second)
    squares = one.standard_error**2, other.standard_error**2
    error, freedom = math.sqrt(sum(squares)), math.inf
    if error:
        freedom = sum(squares) ** 2 / (squares[0] ** 2 / (len(first) - 1) + squares[1] ** 2 / (len(second) - 1))
    return Interval(one.middle - other.middle, error, _quantile(freedom) * error)


def _sample(values: FloatArray) -> FloatArray:
    values = np.asarray(values, float)
    if values.ndim != 1 or len(values) < 2:
        raise ValueError(f"values of shape {values.shape} have no scatter; give at least two of them")
    return values


def _quantile(freedom: float) -> float:
    return float(student.ppf(0.975, freedom))
