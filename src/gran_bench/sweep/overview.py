"""What matters and by how much: one page over all sweeps, with the reach of each swept key in each error."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from gran_bench.atomic import write_text
from gran_bench.sweep.run_file import FAILED, FINISHED, SWEEPS, RunFile
from gran_bench.sweep.standing import read_standing
from gran_bench.sweep.sweep_file import sweep_folders
from gran_bench.sweep.sweep_report import figure_paths
from gran_bench.sweep.table import COLUMNS, TIME, axes_of, changes_work, runs_frame

OVERVIEW = "README.md"
REMARKS = "remarks.md"  # a person's words beside the page, put before its table
ERRORS = (
    "angle_error_floors",
    "com_angle_error_floors",
    "speed_w1_floors",
    "position_error_10_frames_mm",
    "ms_per_frame",
)
CHANCE = 0.05  # share of rows without any effect whose ratio chance alone brings above what a page calls chance


@dataclass(frozen=True)
class Reach:
    """How far the choice of one key moves one figure, everything else alike.

    Attributes:
        axis: the swept key.
        beside: values of the other swept keys, in words; empty where there is none.
        figure: heading of the figure.
        best: choice with the smallest mean, and the mean.
        worst: choice with the largest mean, and the mean.
        chance: the ratio of worst to best that seeds alone would give, see `chance_ratio`; NaN where nothing says so.
        lost: choices that have no mean, because a run of theirs failed or has no such figure.
    """

    axis: str
    beside: str
    figure: str
    best: tuple[str, float]
    worst: tuple[str, float]
    chance: float
    lost: tuple[str, ...]

    @property
    def one_seed(self) -> bool:
        """Whether every choice has one seed, so that nothing says what chance alone would give."""
        return math.isnan(self.chance)

    @property
    def factor(self) -> float:
        """Worst over best."""
        return self.worst[1] / self.best[1] if self.best[1] > 0 else math.nan

    @property
    def counts(self) -> bool:
        """Whether the difference is more than chance gives."""
        return not self.one_seed and self.factor > self.chance


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
    """Best, worst, chance and lost choices of one figure; None where fewer than two choices have it."""
    found, lost = {}, []
    for value, runs in group.groupby(axis, sort=False):
        figures = pd.to_numeric(runs[name], errors="coerce").astype(float)
        if (runs["status"] != FINISHED).any() or figures.isna().any():
            lost.append(str(value))
        else:
            found[str(value)] = figures.to_numpy()
    if len(found) < 2:
        return None
    means = {value: float(figures.mean()) for value, figures in found.items()}
    best, worst = min(means, key=means.__getitem__), max(means, key=means.__getitem__)
    return (best, means[best]), (worst, means[worst]), chance_ratio(list(found.values())), tuple(lost)


def chance_ratio(samples: Sequence[np.ndarray]) -> float:
    """The ratio of the largest to the smallest mean that chance alone exceeds in one of 20 rows of such samples.

    exp(q s / √n): Tukey's studentised range (1949) of as many means as there are choices, the best and the worst of
    which are looked at, on logarithms, because errors of choices that run away scatter in proportion.

    Args:
        samples: a figure's values over the seeds of each choice; s is pooled over choices, n the harmonic mean of
            their numbers.

    Returns:
        NaN where each choice has one seed, or a figure is not positive.
    """
    freedom = sum(len(sample) - 1 for sample in samples)
    if freedom == 0 or any((sample <= 0).any() for sample in samples):
        return math.nan
    logs = [np.log(sample) for sample in samples]
    deviation = math.sqrt(sum(float(((log - log.mean()) ** 2).sum()) for log in logs) / freedom)
    count = len(samples) / sum(1.0 / len(sample) for sample in samples)
    return math.exp(_studentised_range(len(samples), freedom) * deviation / math.sqrt(count))


@functools.cache
def _studentised_range(means: int, freedom: int) -> float:
    from scipy.stats import studentized_range  # takes a second to load, and is needed at the end alone

    return float(studentized_range.ppf(1.0 - CHANCE, means, freedom))


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
        "Each row: one swept key, everything else alike. Means over seeds; *by chance* is the ratio of worst to best "
        "that seeds alone would exceed in one of 20 such rows (Tukey's range of the means, on logarithms), and a "
        "ratio below it is no finding. A floor is the DEM against itself. "
        f"{single} of {len(found)} rows have one seed a choice: nothing says what chance alone would give, so they are "
        "no finding. The time of a frame stands only beside keys that change its work.",
        "",
        "| sweep | beside | figure | best | worst | worst / best | by chance |",
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
    chance = "one seed" if reach.one_seed else f"{reach.chance:.2f}"
    lost = f"; no figure: {', '.join(reach.lost)}" if reach.lost else ""
    sweep, factor = f"[{name}]({name}/README.md)", f"{reach.factor:.2f}"
    return f"| {' | '.join([sweep, reach.beside, reach.figure, best, worst + lost, factor, chance])} |"


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
    figures = [path for path in figure_paths(folder, runs) if path.exists()]
    return [*lines, "", *(f"![{path.stem}]({folder.name}/{path.name})" for path in figures)]
