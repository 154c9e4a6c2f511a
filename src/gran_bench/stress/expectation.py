"""What a stress case must show, what it showed, and the verdict: three forms of expectation, none of them vague."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

MET, FLAGGED, FAILED = "met", "flagged", "FAILED"


@dataclass(frozen=True)
class Bound:
    """A quantity that an experiment measures, its unit, and how far it may go, limits included; None for no limit."""

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
        return f"{low}{self.quantity}{high} {self.unit.removeprefix('-')}".rstrip()


@dataclass(frozen=True)
class Expectation:
    """What a case must show.

    - ``met``: it ends without an error and every bound holds.
    - ``error``: it is refused or stops with an error of this class that holds these words.
    - ``flagged``: it may fail, but not silently: it ends without an error, every bound holds for what it did up to
      its failure, and each failure stands among its flags, of which some hold these words.
    """

    form: str
    bounds: tuple[Bound, ...] = ()
    error: str = ""
    says: tuple[str, ...] = ()

    def __str__(self) -> str:
        words = " … ".join(f"“{word}”" for word in self.says)
        if self.form == "error":
            return f"{self.error}: {words}"
        prefix = "flagged, " if self.form == "flagged" else ""
        return prefix + "; ".join([*map(str, self.bounds), *([f"says {words}"] if words else [])])


@dataclass(frozen=True)
class Observation:
    """What a case showed."""

    quantities: Mapping[str, float] = field(default_factory=dict)  # figures by name
    # what the software itself says is wrong: failed frames, warnings, counts of escaped spheres
    flags: tuple[str, ...] = ()
    curves: Mapping[str, list[float]] = field(default_factory=dict)  # arrays by name as lists, for a figure
    unflagged: int = 0  # failures that nothing in the flags tells of; a sound program has none


@dataclass(frozen=True)
class Failure:
    """An error that ended a case: the name of its class, and its message."""

    error: str
    message: str


Outcome = Observation | Failure


def verdict(expectation: Expectation, outcome: Outcome) -> tuple[str, str]:
    """Hold what a case showed, or the error that stopped it, against what it must show.

    Returns:
        ``met``, ``flagged`` (as expected, with flags) or ``FAILED``, and what was found, in a line.
    """
    if isinstance(outcome, Failure):
        right = expectation.form == "error" and outcome.error == expectation.error
        right = right and all(word in outcome.message for word in expectation.says)
        return MET if right else FAILED, f"{outcome.error}: {_one_line(outcome.message)}"
    found = _found(expectation, outcome)
    if expectation.form == "error":
        return FAILED, f"no error; {found}"
    bounds = [bound.holds(outcome.quantities.get(bound.quantity, math.nan)) for bound in expectation.bounds]
    said = [word in " ".join(outcome.flags) for word in expectation.says]
    if not all([*bounds, *said]) or outcome.unflagged:
        return FAILED, found
    return FLAGGED if expectation.form == "flagged" and outcome.flags else MET, found


def _found(expectation: Expectation, outcome: Observation) -> str:
    """The bounded quantities, or all where none is; then the flags, then what nothing flagged."""
    seen, bounds = outcome.quantities, expectation.bounds
    values = [f"{b.quantity} {seen.get(b.quantity, math.nan):.4g} {b.unit.removeprefix('-')}".rstrip() for b in bounds]
    values = values or [f"{name} {value:.4g}" for name, value in seen.items()]
    hidden = [f"{outcome.unflagged} failures that no flag tells of"] if outcome.unflagged else []
    return "; ".join([*values, *map(_one_line, outcome.flags), *hidden])


def _one_line(text: str, longest: int = 200) -> str:
    line = " ".join(text.split())
    return line if len(line) <= longest else line[: longest - 1] + "…"
