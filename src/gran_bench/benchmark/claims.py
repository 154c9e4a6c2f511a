"""What may be said of times and errors: who is on the frontier, who wins at equal accuracy or equal time, what pays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gran_bench.plots.time_error import Contender


@dataclass(frozen=True)
class Entry(Contender):
    """One method with what was measured of it; ``fast`` and ``slow`` are the range of its times over the rounds."""

    data_seconds: float = 0.0  # spent before the first run, s
    training_seconds: float = 0.0  # spent before the first run, s

    @property
    def least(self) -> float:
        """The smallest error that its interval allows, in noise floors; of a run that did not fail."""
        return self.floors if self.low is None else self.low

    @property
    def most(self) -> float:
        """The largest error that its interval allows, in noise floors; of a run that did not fail."""
        return self.floors if self.high is None else self.high


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


def speed_up(entry: Entry, rival: Entry) -> Ratio:
    """How many times as fast ``entry`` is as ``rival``."""
    return Ratio(rival.seconds / entry.seconds, rival.fast / entry.slow, rival.slow / entry.fast)


def sound_dems(entries: Sequence[Entry]) -> list[Entry]:
    """The DEMs that did not fail, softened and large steps included, from fast to slow."""
    return sorted((e for e in entries if e.kind == "dem" and e.floors is not None), key=lambda e: e.seconds)


def fastest_rival(entries: Sequence[Entry], floors: float, accepted: float | None) -> Entry | None:
    """The fastest DEM whose measured error is at most ``floors``, or the DEM's own accuracy where that is known."""
    return next((e for e in sound_dems(entries) if e.floors <= max(floors, accepted or 0.0)), None)


def best_in_time(entries: Sequence[Entry], seconds: float) -> Entry | None:
    """The most exact DEM that takes no longer; None where every DEM takes longer."""
    return min((e for e in sound_dems(entries) if e.seconds <= seconds), key=lambda e: e.floors, default=None)


def not_told_apart(first: Entry, entries: Sequence[Entry]) -> list[Entry]:
    """Those whose range of times overlaps the first's, itself too, from fast to slow."""
    same = [entry for entry in entries if entry == first or not speed_up(first, entry).decides]
    return sorted(same, key=lambda entry: (entry.seconds, entry.name))


@dataclass(frozen=True)
class EqualAccuracy:
    """A method beside the fastest DEM that is as exact.

    A DEM is significantly worse where the low end of its interval lies above the high end of the method's, and above
    the DEM's own accuracy.
    """

    entry: Entry
    rival: Entry | None  # the fastest DEM whose measured error is no larger; None where there is none
    lenient: Entry | None  # the fastest DEM that is not significantly worse; at least as fast as the rival
    # Who is, of ``entry``, ``rival``, ``neither`` (the ranges of the times overlap), ``undecided`` (the two DEMs give
    # two answers) and ``alone`` (every DEM is significantly worse).
    faster: str


def equal_accuracy(entry: Entry, entries: Sequence[Entry], accepted: float | None) -> EqualAccuracy:
    """Whether a method that did not fail or the DEM is faster at equal accuracy, where the intervals allow to say so.

    ``accepted`` is the DEM's own accuracy, in noise floors; None where it is not known.
    """
    rival, bound = fastest_rival(entries, entry.floors, accepted), max(entry.most, accepted or 0.0)
    lenient = next((e for e in sound_dems(entries) if e.least <= bound), None)
    if lenient is None:
        return EqualAccuracy(entry, None, None, "alone")

    def faster(dem: Entry | None) -> str:
        ratio = Ratio(math.inf, math.inf, math.inf) if dem is None else speed_up(entry, dem)
        return "neither" if not ratio.decides else "entry" if ratio.middle > 1.0 else "rival"

    answers = {faster(rival), faster(lenient)}
    return EqualAccuracy(entry, rival, lenient, answers.pop() if len(answers) == 1 else "undecided")


def paid_back(beside: EqualAccuracy) -> float | None:
    """Simulated seconds after which a method's data and training are paid back beside the DEM that is as exact.

    (data + training) / (the DEM's − the method's seconds a simulated second). None where every DEM is significantly
    worse; NaN where nobody knows who is faster; infinite where the DEM is.
    """
    entry, rival = beside.entry, beside.rival or beside.lenient
    if rival is None:
        return None
    if beside.faster in ("undecided", "neither"):
        return math.nan
    saved = rival.seconds - entry.seconds
    return (entry.data_seconds + entry.training_seconds) / saved if saved > 0.0 else math.inf


def crossing(abscissa: Sequence[float], costs: Sequence[float], level: float) -> float | None:
    """Where a cost first rises to a level: straight lines between the points in logarithms; None where it stays below.

    The abscissa increases; all are > 0.
    """
    x, y = np.log(np.asarray(abscissa, float)), np.log(np.asarray(costs, float) / level)
    above = np.flatnonzero(y >= 0.0)
    if not len(above) or not above[0]:
        return float(abscissa[0]) if len(above) else None
    k = above[0]
    return float(np.exp(x[k - 1] + (x[k] - x[k - 1]) * -y[k - 1] / (y[k] - y[k - 1])))
