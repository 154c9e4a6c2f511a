"""What few independent runs of a chaotic flow tell of its mean, and of the difference of two means."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from gran_bench.state import FloatArray


@dataclass(frozen=True)
class Interval:
    """An estimate, its standard error, and half its 95 % interval."""

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
    """Mean of ``(n,)`` independent values of standard deviation s: known to t s/√n, t Student's with n − 1 freedoms.

    Raises:
        ValueError: fewer than two values.
    """
    values = np.asarray(values, float)
    if values.ndim != 1 or len(values) < 2:
        raise ValueError(f"values of shape {values.shape} have no scatter; give at least two of them")
    error = float(values.std(ddof=1)) / math.sqrt(len(values))
    return Interval(float(values.mean()), error, float(student.ppf(0.975, len(values) - 1)) * error)


def difference_of(first: FloatArray, second: FloatArray) -> Interval:
    """Mean of the first ``(n,)`` minus that of the second ``(m,)``, unpaired, with Welch's 95 % interval.

    Raises:
        ValueError: fewer than two values.

    Source: Welch (1947), Biometrika 34, 28–35.
    """
    one, other = mean_of(first), mean_of(second)
    squares = one.standard_error**2, other.standard_error**2
    error, freedom = math.sqrt(sum(squares)), math.inf
    if error:
        freedom = sum(squares) ** 2 / (squares[0] ** 2 / (len(first) - 1) + squares[1] ** 2 / (len(second) - 1))
    return Interval(one.middle - other.middle, error, float(student.ppf(0.975, freedom)) * error)
