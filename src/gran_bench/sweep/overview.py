"""What matters and by how much: one page over all sweeps, with the reach of each swept key in each error."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gran_bench.files import write_part
from gran_bench.sweep.runs import SWEEPS, SweepRun, sweep_folders
from gran_bench.sweep.sweep_report import body, figure_paths
from gran_bench.sweep.table import COLUMNS, axes_of, grouped, ranked_columns, read_standing, runs_frame, whole_figures

OVERVIEW = "README.md"
CHANCE = 0.05  # share of rows without any effect whose ratio chance alone brings above what a page calls chance


@dataclass(frozen=True)
class Reach:
    """How far the choice of one key moves one figure, everything else alike."""

    axis: str  # the swept key
    beside: str  # values of the other swept keys, in words; empty where there is none
    figure: str  # heading of the figure
    best: tuple[str, float]  # choice with the smallest mean, and the mean
    worst: tuple[str, float]  # choice with the largest mean, and the mean
    # The ratio of worst to best that seeds alone would give, see `chance_ratio`; NaN where nothing says so.
    chance: float
    lost: tuple[str, ...]  # choices that have no mean, because a run of theirs failed or has no such figure

    @property
    def factor(self) -> float:
        """Worst over best."""
        return self.worst[1] / self.best[1] if self.best[1] > 0 else math.nan

    @property
    def counts(self) -> bool:
        """Whether the difference is more than chance gives."""
        return self.factor > self.chance


def reaches(runs: Sequence[SweepRun]) -> Iterator[Reach]:
    """For each swept key of a sweep, each choice of the others and each error: how far that key moves it."""
    axes, frame = axes_of(runs), runs_frame(runs)
    for axis in axes:
        for values, group in grouped(frame, [other for other in axes if other != axis]):
            beside = ", ".join(f"{other}={value}" for other, value in values.items())
            for column in ranked_columns(COLUMNS, [axis]):
                by_choice = {its[axis]: whole_figures(runs, column.name) for its, runs in grouped(group, [axis])}
                samples = {choice: found.to_numpy() for choice, found in by_choice.items() if found is not None}
                if len(samples) < 2:
                    continue
                lost = tuple(choice for choice in by_choice if choice not in samples)
                means = sorted(((choice, float(s.mean())) for choice, s in samples.items()), key=lambda one: one[1])
                chance = chance_ratio(list(samples.values()))
                yield Reach(axis, beside, column.heading, means[0], means[-1], chance, lost)


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
    """Renew the page over all sweeps of a results folder, with a part a sweep; None where there is none."""
    folders, path = sweep_folders(root), root / SWEEPS / OVERVIEW
    if not folders:
        return None
    stands = {folder: read_standing(folder) for folder in folders}
    found = [(folder.name, reach) for folder in folders for reach in reaches(stands[folder].counted)]
    write_part(path, "what matters", "\n".join(_what_matters(found)), "What matters")
    for folder in folders:
        figures = [figure for figure in figure_paths(folder, stands[folder].counted) if figure.exists()]
        text = body(stands[folder], [f"{folder.name}/{figure.name}" for figure in figures])
        write_part(path, folder.name, text, heading=folder.name)
    return path


def _what_matters(found: Sequence[tuple[str, Reach]]) -> Iterator[str]:
    """For each sweep, key and error the comparison that differs the most, if by more than chance; and how many do."""
    counted, single = [one for one in found if one[1].counts], sum(math.isnan(reach.chance) for _, reach in found)
    yield (
        f"{len(counted)} of {len(found)} comparisons of one swept key differ by more than chance; {single} have one "
        "seed a choice, so that nothing says what chance gives. The largest of each key and figure, where *chance* is "
        "the ratio of worst to best that seeds alone exceed in one of 20 comparisons:"
    )
    yield ""
    if counted:
        yield "| sweep | key | beside | figure | best | worst | worst / best | chance |"
        yield "|---|---|---|---|---|---|---:|---:|"
    largest = {
        (name, reach.axis, reach.figure): reach for name, reach in sorted(counted, key=lambda one: one[1].factor)
    }
    for (name, axis, figure), reach in sorted(largest.items()):
        best, worst = (f"{choice} ({value:.3g})" for choice, value in (reach.best, reach.worst))
        worst += f"; no figure: {', '.join(reach.lost)}" if reach.lost else ""
        cells = [name, axis, reach.beside, figure, best, worst, f"{reach.factor:.2f}", f"{reach.chance:.2f}"]
        yield f"| {' | '.join(cells)} |"
