"""Times that scatter: the middle, the range, and where the middle of another benchmark is to be expected."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student_t

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Spread:
    """Times of one method over the rounds, or its ratios to another's.

    Attributes:
        median, low, high: of the rounds; low and high are the smallest and the largest.
        expected_low, expected_high: where the median of another benchmark of as many rounds lies, with 95 %
            confidence; None for a single round, which says nothing of it.
    """

    median: float
    low: float
    high: float
    expected_low: float | None
    expected_high: float | None


def spread(values: Sequence[float]) -> Spread:
    """The spread of positive values, one a round.

    With s the standard deviation of ln x over n rounds, the median of n others lies within
    median × exp(± t_{n−1} × 1.2533 s √(2/n)): 1.2533 s/√n is the standard error of a median of normal values, and two
    medians scatter √2 as much as one.

    Raises:
        ValueError: no value, or one that is not positive.
    """
    if not len(values) or min(values) <= 0:
        raise ValueError(f"values={list(values)}; give one or more positive values")
    logarithm = np.log(np.asarray(values, float))
    count, middle = len(values), float(np.median(logarithm))
    if count == 1:
        return Spread(float(values[0]), float(values[0]), float(values[0]), None, None)
    error = math.sqrt(0.5 * math.pi) * float(logarithm.std(ddof=1)) * math.sqrt(2.0 / count)
    reach = float(student_t.ppf(0.5 + 0.5 * CONFIDENCE, count - 1)) * error
    return Spread(
        math.exp(middle), float(min(values)), float(max(values)), math.exp(middle - reach), math.exp(middle + reach)
    )
