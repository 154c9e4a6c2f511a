"""The noise floor of the physics: how far runs of the DEM that differ by 1e-9 m are from each other."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.stats import t as student_t

from gran_bench.metrics.measured import Measured, mean_of

CONFIDENCE = 0.95
Run = TypeVar("Run")


@dataclass(frozen=True)
class Interval:
    """Where a further replica's figure lies with a confidence of 95 %, in the figure's unit."""

    mean: float
    low: float
    high: float

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high


def score(metric: Callable[[Run, Run], Measured], candidate: Run, replicas: Sequence[Run], unit: str) -> Measured:
    """Mean over the replicas of metric(candidate, replica); undefined where one of them is."""
    return mean_of([metric(candidate, replica) for replica in replicas], unit)


def noise_floor(metric: Callable[[Run, Run], Measured], replicas: Sequence[Run], unit: str) -> Measured:
    """Mean over all pairs of replicas of metric(a, b); undefined below two replicas."""
    if len(replicas) < 2:
        return Measured.undefined(unit, "a single replica has no noise floor; make two or more")
    return mean_of([metric(replicas[i], replicas[j]) for i in range(len(replicas)) for j in range(i)], unit)


def prediction_interval(figures: Sequence[float]) -> Interval | None:
    """95 % prediction interval of one more figure, mean ± t s √(1 + 1/n), t of Student; None below two figures."""
    count = len(figures)
    if count < 2:
        return None
    mean, deviation = float(np.mean(figures)), float(np.std(figures, ddof=1))
    reach = float(student_t.ppf(0.5 + 0.5 * CONFIDENCE, count - 1)) * deviation * math.sqrt(1.0 + 1.0 / count)
    return Interval(mean, mean - reach, mean + reach)
