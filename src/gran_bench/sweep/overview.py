"""What matters and by how much: one page over all sweeps, with the reach of each swept key in each error."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from gran_bench.atomic import write_text
from gran_bench.sweep.run_file import FAILED, FINISHED, SWEEPS, RunFile
from gran_bench.sweep.standing import read_standing
from gran_bench.sweep.sweep_file import sweep_folders
from gran_bench.sweep.table import COLUMNS, axes_of, runs_frame

OVERVIEW = "README.md"
REMARKS = "remarks.md"  # a person's words beside the page, put before its table
ERRORS = (
    "angle_error_floors",
    "com_angle_error_floors",
    "speed_w1_floors",
    "position_error_10_frames_mm",
    "ms_per_frame",
)
TIME = "ms_per_frame"
# Sections of the config that change the work of a frame. Under other keys networks are the same, and times scatter.
WORK = ("experiment", "model", "boundary", "scene", "threads", "device")


@dataclass(frozen=True)
class Reach:
    """How far the choice of one key moves one figure, everything else alike.

    Attributes:
        axis: the swept key.
        beside: values of the other swept keys, in words; empty where there is none.
        figure: heading of the figure.
        best: choice with the smallest mean, and the mean.
        worst: choice with the largest mean, and the mean.
        spread: standard deviation over seeds within a choice, pooled; NaN where each has one seed.
        lost: choices that have no mean, because a run of theirs failed or has no such figure.
    """

    axis: str
    beside: str
    figure: str
    best: tuple[str, float]
    worst: tuple[str, float]
    spread: float
    lost: tuple[str, ...]

    @property
    def one_seed(self) -> bool:
        """Whether every choice has one seed, so that nothing says what chance alone would give."""
        return math.isnan(self.spread)

    @property
    def factor(self) -> float:
        """Worst over best."""
        return self.worst[1] / self.best[1] if self.best[1] > 0 else math.nan


def changes_work(axis: str) -> bool:
    """Whether a swept key changes what a frame costs: the network, or what it is given to step."""
    return any(axis.lstrip("+") == key or axis.lstrip("+").startswith((f"{key}.", f"{key}/")) for key in WORK)


def reaches(runs: Sequence[RunFile]) -> Iterator[Reach]:
    """For each swept key, each choice of the others and each error: how far that key moves it.

    The time of a frame is a figure only of keys that change its work.

    Args:
        runs: of one sweep, each choice and seed once.
    """
    axes, frame = axes_of(runs), runs_frame(runs)
    headings = {column.name: column.heading for column in COLUMNS}
    for axis in axes:
        others = [other for other in axes if other != axis]
        groups = frame.groupby(others, sort=False) if others else [((), frame)]
        for values, group in groups:
            values = values if isinstance(values, tuple) else (values,)
            beside = ", ".join(f"{other}={value}" for other, value in zip(others, values, strict=True))
            for name in ERRORS:
                if name == TIME and not changes_work(axis):
                    continue
                found = _reach(group, axis, name)
                if found is not None:
                    yield Reach(axis, beside, headings[name], *found)


def _reach(
    group: pd.DataFrame, axis: str, name: str
) -> tuple[tuple[str, float], tuple[str, float], float, tuple[str, ...]] | None:
    """Best, worst, spread and lost choices of one figure; None where fewer than two choices have it."""
    means, squares, freedom, lost = {}, 0.0, 0, []
    for value, runs in group.groupby(axis, sort=False):
        figures = pd.to_numeric(runs[name], errors="coerce").astype(float)
        if (runs["status"] != FINISHED).any() or figures.isna().any():
            lost.append(str(value))
            continue
        means[str(value)] = float(figures.mean())
        squares += float(((figures - figures.mean()) ** 2).sum())
        freedom += len(figures) - 1
    if len(means) < 2:
        return None
    best, worst = min(means, key=means.__getitem__), max(means, key=means.__getitem__)
    spread = math.sqrt(squares / freedom) if freedom else math.nan
    return (best, means[best]), (worst, means[worst]), spread, tuple(lost)


def write_overview(root: Path) -> Path | None:
    """Write the page over all sweeps of a results folder; None where there is none.

    Raises:
        SweepFileError: a file of a sweep is damaged.
    """
    folders = sweep_folders(root)
    if not folders:
        return None
    lines = ["# What matters, and by how much", ""]
    remarks = root / SWEEPS / REMARKS
    if remarks.exists():
        lines += [remarks.read_text("utf-8").strip(), ""]
    found = [(folder.name, reach) for folder in folders for reach in reaches(read_standing(folder).counted)]
    single = sum(reach.one_seed for _, reach in found)
    lines += [
        "Each row: one swept key, everything else alike. Means over seeds; *spread* is the standard deviation between "
        "seeds of one choice, and a difference of less than twice that means nothing. A floor is the DEM against "
        f"itself. {single} of {len(found)} rows have one seed a choice: nothing says what chance alone would give, so "
        "they are no finding. The time of a frame stands only beside keys that change its work.",
        "",
        "| sweep | beside | figure | best | worst | worst / best | spread |",
        "|---|---|---|---|---|---:|---:|",
    ]
    lines += [_row(name, reach) for name, reach in found]
    for folder in folders:
        lines += ["", *_section(folder)]
    path = root / SWEEPS / OVERVIEW
    write_text(path, "\n".join(lines).rstrip() + "\n")
    return path


def _row(name: str, reach: Reach) -> str:
    best, worst = (f"{choice} ({value:.3g})" for choice, value in (reach.best, reach.worst))
    spread = "one seed" if reach.one_seed else f"{reach.spread:.2g}"
    lost = f"; no figure: {', '.join(reach.lost)}" if reach.lost else ""
    sweep, factor = f"[{name}]({name}/README.md)", f"{reach.factor:.2f}"
    return f"| {' | '.join([sweep, reach.beside, reach.figure, best, worst + lost, factor, spread])} |"


def _section(folder: Path) -> list[str]:
    """A sweep's numbers of runs, its command, its figures."""
    stands = read_standing(folder)
    sweep, runs = stands.sweep, stands.counted
    failed = sum(run.status == FAILED for run in runs)
    lines = [
        f"## {folder.name}",
        "",
        f"{len(runs) - failed} runs finished, {failed} failed, {len(stands.waiting)} wait.",
    ]
    lines[-1] += f" All figures: [table]({folder.name}/README.md), [CSV]({folder.name}/runs.csv)."
    if sweep:
        lines += ["", "```", sweep.command, "```"]
    figures = sorted(folder.glob("*.png"))
    return [*lines, "", *(f"![{path.stem}]({folder.name}/{path.name})" for path in figures)]
