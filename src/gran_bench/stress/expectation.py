"""What a stress experiment is, what a case of it must show, what it showed, and the verdict."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gran_bench.surrogate.step import Surrogate

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
    """What a case must show: ``met``, that each bound holds; ``error``, to be refused with these words; or ``flagged``.

    A flagged case may fail, but not silently: it ends without an error, every bound holds for what it did up to its
    failure, and each failure stands among its flags, of which some hold these words.
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
    flags: tuple[str, ...] = ()  # what the software itself says is wrong: warnings, failed frames, escaped spheres
    curves: Mapping[str, list[float]] = field(default_factory=dict)  # arrays by name as lists, for a figure
    unflagged: int = 0  # failures that nothing in the flags tells of; a sound program has none


@dataclass(frozen=True)
class Failure:
    """An error that ended a case: the name of its class, and its message."""

    error: str
    message: str


Outcome = Observation | Failure


def verdict(expectation: Expectation, outcome: Outcome) -> tuple[str, str]:
    """``met``, ``flagged`` or ``FAILED``, of what a case showed or the error that ended it; and what was found."""
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
    seen, units = outcome.quantities, {b.quantity: f" {b.unit.removeprefix('-')}" for b in expectation.bounds}
    values = [f"{name} {seen.get(name, math.nan):.4g}{units.get(name, '')}".rstrip() for name in units or seen]
    hidden = [f"{outcome.unflagged} failures that no flag tells of"] if outcome.unflagged else []
    return "; ".join([*values, *map(_one_line, outcome.flags), *hidden])


def _one_line(text: str) -> str:
    return shorten(text, 200, placeholder=" …")


@dataclass(frozen=True)
class Bench:
    """What an experiment may use beside its parameters."""

    shared: Path  # folder of settled beds that the cases of a run share
    model: Surrogate | None = None  # under stress, in evaluation mode; None for the DEM


@dataclass(frozen=True)
class Experiment:
    """A kind of stress case."""

    run: Callable[..., Observation]  # called with a bench and the parameters of the case by name
    measures: Mapping[str, str]  # unit of each quantity by its name
    of_model: bool = False  # whether it is done with a model
    alone: bool = False  # whether nothing else may run beside it, because it takes times

    @property
    def parameters(self) -> dict[str, inspect.Parameter]:
        """The parameters that a case may set, by name, with evaluated annotations."""
        return dict(list(inspect.signature(self.run, eval_str=True).parameters.items())[1:])
