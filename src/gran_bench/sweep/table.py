"""The table of a sweep: one row for each choice, mean and spread over its seeds, and how many of them failed."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from gran_bench.config.registry import METRICS
from gran_bench.sweep.runs import FINISHED, SweepRun
from gran_bench.sweep.sweep_file import SweepJob
from gran_bench.tracking import HEADLINE

SEED = "seed"
NOT_CHOSEN = "default"  # of a key that one run changed and another left as it was
TIME = f"{HEADLINE}rollout ms per frame"
UPDATES = "training.steps"
# Sections of the config that change the work of a frame. Under other keys networks are the same, and times scatter.
WORK = ("experiment", "model", "boundary", "scene", "threads", "device")


@dataclass(frozen=True)
class Column:
    """A figure of the table.

    Attributes:
        name: of the column in ``runs.csv``.
        label: for people.
        unit: for people.
        digits: behind the point.
        ranked: whether the choice with the smallest mean is worth naming.
    """

    name: str
    label: str
    unit: str
    digits: int
    ranked: bool = True

    @property
    def heading(self) -> str:
        """Label and unit."""
        return f"{self.label}, {self.unit}" if self.unit else self.label


COLUMNS = (
    Column(f"{HEADLINE}angle error floors", "angle error", "floors", 2),
    Column(f"{HEADLINE}com angle error floors", "centre-of-mass angle error", "floors", 2),
    Column(f"{HEADLINE}speed W1 floors", "speed W1", "floors", 2),
    Column(f"{HEADLINE}position error 10 frames mm", "position error, 10 frames", "mm", 2),
    Column(TIME, "a frame", "ms", 2),
    Column(UPDATES, "updates", "", 0, ranked=False),
    Column(f"{HEADLINE}requirements failed", "requirements failed", "", 1, ranked=False),
)


def choice_of(one: SweepRun | SweepJob) -> tuple[object, ...]:
    """What tells a run from the others of its sweep."""
    return tuple(sorted(one.choices.items())), one.seed


def columns_of(runs: Sequence[SweepRun]) -> tuple[Column, ...]:
    """The house's columns, then one for each registered metric that a run has."""
    registered = {f"{HEADLINE}{name} floors": METRICS[name].label for name in METRICS.added()}
    there = [name for name in registered if any(name in run.figures for run in runs)]
    return COLUMNS + tuple(Column(name, registered[name], "floors", 2) for name in there)


def newest(runs: Sequence[SweepRun]) -> tuple[list[SweepRun], list[SweepRun]]:
    """The runs that count, and those that a later one took the place of: the same choices with other code or data."""
    latest: dict[tuple, SweepRun] = {}
    for run in sorted(runs, key=lambda run: run.ended_at):
        latest[choice_of(run)] = run
    counted = sorted(latest.values(), key=lambda run: run.run)
    return counted, [run for run in runs if run not in counted]


def axes_of(runs: Sequence[SweepRun]) -> list[str]:
    """The keys whose values differ among runs, but for the seed."""
    keys = sorted({key for run in runs for key in run.choices} - {SEED})
    return [key for key in keys if len({run.choices.get(key, NOT_CHOSEN) for run in runs}) > 1]


def changes_work(axis: str) -> bool:
    """Whether a swept key changes what a frame costs: the network, or what it is given to step."""
    return any(axis.lstrip("+") == key or axis.lstrip("+").startswith((f"{key}.", f"{key}/")) for key in WORK)


def runs_frame(runs: Sequence[SweepRun]) -> pd.DataFrame:
    """One row a run: choices, seed, status and the figure of each column; None where it is undefined."""
    axes, rows = axes_of(runs), []
    for run in runs:
        row = {axis: run.choices.get(axis, NOT_CHOSEN) for axis in axes} | {"seed": run.seed, "status": run.status}
        row |= {column.name: run.figures.get(column.name) for column in columns_of(runs)}
        rows.append(row | {UPDATES: run.training.get("steps")})
    frame = pd.DataFrame(rows)
    return frame.sort_values([*axes, "seed"], key=_in_order, ignore_index=True) if rows else frame


def choices_frame(runs: Sequence[SweepRun]) -> pd.DataFrame:
    """One row a choice: its keys, ``n`` runs that finished, ``failed`` ones, mean and spread of each figure.

    The spread is the sample standard deviation over seeds; NaN for a single one. A figure that is undefined in one of
    the runs is undefined for the choice, with the number of undefined ones beside it.
    """
    axes, frame = axes_of(runs), runs_frame(runs)
    if frame.empty:
        return frame
    rows = []
    groups = frame.groupby(axes, sort=False) if axes else [((), frame)]
    for values, group in groups:
        done = group[group["status"] == FINISHED]
        row = dict(zip(axes, values if isinstance(values, tuple) else (values,), strict=True))
        row |= {"n": len(done), "failed": len(group) - len(done)}
        for column in columns_of(runs):
            figures = pd.to_numeric(done[column.name], errors="coerce").astype(float)
            undefined = int(figures.isna().sum())
            row[column.name] = math.nan if undefined or done.empty else figures.mean()
            row[f"{column.name}_spread"] = math.nan if undefined or len(done) < 2 else figures.std()
            row[f"{column.name}_undefined"] = undefined
        rows.append(row)
    return pd.DataFrame(rows)


def shown_table(runs: Sequence[SweepRun]) -> str:
    """The table of choices in Markdown, legible on a terminal too."""
    axes, frame = axes_of(runs), choices_frame(runs)
    columns = columns_of(runs)
    headings = [*axes, "runs", "failed", *(column.heading for column in columns)]
    rows = [headings]
    for _, row in frame.iterrows():
        rows.append([*(str(row[axis]) for axis in axes), str(row["n"]), str(row["failed"])])
        rows[-1] += [_shown(row, column) for column in columns]
    widths = [max(len(row[i]) for row in rows) for i in range(len(headings))]
    padded = [[cell.ljust(width) for cell, width in zip(row, widths, strict=True)] for row in rows]
    lines = [f"| {' | '.join(row)} |" for row in padded]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


def best_choices(runs: Sequence[SweepRun]) -> dict[str, tuple[str, float]]:
    """For each error, and the time of a frame, the choice with the smallest mean: its words and the mean, by name.

    A choice with a failed or undefined run is no candidate. The time is left out where a swept key does not change it:
    the smallest of equal times is chance.
    """
    axes, frame = axes_of(runs), choices_frame(runs)
    found = {}
    for column in columns_of(runs) if not frame.empty else ():
        if not column.ranked or (column.name == TIME and not all(map(changes_work, axes))):
            continue
        candidates = frame[(frame["failed"] == 0) & frame[column.name].notna()]
        if len(candidates):
            row = candidates.loc[candidates[column.name].idxmin()]
            found[column.name.removeprefix(HEADLINE)] = (
                ", ".join(f"{axis}={row[axis]}" for axis in axes) or "the one",
                row[column.name],
            )
    return found


def _shown(row: pd.Series, column: Column) -> str:
    if row[f"{column.name}_undefined"]:
        return f"undefined in {row[f'{column.name}_undefined']}"
    if math.isnan(row[column.name]):
        return "-"
    text = f"{row[column.name]:.{column.digits}f}"
    spread = row[f"{column.name}_spread"]
    return text if math.isnan(spread) else f"{text} ± {spread:.{column.digits}f}"


def _in_order(values: pd.Series) -> pd.Series:
    """Numbers by size before words by letter; numbers within words by size, too."""
    return values.map(
        lambda value: (
            (0, float(value), "")
            if is_number(value)
            else (1, 0.0, re.sub(r"\d+", lambda digits: digits[0].zfill(8), str(value)))
        )
    )


def is_number(value: object) -> bool:
    """Whether a swept value is a finite number."""
    try:
        return math.isfinite(float(str(value)))
    except ValueError:
        return False
