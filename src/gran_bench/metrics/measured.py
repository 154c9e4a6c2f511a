"""What a metric hands back, a number with its unit or the reason why there is none, and the noise floor of such."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student_t

from gran_bench.state import FloatArray

LEAST_VALID_SHARE = 0.9  # below this share of valid states a figure over a series is undefined
CONFIDENCE = 0.95
# Of the time between two states: what a clock may be off by rounding, and by how much two clocks may differ.
SLACK, APART = 1e-4, 1e-2
Run = TypeVar("Run")


@dataclass(frozen=True)
class Measured:
    """One figure of a metric: a finite number in ``unit`` (SI, or the exception that it names), or None.

    ``note`` says why it is undefined, or what to know about a defined value. A value that is not finite, or no value
    and no reason, is a `ValueError`.
    """

    value: float | None
    unit: str
    note: str = ""

    def __post_init__(self) -> None:
        if self.value is None and not self.note:
            raise ValueError("an undefined figure needs a reason; say it in `note`")
        if self.value is not None and not math.isfinite(self.value):
            raise ValueError(f"value={self.value} is not a figure; use Measured.undefined(unit, reason)")

    @classmethod
    def undefined(cls, unit: str, reason: str) -> Measured:
        """No figure, because of ``reason``."""
        return cls(None, unit, reason)

    @classmethod
    def of(cls, value: float, unit: str, reason: str = "the result is not finite") -> Measured:
        """``value`` where it is finite; undefined because of ``reason`` where it is not."""
        return cls(float(value), unit) if math.isfinite(value) else cls.undefined(unit, reason)

    @property
    def defined(self) -> bool:
        """Whether there is a value."""
        return self.value is not None

    @property
    def number(self) -> float:
        """The value; a `ValueError` where there is none."""
        if self.value is None:
            raise ValueError(f"undefined: {self.note}")
        return self.value

    def difference(self, other: Measured) -> Measured:
        """Absolute difference; undefined where one of the two is."""
        for figure in (self, other):
            if not figure.defined:
                return figure
        return Measured(abs(self.number - other.number), self.unit, self.note)

    def __str__(self) -> str:
        return f"{self.value:.4g} {self.unit}".rstrip() if self.value is not None else f"undefined ({self.note})"


def mean_of(figures: list[Measured], unit: str) -> Measured:
    """Mean of figures that are all defined; undefined where one is not, because a failure may not drop out."""
    if not figures:
        return Measured.undefined(unit, "nothing to average")
    for figure in figures:
        if not figure.defined:
            return Measured.undefined(unit, figure.note)
    noted = [figure.note for figure in figures if figure.note]
    note = noted[0] if noted else ""
    if len({figure.note for figure in figures}) > 1:
        note += f" (this or the like in {len(noted)} of {len(figures)} runs)"
    return Measured(float(np.mean([figure.number for figure in figures])), unit, note)


@dataclass(frozen=True)
class Series:
    """A figure of every stored state."""

    time: FloatArray  # (F,) s
    value: FloatArray  # (F,) in the unit; NaN where a state has no valid figure
    unit: str
    undefined_because: str = ""  # why no state has a figure, whatever was computed
    invalid_because: str = "no valid figure"  # what an invalid single state lacks, for the notes

    def __post_init__(self) -> None:
        for name in ("time", "value"):
            object.__setattr__(self, name, np.asarray(getattr(self, name)))
        if self.time.shape != self.value.shape:
            raise ValueError(f"series value has shape {self.value.shape}; expected {self.time.shape}, one a state")

    @property
    def valid(self) -> NDArray[np.bool_]:
        """``(F,)`` states that have a figure."""
        return np.isfinite(self.value) & (not self.undefined_because)

    def mean(self, start: float = -math.inf, end: float = math.inf) -> Measured:
        """Mean over the valid states with start ≤ t < end, undefined below 90 % of them."""
        chosen, refusal, note = self._chosen(start, end)
        if refusal:
            return Measured.undefined(self.unit, refusal)
        return Measured(float(self.value[chosen].mean()), self.unit, note)

    def largest(self, start: float = -math.inf, end: float = math.inf) -> tuple[Measured, Measured]:
        """Largest valid value with start ≤ t < end, and when (s); undefined below 90 % valid states."""
        chosen, refusal, note = self._chosen(start, end)
        if refusal:
            return Measured.undefined(self.unit, refusal), Measured.undefined("s", refusal)
        where = int(np.argmax(np.where(chosen, self.value, -np.inf)))
        return Measured(float(self.value[where]), self.unit, note), Measured(float(self.time[where]), "s", note)

    def difference(self, other: Series) -> Measured:
        """Mean absolute difference over the states valid in both, undefined below 90 % of the states.

        A state that only one of the two has counts as invalid: a rollout that ended early is not a shorter one. States
        at different times are a `ValueError`.
        """
        reason = self.undefined_because or other.undefined_because
        cause = self.invalid_because if self.invalid_because == other.invalid_because else "no valid figure in both"
        shared = shared_states(self.time, other.time)
        distance = np.abs(self.value[:shared] - other.value[:shared])
        gap = Series.of_two(self.time, other.time, distance, self.unit, cause)
        found, total, good = replace(gap, undefined_because=reason).mean(), len(gap.time), int(self.valid.sum())
        further = good - int(gap.valid.sum())
        if reason or not further:
            return found
        return replace(
            found, note=f"{total - good} of {total} states invalid, and {further} more of the other run: {cause}"
        )

    @classmethod
    def of_two(cls, a: FloatArray, b: FloatArray, value: FloatArray, unit: str, invalid_because: str) -> Series:
        """What was found in the states that two clocks (s) share, on the longer one; the others are invalid."""
        time = a if len(a) >= len(b) else b
        padded = np.full(len(time), np.nan)
        padded[: len(value)] = value
        return cls(time, padded, unit, invalid_because=invalid_because)

    def _chosen(self, start: float, end: float) -> tuple[NDArray[np.bool_], str, str]:
        """Valid states of a span; why it has no figure, empty where it has one; the note of a figure."""
        window = within(self.time, start, end)
        chosen = window & self.valid
        total, bad = int(window.sum()), int((window & ~chosen).sum())
        if self.undefined_because:
            return chosen, self.undefined_because, ""
        if total == 0:
            return chosen, "no state in this span of time", ""
        if total - bad < LEAST_VALID_SHARE * total:
            return chosen, f"{self.invalid_because} in {bad} of {total} states", ""
        return chosen, "", f"{bad} of {total} states invalid: {self.invalid_because}" if bad else ""


def within(time: FloatArray, start: float, end: float) -> NDArray[np.bool_]:
    """``(F,)`` states with start ≤ t < end, forgiving a rounding of the clock."""
    slack = SLACK * _interval(time)
    return (time >= start - slack) & (time < end - slack)


def frame_at(time: FloatArray, instant: float) -> int | None:
    """Index of the state at ``instant`` (s), or None where none lies within half a frame of it."""
    if len(time) == 0:
        return None
    nearest = int(np.argmin(np.abs(time - instant)))
    reach = (0.5 + SLACK) * _interval(time)
    return nearest if abs(float(time[nearest]) - instant) <= reach else None


def _interval(time: FloatArray) -> float:
    """Between the first two states, s; 0 for a single one."""
    return float(time[1] - time[0]) if len(time) > 1 else 0.0


def shared_states(a: FloatArray, b: FloatArray) -> int:
    """How many states two clocks (s) have in common; a `ValueError` where states lie at different times."""
    shared = min(len(a), len(b))
    apart = ~(np.abs(np.subtract(a[:shared], b[:shared])) <= APART * _interval(a if len(a) > 1 else b))
    if apart.any():
        first = int(np.argmax(apart))
        raise ValueError(
            f"states lie at different times ({a[first]:g} s and {b[first]:g} s at frame {first}); "
            "compare trajectories of one scene and one frame interval"
        )
    return shared


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


def prediction_interval(figures: Sequence[float], others: float = 1.0) -> Interval | None:
    """95 % interval of the mean of ``others`` more figures, mean ± t s √(1/n + 1/others), t of Student.

    Infinitely many others give the confidence interval of the mean. None below two figures.
    """
    count = len(figures)
    if count < 2:
        return None
    mean, deviation = float(np.mean(figures)), float(np.std(figures, ddof=1))
    reach = float(student_t.ppf(0.5 + 0.5 * CONFIDENCE, count - 1)) * deviation * math.sqrt(1.0 / others + 1.0 / count)
    return Interval(mean, mean - reach, mean + reach)
