"""The vocabulary of the suite: a case runs experiments, a check holds what they found against what must come out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from gran_bench.state import FloatArray


@dataclass(frozen=True)
class Check:
    """One quantity at P points, expected and found.

    The error of a point is |found − expected| / scale. A value that is not finite has an infinite error.

    Attributes:
        quantity: its name, with the unit.
        expected: ``(P,)`` from ``source``.
        found: ``(P,)`` from the DEM.
        tolerance: largest error that is met, −.
        source: where the expected values come from.
        scale: ``(P,)`` what the error is measured in; |expected| where None.
        unit: what an error of 1 is, in words.
        at: ``(P,)`` which point is which; may be empty for a single one.
    """

    quantity: str
    expected: FloatArray
    found: FloatArray
    tolerance: float
    source: str
    scale: FloatArray | None = None
    unit: str = "of expected"
    at: Sequence[str] = ()

    def __post_init__(self) -> None:
        expected, found = np.atleast_1d(np.asarray(self.expected, float)), np.atleast_1d(np.asarray(self.found, float))
        scale = np.abs(expected) if self.scale is None else np.asarray(self.scale, float)
        object.__setattr__(self, "expected", expected)
        object.__setattr__(self, "found", found)
        object.__setattr__(self, "scale", np.broadcast_to(scale, expected.shape).copy())
        if found.shape != expected.shape or (len(self.at) or 1) != len(expected):
            raise ValueError(f"{self.quantity}: {len(expected)} expected, {len(found)} found, {len(self.at)} named")

    @property
    def error(self) -> FloatArray:
        """``(P,)`` error of each point, −; infinite where anything is not finite."""
        difference = np.abs(self.found - self.expected)
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.where(difference == 0.0, 0.0, difference / self.scale)
        return np.where(np.isfinite(self.found) & np.isfinite(error), error, np.inf)

    @property
    def worst(self) -> int:
        """Index of the point with the largest error."""
        return int(np.argmax(self.error))

    @property
    def met(self) -> bool:
        """Whether every point is within the tolerance."""
        return bool((self.error <= self.tolerance).all())


@dataclass(frozen=True)
class Findings:
    """What a case brings back.

    Attributes:
        checks: at least one.
        curves: arrays by name, for a figure.
    """

    checks: tuple[Check, ...]
    curves: dict[str, FloatArray] = field(default_factory=dict)


@dataclass(frozen=True)
class Case:
    """An experiment with a known answer.

    Attributes:
        name: as ``--case`` takes it.
        title: what is verified, in a line.
        run: does the experiments.
        quick: whether ``--quick`` runs it too.
    """

    name: str
    title: str
    run: Callable[[], Findings]
    quick: bool = True


@dataclass(frozen=True)
class Outcome:
    """A case that was run.

    Attributes:
        case: which.
        findings: what came out; empty where the case stopped with an error.
        seconds: s of wall time.
        failure: the error that stopped it, in a line; None where it ran to its end.
    """

    case: Case
    findings: Findings
    seconds: float
    failure: str | None = None

    @property
    def met(self) -> bool:
        """Whether the case ran to its end, checked something and met every tolerance."""
        checks = self.findings.checks
        return self.failure is None and bool(checks) and all(check.met for check in checks)
