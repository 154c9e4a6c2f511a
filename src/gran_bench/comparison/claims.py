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
    """

    name: str
    kind: str
    seconds: float
    low: float
    high: float
    floors: float | None
    data_seconds: float = 0.0
    training_seconds: float = 0.0


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


def fastest_rival(entries: Sequence[Entry], floors: float, accepted: float) -> Entry | None:
    """The fastest DEM, softened and large steps included, that is at least as exact; None where no DEM is.

    Args:
        entries: all methods.
        floors: error to be met, in noise floors.
        accepted: the DEM's own accuracy: whoever is below is exact enough.
    """
    met = [e for e in entries if e.kind == "dem" and e.floors is not None and e.floors <= max(floors, accepted)]
    return min(met, key=lambda entry: entry.seconds, default=None)


def best_in_time(entries: Sequence[Entry], seconds: float) -> Entry | None:
    """The most exact DEM that takes no longer; None where every DEM takes longer."""
    met = [e for e in entries if e.kind == "dem" and e.floors is not None and e.seconds <= seconds]
    return min(met, key=lambda entry: entry.floors, default=None)


def speed_up(entry: Entry, rival: Entry) -> Ratio:
    """How many times as fast ``entry`` is as ``rival``."""
    return Ratio(rival.seconds / entry.seconds, rival.low / entry.high, rival.high / entry.low)


def break_even(entry: Entry, rival: Entry) -> float:
    """Simulated seconds after which data and training are paid back; infinite where the rival is as fast.

    (data + training of the entry − those of the rival) / (rival's − entry's seconds a simulated second); 0 where
    nothing was spent.
    """
    spent = entry.data_seconds + entry.training_seconds - rival.data_seconds - rival.training_seconds
    saved = rival.seconds - entry.seconds
    if saved <= 0.0:
        return math.inf
    return max(0.0, spent) / saved


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
