"""What may be said of times and errors: who is on the frontier, who wins at equal accuracy or equal time, what pays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Entry:
    """One method with what was measured of it.

    Attributes:
        name, kind: of the method.
        seconds: wall time of a simulated second, s: median.
        low, high: of the rounds; an interval that holds the seconds.
        floors: error in noise floors; None for a failed run.
        data_seconds, training_seconds: spent before the first run, s.
        floors_low, floors_high: 95 % interval of the error, in noise floors; None where it is the error alone.
    """

    name: str
    kind: str
    seconds: float
    low: float
    high: float
    floors: float | None
    data_seconds: float = 0.0
    training_seconds: float = 0.0
    floors_low: float | None = None
    floors_high: float | None = None

    @property
    def least(self) -> float:
        """The smallest error that its interval allows, in noise floors; of a run that did not fail."""
        return self.floors if self.floors_low is None else self.floors_low

    @property
    def most(self) -> float:
        """The largest error that its interval allows, in noise floors; of a run that did not fail."""
        return self.floors if self.floors_high is None else self.floors_high


@dataclass(frozen=True)
class Ratio:
    """How many times as fast one method is as another: of the medians, and the range that both spreads allow."""

    middle: float
    low: float
    high: float

    @property
    def decides(self) -> bool:
        """Whether the range lies on one side of 1."""
        return self.low > 1.0 or self.high < 1.0


def frontier(entries: Sequence[Entry]) -> list[Entry]:
    """Those that no other beats: none is at least as fast and at least as exact, and better in one of both.

    Failed runs are beaten by definition. Ordered from fast to slow.
    """
    sound = [entry for entry in entries if entry.floors is not None]

    def beaten(entry: Entry) -> bool:
        return any(
            other.seconds <= entry.seconds
            and other.floors <= entry.floors
            and (other.seconds < entry.seconds or other.floors < entry.floors)
            for other in sound
        )

    return sorted((entry for entry in sound if not beaten(entry)), key=lambda entry: (entry.seconds, entry.name))


def fastest_rival(entries: Sequence[Entry], floors: float, accepted: float | None) -> Entry | None:
    """The fastest DEM, softened and large steps included, whose error is no larger; None where no DEM is.

    Errors are taken as they were measured; `equal_accuracy` asks what their intervals allow.

    Args:
        entries: all methods.
        floors: error to be met, in noise floors.
        accepted: the DEM's own accuracy: whoever is below is exact enough; None where it is not known.
    """
    met = [e for e in entries if e.kind == "dem" and e.floors is not None and e.floors <= max(floors, accepted or 0.0)]
    return min(met, key=lambda entry: entry.seconds, default=None)


def fastest_not_worse(entries: Sequence[Entry], entry: Entry, accepted: float | None) -> Entry | None:
    """The fastest DEM that is not significantly less exact than ``entry``; None where every DEM is.

    A DEM is significantly worse where the low end of its interval lies above the high end of the entry's, and above
    the DEM's own accuracy.
    """
    bound = max(entry.most, accepted or 0.0)
    met = [e for e in entries if e.kind == "dem" and e.floors is not None and e.least <= bound]
    return min(met, key=lambda other: other.seconds, default=None)


@dataclass(frozen=True)
class EqualAccuracy:
    """A method beside the fastest DEM that is as exact.

    Attributes:
        entry: the method.
        rival: the fastest DEM whose measured error is no larger; None where there is none.
        lenient: the fastest DEM that is not significantly worse; at least as fast as the rival.
        faster: who is, of ``entry``, ``rival``, ``neither`` (the ranges of the times overlap), ``undecided`` (the two
            DEMs give two answers) and ``alone`` (every DEM is significantly worse).
    """

    entry: Entry
    rival: Entry | None
    lenient: Entry | None
    faster: str


def equal_accuracy(entry: Entry, entries: Sequence[Entry], accepted: float | None) -> EqualAccuracy:
    """Whether a method or the DEM is faster at equal accuracy, where the errors' intervals allow to say so.

    Args:
        entry: the method; it did not fail.
        entries: all methods.
        accepted: the DEM's own accuracy, in noise floors; None where it is not known.
    """
    rival, lenient = fastest_rival(entries, entry.floors, accepted), fastest_not_worse(entries, entry, accepted)
    if lenient is None:
        return EqualAccuracy(entry, None, None, "alone")
    answers = {"entry" if other is None else _faster(entry, other) for other in (rival, lenient)}
    return EqualAccuracy(entry, rival, lenient, answers.pop() if len(answers) == 1 else "undecided")


def _faster(entry: Entry, rival: Entry) -> str:
    ratio = speed_up(entry, rival)
    return "neither" if not ratio.decides else "entry" if ratio.middle > 1.0 else "rival"


def best_in_time(entries: Sequence[Entry], seconds: float) -> Entry | None:
    """The most exact DEM that takes no longer; None where every DEM takes longer."""
    met = [e for e in entries if e.kind == "dem" and e.floors is not None and e.seconds <= seconds]
    return min(met, key=lambda entry: entry.floors, default=None)


def speed_up(entry: Entry, rival: Entry) -> Ratio:
    """How many times as fast ``entry`` is as ``rival``."""
    return Ratio(rival.seconds / entry.seconds, rival.low / entry.high, rival.high / entry.low)


def not_told_apart(first: Entry, entries: Sequence[Entry]) -> list[Entry]:
    """Those whose range of times overlaps the first's, itself too, from fast to slow."""
    same = [entry for entry in entries if entry == first or not speed_up(first, entry).decides]
    return sorted(same, key=lambda entry: (entry.seconds, entry.name))


def break_even(entry: Entry, rival: Entry) -> float:
    """Simulated seconds after which data and training are paid back; infinite where the rival is faster.

    (data + training of the entry − those of the rival) / (rival's − entry's seconds a simulated second); 0 where
    nothing was spent; NaN where the ranges of the times overlap, so that nobody knows whether anything is saved.
    """
    spent = entry.data_seconds + entry.training_seconds - rival.data_seconds - rival.training_seconds
    if not speed_up(entry, rival).decides:
        return math.nan
    saved = rival.seconds - entry.seconds
    return max(0.0, spent) / saved if saved > 0.0 else math.inf


def paid_back(beside: EqualAccuracy) -> float | None:
    """Simulated seconds after which a method's data and training are paid back beside the DEM that is as exact.

    None where every DEM is significantly worse; NaN where it is undecided who is faster.
    """
    if beside.lenient is None:
        return None
    return math.nan if beside.faster == "undecided" else break_even(beside.entry, beside.rival or beside.lenient)


def crossing(abscissa: Sequence[float], costs: Sequence[float], level: float) -> float | None:
    """Where a cost first rises to a level: straight lines between the points in logarithms; None where it stays below.

    Args:
        abscissa: increasing, > 0.
        costs: at these, > 0.
        level: > 0.
    """
    x, y = np.log(np.asarray(abscissa, float)), np.log(np.asarray(costs, float) / level)
    if y[0] >= 0.0:
        return float(abscissa[0])
    for k in range(1, len(x)):
        if y[k] >= 0.0:
            return float(np.exp(x[k - 1] + (x[k] - x[k - 1]) * -y[k - 1] / (y[k] - y[k - 1])))
    return None
