"""What a metric hands back: a number with its unit, or the reason why there is none. Never a silent number."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gran_bench.state import FloatArray

LEAST_VALID_SHARE = 0.9  # below this share of valid states a figure over a series is undefined


class UndefinedMetricError(ValueError):
    """A number was asked of a metric that has none; the message says why it has none."""


@dataclass(frozen=True)
class Measured:
    """One figure of a metric.

    Attributes:
        value: finite number in ``unit``; None where the metric is undefined.
        unit: SI, or the exception that it names.
        note: why it is undefined, or what to know about a defined value (how many states are invalid).

    Raises:
        ValueError: a value that is not finite, or no value and no reason.
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
    def of(cls, value: float, unit: str, reason: str = "the result is not finite", note: str = "") -> Measured:
        """``value`` where it is finite; undefined because of ``reason`` where it is not."""
        value = float(value)
        return cls(value, unit, note) if math.isfinite(value) else cls.undefined(unit, reason)

    @property
    def defined(self) -> bool:
        """Whether there is a value."""
        return self.value is not None

    @property
    def number(self) -> float:
        """The value.

        Raises:
            UndefinedMetricError: there is none.
        """
        if self.value is None:
            raise UndefinedMetricError(f"undefined: {self.note}")
        return self.value

    def __str__(self) -> str:
        return f"{self.value:.4g} {self.unit}".rstrip() if self.value is not None else f"undefined ({self.note})"


def mean_of(figures: list[Measured], unit: str) -> Measured:
    """Mean of figures that are all defined; undefined where one is not, because a failure may not drop out.

    Its note is the one that all have, or the first one with how many have such a one.
    """
    if not figures:
        return Measured.undefined(unit, "nothing to average")
    missing = [figure for figure in figures if not figure.defined]
    if missing:
        return Measured.undefined(unit, missing[0].note)
    noted = [figure.note for figure in figures if figure.note]
    note = noted[0] if noted else ""
    if len({figure.note for figure in figures}) > 1:
        note += f" (this or the like in {len(noted)} of {len(figures)} runs)"
    return Measured(float(np.mean([figure.number for figure in figures])), unit, note)


@dataclass(frozen=True)
class Series:
    """A figure of every stored state.

    Attributes:
        time: ``(F,)`` s.
        value: ``(F,)`` in ``unit``; NaN where a state has no valid figure.
        unit: of the value.
        undefined_because: why no state has one, whatever was computed; empty where states may have one.
        invalid_because: what an invalid single state lacks, for the notes.
    """

    time: FloatArray
    value: FloatArray
    unit: str
    undefined_because: str = ""
    invalid_because: str = "no valid figure"

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
        window = within(self.time, start, end)
        if refusal := self._refusal(window):
            return Measured.undefined(self.unit, refusal)
        chosen = window & self.valid
        return Measured(float(self.value[chosen].mean()), self.unit, self._note(window))

    def largest(self, start: float = -math.inf, end: float = math.inf) -> tuple[Measured, Measured]:
        """Largest valid value with start ≤ t < end, and when (s); undefined below 90 % valid states."""
        window = within(self.time, start, end)
        if refusal := self._refusal(window):
            return Measured.undefined(self.unit, refusal), Measured.undefined("s", refusal)
        where = int(np.argmax(np.where(window & self.valid, self.value, -np.inf)))
        note = self._note(window)
        return Measured(float(self.value[where]), self.unit, note), Measured(float(self.time[where]), "s", note)

    def at(self, time: float) -> Measured:
        """The value of the state at ``time`` (s), within half a frame."""
        frame = frame_at(self.time, time)
        if frame is None:
            return Measured.undefined(self.unit, f"no state at {time:g} s")
        if not self.valid[frame]:
            return Measured.undefined(self.unit, self.undefined_because or f"{self.invalid_because} at {time:g} s")
        return Measured(float(self.value[frame]), self.unit)

    def difference(self, other: Series, start: float = -math.inf, end: float = math.inf) -> Measured:
        """Mean absolute difference over the states valid in both, undefined below 90 % of the states.

        A state that only one of the two has counts as invalid: a rollout that ended early is not a shorter one. The
        note counts the invalid states of this series as its own figures do, and those of the other one beside them.

        Raises:
            ValueError: the two have their states at different times.
        """
        time, mine, theirs = _aligned(self, other)
        reason = self.undefined_because or other.undefined_because
        cause = self.invalid_because if self.invalid_because == other.invalid_because else "no valid figure in both"
        gap, own = (Series(time, value, self.unit, reason, cause) for value in (np.abs(mine - theirs), mine))
        found, window = gap.mean(start, end), within(time, start, end)
        further = int((window & own.valid & ~gap.valid).sum())
        if reason or not further:
            return found
        total, bad = int(window.sum()), int((window & ~own.valid).sum())
        return replace(found, note=f"{bad} of {total} states invalid, and {further} more of the other run: {cause}")

    def _refusal(self, window: NDArray[np.bool_]) -> str:
        if self.undefined_because:
            return self.undefined_because
        total, good = int(window.sum()), int((window & self.valid).sum())
        if total == 0:
            return "no state in this span of time"
        if good < LEAST_VALID_SHARE * total:
            return f"{self.invalid_because} in {total - good} of {total} states"
        return ""

    def _note(self, window: NDArray[np.bool_]) -> str:
        total, bad = int(window.sum()), int((window & ~self.valid).sum())
        return f"{bad} of {total} states invalid: {self.invalid_because}" if bad else ""


def within(time: FloatArray, start: float, end: float) -> NDArray[np.bool_]:
    """``(F,)`` states with start ≤ t < end, forgiving a rounding of the clock."""
    slack = 1e-6
    return (time >= start - slack) & (time < end - slack)


def frame_at(time: FloatArray, instant: float) -> int | None:
    """Index of the state at ``instant`` (s), or None where none lies within half a frame of it."""
    if len(time) == 0:
        return None
    nearest = int(np.argmin(np.abs(time - instant)))
    half = 0.5 * float(time[1] - time[0]) if len(time) > 1 else 1e-6
    return nearest if abs(float(time[nearest]) - instant) <= half + 1e-6 else None


def shared_states(a: FloatArray, b: FloatArray) -> int:
    """How many states two clocks (s) have in common; a trajectory that ended early is shorter.

    Raises:
        ValueError: states at different times.
    """
    shared = min(len(a), len(b))
    apart = ~(np.abs(np.subtract(a[:shared], b[:shared])) <= 1e-4)
    if apart.any():
        first = int(np.argmax(apart))
        raise ValueError(
            f"states lie at different times ({a[first]:g} s and {b[first]:g} s at frame {first}); "
            "compare trajectories of one scene and one frame interval"
        )
    return shared


def _aligned(a: Series, b: Series) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The longer of two clocks, and both values on it, NaN where one has ended."""
    shared_states(a.time, b.time)
    time = a.time if len(a.time) >= len(b.time) else b.time
    values = np.full((2, len(time)), np.nan)
    values[0, : len(a.value)] = a.value
    values[1, : len(b.value)] = b.value
    return time, values[0], values[1]
