"""The vocabulary of the suite: a case is an experiment that yields checks, found against expected, and curves."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from gran_bench.state import FloatArray

Curves = dict[str, FloatArray]  # arrays by name, for a figure


@dataclass(frozen=True)
class Check:
    """One quantity at P points, expected and found.

    The error of a point is |found − expected| / scale. A value that is not finite has an infinite error.
    """

    quantity: str  # its name, with the unit
    expected: FloatArray  # ``(P,)`` from ``source``
    found: FloatArray  # ``(P,)`` from the DEM
    tolerance: float  # largest error that is met, −
    source: str  # where the expected values come from
    scale: FloatArray | None = None  # ``(P,)`` what the error is measured in; |expected| where None
    unit: str = "of expected"  # what an error of 1 is, in words
    at: Sequence[str] = ()  # ``(P,)`` which point is which; may be empty for a single one

    def __post_init__(self) -> None:
        expected, found = (np.atleast_1d(np.asarray(a, float)) for a in (self.expected, self.found))
        scale = np.abs(expected) if self.scale is None else np.asarray(self.scale, float)
        if found.shape != expected.shape or (len(self.at) or 1) != len(expected):
            raise ValueError(f"{self.quantity}: {len(expected)} expected, {len(found)} found, {len(self.at)} named")
        for name, values in (("expected", expected), ("found", found), ("scale", scale)):
            object.__setattr__(self, name, np.broadcast_to(values, expected.shape).copy())

    @property
    def error(self) -> FloatArray:
        """``(P,)`` error of each point, −; infinite where anything is not finite."""
        difference = np.abs(self.found - self.expected)
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.where(difference == 0.0, 0.0, difference / self.scale)
        return np.where(np.isfinite(self.found) & np.isfinite(error), error, np.inf)

    @property
    def met(self) -> bool:
        """Whether every point is within the tolerance."""
        return bool((self.error <= self.tolerance).all())


@dataclass(frozen=True)
class Case:
    """An experiment with a known answer."""

    name: str  # as ``--case`` takes it
    title: str  # what is verified, in a line
    run: Callable[[], Iterable[Check | Curves]]  # does the experiments and yields what they give
    quick: bool = True  # whether ``--quick`` runs it too


@dataclass
class Outcome:
    """A case that was run."""

    case: Case  # which
    # what it checked; as far as it came, where it stopped with an error
    checks: list[Check] = field(default_factory=list)
    curves: Curves = field(default_factory=dict)  # arrays by name, for a figure
    seconds: float = 0.0  # s of wall time
    failure: str | None = None  # the error that stopped it, in a line; None where it ran to its end

    @property
    def met(self) -> bool:
        """Whether the case ran to its end, checked something and met every tolerance."""
        return self.failure is None and bool(self.checks) and all(check.met for check in self.checks)


def run_case(case: Case) -> Outcome:
    """Run a case; an error that stops it is a failure with its words, not a case that is missing."""
    started, outcome = time.perf_counter(), Outcome(case)
    try:
        for found in case.run():
            if isinstance(found, Check):
                outcome.checks.append(found)
            else:
                outcome.curves |= found
    except Exception as error:
        outcome.failure = f"{type(error).__name__}: {error}"
    outcome.seconds = time.perf_counter() - started
    return outcome
