"""A judgement: every figure of one candidate beside the DEM's, as tables for people and for machines."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

import pandas as pd

from gran_bench.metrics.measured import Interval, Measured
from gran_bench.metrics.outside import FailureCount
from gran_bench.metrics.phases import Phases


@dataclass(frozen=True)
class ErrorRow:
    """A distance from the DEM: mean over the replicas; ``floor`` is the mean distance of two replicas.

    ``others`` has the same distance of other runs of the DEM (another packing, half the time step), by name.
    """

    key: str
    label: str
    unit: str
    error: Measured
    floor: Measured
    others: dict[str, Measured] = field(default_factory=dict)

    @property
    def multiple(self) -> float | None:
        """The error in floors; None where either is undefined or the floor is 0."""
        defined = self.error.defined and self.floor.defined and self.floor.number != 0.0
        return self.error.number / self.floor.number if defined else None


@dataclass(frozen=True)
class FigureRow:
    """A scalar beside the replicas' mean and 95 % prediction interval."""

    key: str
    label: str
    unit: str
    candidate: Measured
    truth: Measured
    interval: Interval | None

    @property
    def inside(self) -> bool | None:
        """Whether the candidate could be a replica; None where a side is undefined."""
        defined = self.candidate.defined and self.interval is not None
        return self.candidate.number in self.interval if defined else None


@dataclass(frozen=True)
class Requirement:
    """One requirement: the largest figure that passes, what was found, and how it came out.

    The verdict is ``pass``, ``fail``, or ``undefined`` where the DEM itself has no such figure.
    """

    key: str
    label: str
    figure: Measured
    bound: float
    verdict: str


@dataclass(frozen=True)
class Judgement:
    """Everything that was found of one candidate."""

    errors: list[ErrorRow]  # distances from the DEM
    figures: list[FigureRow]  # scalars beside the DEM's
    requirements: list[Requirement]
    failures: FailureCount | None  # None for statistics without particles
    dem_outside: float | None  # share of sphere-states that the replicas, whose walls are soft, have outside, %
    velocity_kind: str  # on both sides
    replicas: int  # how many runs of the DEM it was held against
    phases: Phases | None  # when their flow is steady, its first peak over; None for an average over schedules
    floor_between: str  # which runs of the DEM the noise floors are between
    not_asked: str = ""  # what no requirement is about because nothing was given to hold it against

    @property
    def accepted(self) -> bool:
        """Whether no requirement failed."""
        return all(row.verdict != "fail" for row in self.requirements)

    def error(self, key: str) -> ErrorRow:
        """The row of one distance; a `KeyError` that names those there are where there is none."""
        rows = {row.key: row for row in self.errors}
        if key not in rows:
            raise KeyError(f"{key!r}; choose one of {', '.join(rows)}")
        return rows[key]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; an undefined figure is null beside its reason, never NaN."""
        errors, figures = {}, {}
        for row in self.errors:
            errors[row.key] = _plain(row.label, row.error) | {
                "floor": row.floor.value,
                "floor_note": row.floor.note,
                "multiple_of_floor": row.multiple,
                **{f"floor_{name}": other.value for name, other in row.others.items()},
            }
        for row in self.figures:
            figures[row.key] = _plain(row.label, row.candidate) | {
                "dem": row.truth.value,
                "dem_note": row.truth.note,
                "dem_interval": [row.interval.low, row.interval.high] if row.interval else None,
                "inside_interval": row.inside,
            }
        return {
            "velocity_kind": self.velocity_kind,
            "replicas": self.replicas,
            **({"phases": self.phases.to_dict()} if self.phases else {}),
            "floor_between": self.floor_between,
            "accepted": self.accepted,
            "requirements": {
                row.key: _plain(row.label, row.figure) | {"bound": row.bound, "verdict": row.verdict}
                for row in self.requirements
            },
            "errors": errors,
            "figures": figures,
            "failures": asdict(self.failures) if self.failures else None,
            "dem_outside": self.dem_outside,
        }

    def to_frame(self) -> pd.DataFrame:
        """The distances as a table: name, value, unit, floor, multiple of floor, valid, reason."""
        found = pd.DataFrame.from_dict(self.to_dict()["errors"], orient="index").rename_axis("name").reset_index()
        found = found.rename(columns={"multiple_of_floor": "multiple", "note": "reason"})
        others = [f"floor_{name}" for name in self.errors[0].others]
        return found[["name", "value", "unit", "floor", *others, "multiple", "valid", "reason"]]

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        head = f"{'distance from the DEM':<38}{'value':>10} {'floor':>10} {'floors':>7}"
        yield f"{head}   (one floor: between {self.floor_between})"
        for row in self.errors:
            values = f"{_shown(row.error):>10} {_shown(row.floor):>10} {shown_multiple(row.multiple):>7}"
            yield _with_note(f"{row.label:<38}{values} {_unit(row.unit)}", row.error.note or row.floor.note)
        yield ""
        yield f"{'figure':<38}{'value':>10} {'DEM':>10}   95 % of replicas"
        for row in self.figures:
            span = "-"
            if row.interval:
                span = " … ".join(_shown(Measured(end, row.unit)) for end in (row.interval.low, row.interval.high))
            verdict = {True: " inside", False: " outside", None: ""}[row.inside]
            values = f"{_shown(row.candidate):>10} {_shown(row.truth):>10}   {span} {_unit(row.unit)}{verdict}"
            yield _with_note(f"{row.label:<38}{values}", row.candidate.note or row.truth.note)
        yield ""
        if self.failures is not None:
            yield from (*self.failures.lines(self.dem_outside), "")
        passed = sum(row.verdict == "pass" for row in self.requirements)
        flow = f"; the DEM's flow: {self.phases}" if self.phases else ""
        yield f"requirements ({passed} of {len(self.requirements)} pass){flow}"
        for row in self.requirements:
            value = f"{_shown(row.figure)} {_unit(row.figure.unit)}"
            yield _with_note(f"  {row.verdict:<10}{row.label:<64}{value}", row.figure.note)
        if self.not_asked:
            yield f"  not asked: {self.not_asked}"


def shown_multiple(multiple: float | None) -> str:
    """A multiple of a noise floor for people; a floor that is all but zero has no telling multiple."""
    return "-" if multiple is None else f"{multiple:.2f}" if multiple < 1e3 else "> 1000"


def _plain(label: str, figure: Measured) -> dict[str, Any]:
    return {"label": label, "value": figure.value, "unit": figure.unit, "valid": figure.defined, "note": figure.note}


def _shown(figure: Measured) -> str:
    """A figure for people: lengths in mm, the rest in their unit."""
    if not figure.defined:
        return "undefined"
    value = 1e3 * figure.number if figure.unit == "m" else figure.number
    return f"{value:.4g}" if abs(value) >= 100 else f"{value:.3g}"


def _unit(unit: str) -> str:
    return "mm" if unit == "m" else unit


def _with_note(line: str, note: str) -> str:
    return f"{line}  [{note}]" if note else line
