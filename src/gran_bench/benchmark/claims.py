"""What may be said of times and errors: who is on the frontier, who wins at equal accuracy or equal time, what pays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gran_bench.plots.time_error import Contender


@dataclass(frozen=True)
class Entry(Contender):
    """One method with what was measured of it; ``fast`` and ``slow`` are the range of its times over the rounds.

    Attributes:
        data_seconds, training_seconds: spent before the first run, s.
    """

    data_seconds: float = 0.0
    training_seconds: float = 0.0

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
    """The fastest DEM whose measured error is no larger; None where no DEM is.

    Args:
        entries: all methods.
        floors: error to be met, in noise floors.
        accepted: the DEM's own accuracy: whoever is below is exact enough; None where it is not known.
    """
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

    Attributes:
        entry: the method.
        rival: the fastest DEM whose measured error is no larger; None where there is none.
        lenient: the fastest DEM that is not significantly worse (the low end of its interval lies above the high end
            of the entry's, and above the DEM's own accuracy); at least as fast as the rival.
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
    rival, bound = fastest_rival(entries, entry.floors, accepted), max(entry.most, accepted or 0.0)
    lenient = next((e for e in sound_dems(entries) if e.least <= bound), None)
    if lenient is None:
        return EqualAccuracy(entry, None, None, "alone")

    def faster(dem: Entry | None) -> str:
        ratio = Ratio(math.inf, math.inf, math.inf) if dem is None else speed_up(entry, dem)
        return "neither" if not ratio.decides else "entry" if ratio.middle > 1.0 else "rival"

    answers = {faster(rival), faster(lenient)}
    return EqualAccuracy(entry, rival, lenient, answers.pop() if len(answers) == 1 else "undecided")


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
    above = np.flatnonzero(y >= 0.0)
    if not len(above) or not above[0]:
        return float(abscissa[0]) if len(above) else None
    k = above[0]
    return float(np.exp(x[k - 1] + (x[k] - x[k - 1]) * -y[k - 1] / (y[k] - y[k - 1])))
