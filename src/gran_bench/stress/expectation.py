"""What a stress case must show, what it showed, and the verdict: three forms of expectation, none of them vague."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

MET, FLAGGED, FAILED = "met", "flagged", "FAILED"


@dataclass(frozen=True)
class Bound:
    """A quantity and how far it may go.

    Attributes:
        quantity: that the experiment measures.
        unit: of it.
        at_most, at_least: limits, both included; None for no limit on that side.
    """

    quantity: str
    unit: str
    at_most: float | None = None
    at_least: float | None = None

    def holds(self, value: float) -> bool:
        """Whether a value keeps the bound; what is not a number never does."""
        above = self.at_least is None or value >= self.at_least
        return above and (self.at_most is None or value <= self.at_most) and not math.isnan(value)

    def __str__(self) -> str:
        low = f"{self.at_least:g} ≤ " if self.at_least is not None else ""
        high = f" ≤ {self.at_most:g}" if self.at_most is not None else ""
        if self.at_least is not None and self.at_least == self.at_most:
            low, high = "", f" = {self.at_most:g}"
        return f"{low}{self.quantity}{high} {_shown(self.unit)}".rstrip()


@dataclass(frozen=True)
class Expectation:
    """What a case must show.

    - ``met``: it ends without an error and every bound holds.
    - ``error``: it is refused or stops with an error of this class that holds these words.
    - ``flagged``: it may fail, but not silently: it ends without an error, every bound holds for what it did up to
      its failure, and each failure stands among its flags, of which some hold these words.

    Attributes:
        form: ``met``, ``error`` or ``flagged``.
        bounds: of ``met`` and ``flagged``.
        error: name of the exception's class.
        says: words that the error, or the flags, must hold.
    """

    form: str
    bounds: tuple[Bound, ...] = ()
    error: str = ""
    says: tuple[str, ...] = ()

    def __str__(self) -> str:
        words = " … ".join(f"“{word}”" for word in self.says)
        if self.form == "error":
            return f"{self.error}: {words}"
        bounds = "; ".join(map(str, self.bounds))
        prefix = "flagged, " if self.form == "flagged" else ""
        return f"{prefix}{bounds}" + (f"; says {words}" if words else "")


@dataclass(frozen=True)
class Observation:
    """What a case showed.

    Attributes:
        quantities: figures by name.
        flags: what the software itself says is wrong: failed frames, warnings, counts of escaped spheres.
        curves: arrays by name as lists, for a figure.
        unflagged: failures that nothing in the flags tells of; a sound program has none.
    """

    quantities: Mapping[str, float] = field(default_factory=dict)
    flags: tuple[str, ...] = ()
    curves: Mapping[str, list[float]] = field(default_factory=dict)
    unflagged: int = 0


@dataclass(frozen=True)
class Failure:
    """An error that ended a case.

    Attributes:
        error: name of its class.
        message: of it.
    """

    error: str
    message: str


Outcome = Observation | Failure


@dataclass(frozen=True)
class Verdict:
    """How a case ended.

    Attributes:
        word: ``met``, ``flagged`` (as expected, with flags) or ``FAILED``.
        found: what was found, in a line.
    """

    word: str
    found: str


def verdict(expectation: Expectation, outcome: Outcome) -> Verdict:
    """Hold what a case showed, or the error that stopped it, against what it must show."""
    if isinstance(outcome, Failure):
        right = expectation.form == "error" and outcome.error == expectation.error
        right = right and all(word in outcome.message for word in expectation.says)
        return Verdict(MET if right else FAILED, f"{outcome.error}: {_one_line(outcome.message)}")
    found = _found(expectation, outcome)
    if expectation.form == "error":
        return Verdict(FAILED, f"no error; {found}")
    told = " ".join(outcome.flags)
    sound = (
        all(bound.holds(outcome.quantities.get(bound.quantity, math.nan)) for bound in expectation.bounds)
        and all(word in told for word in expectation.says)
        and outcome.unflagged == 0
    )
    if not sound:
        return Verdict(FAILED, found)
    return Verdict(FLAGGED if expectation.form == "flagged" and outcome.flags else MET, found)


def _found(expectation: Expectation, outcome: Observation) -> str:
    """The bounded quantities first, then the flags, then what nothing flagged."""
    values = [
        f"{bound.quantity} {outcome.quantities.get(bound.quantity, math.nan):.4g} {_shown(bound.unit)}".rstrip()
        for bound in expectation.bounds
    ]
    others = [] if values else [f"{name} {value:.4g}" for name, value in outcome.quantities.items()]
    hidden = [f"{outcome.unflagged} failures that no flag tells of"] if outcome.unflagged else []
    return "; ".join([*values, *others, *map(_one_line, outcome.flags), *hidden])


def _shown(unit: str) -> str:
    return "" if unit == "-" else unit


def _one_line(text: str, longest: int = 200) -> str:
    line = " ".join(text.split())
    return line if len(line) <= longest else line[: longest - 1] + "…"
