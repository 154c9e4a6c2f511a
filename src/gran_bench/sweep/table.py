"""The table of a sweep: which runs count, and for each choice mean and spread over its seeds and how many failed."""

import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from gran_bench.config.registry import METRICS
from gran_bench.files import markdown
from gran_bench.provenance import stamp
from gran_bench.sweep.runs import FINISHED, SweepFile, SweepJob, SweepRun, read_runs, read_sweep
from gran_bench.tracking import HEADLINE

SEED = "seed"
NOT_CHOSEN = "default"  # of a key that one run changed and another left as it was
TIME = f"{HEADLINE}rollout ms per frame"
UPDATES = "training.steps"
# Sections of the config that change the work of a frame. Under other keys networks are the same, and times scatter.
WORK = ("experiment", "model", "boundary", "scene", "threads", "device")


@dataclass(frozen=True)
class Column:
    """A figure of the table: its column in ``runs.csv``, its words, its unit, and how it is shown."""

    name: str
    label: str
    unit: str
    digits: int = 2  # behind the point
    ranked: bool = True  # whether the choice with the smallest mean is worth naming

    @property
    def heading(self) -> str:
        return f"{self.label}, {self.unit}" if self.unit else self.label


COLUMNS = (
    Column(f"{HEADLINE}angle error floors", "angle error", "floors"),
    Column(f"{HEADLINE}com angle error floors", "centre-of-mass angle error", "floors"),
    Column(f"{HEADLINE}speed W1 floors", "speed W1", "floors"),
    Column(f"{HEADLINE}position error 10 frames mm", "position error, 10 frames", "mm"),
    Column(TIME, "a frame", "ms"),
    Column(UPDATES, "updates", "", 0, ranked=False),
    Column(f"{HEADLINE}requirements failed", "requirements failed", "", 1, ranked=False),
)


@dataclass(frozen=True)
class Standing:
    """Where a sweep stands."""

    sweep: SweepFile | None  # what its folder says it is; None where it holds runs alone
    counted: list[SweepRun]  # the runs that stand beside each other, each choice and seed once, by name
    others: list[SweepRun]  # runs that do not: of other code, data or budget, or replaced by a newer one
    waiting: list[SweepJob]  # jobs without a run of their key


def read_standing(folder: Path) -> Standing:
    """Where the sweep of a folder stands; a `SweepFileError` where a file of it is damaged."""
    return standing(read_sweep(folder), read_runs(folder))


def standing(sweep: SweepFile | None, runs: Sequence[SweepRun]) -> Standing:
    """Where a sweep stands that has some runs.

    A run of the jobs in ``sweep.json``, those of the last command, is known by its key; another counts if it was made
    with the same code, data, judge and budget as one of them.
    """
    jobs = sweep.jobs if sweep else []
    listed, choices = {job.whole for job in jobs}, {job.choice for job in jobs}
    keys, made = {(job.key, job.judged_by) for job in jobs if job.key}, {job.made_with for job in jobs if job.made_with}
    latest: dict[tuple[object, ...], SweepRun] = {}
    for run in sorted(runs, key=lambda run: run.ended_at):
        # Of other commands: not a job's choice with another key, and not its own run under another name.
        another = run.choice not in choices and (run.key, run.judged_by) not in keys
        if run.whole in listed or (another and (not jobs or run.facts.get("made_with") in made)):
            latest[run.choice] = run
    counted, ended = sorted(latest.values(), key=lambda run: run.run), {run.whole for run in runs}
    others = [run for run in runs if run not in counted]
    return Standing(sweep, counted, others, [job for job in jobs if job.whole not in ended])


def columns_of(runs: Sequence[SweepRun]) -> tuple[Column, ...]:
    """The house's columns, then one for each registered metric that a run has."""
    registered = (Column(f"{HEADLINE}{name} floors", METRICS[name].label, "floors") for name in METRICS.added())
    return COLUMNS + tuple(column for column in registered if any(column.name in run.figures for run in runs))


def axes_of(runs: Sequence[SweepRun]) -> list[str]:
    """The keys whose values differ among runs, but for the seed."""
    keys = sorted({key for run in runs for key in run.choices} - {SEED})
    return [key for key in keys if len({run.choices.get(key, NOT_CHOSEN) for run in runs}) > 1]


def ranked_columns(columns: Sequence[Column], axes: Sequence[str]) -> list[Column]:
    """The columns whose best choice is worth naming; the time of a frame where every swept key changes its work."""
    works = all(re.split(r"[./]", axis.lstrip("+"))[0] in WORK for axis in axes)
    return [column for column in columns if column.ranked and (works or column.name != TIME)]


def runs_frame(runs: Sequence[SweepRun]) -> pd.DataFrame:
    """One row a run: choices, seed, status and the figure of each column; NaN where it is undefined."""
    axes, names, rows = axes_of(runs), [column.name for column in columns_of(runs)], []
    for run in runs:
        row = {axis: run.choices.get(axis, NOT_CHOSEN) for axis in axes} | {SEED: run.seed, "status": run.status}
        rows.append(row | {name: run.figures.get(name) for name in names} | {UPDATES: run.training.get("steps")})
    frame = pd.DataFrame(rows)
    if frame.empty:
        return frame
    return frame.astype(dict.fromkeys(names, float)).sort_values([*axes, SEED], key=_in_order, ignore_index=True)


def grouped(frame: pd.DataFrame, keys: list[str]) -> Iterator[tuple[dict[str, str], pd.DataFrame]]:
    """The rows of each choice of some keys, with their values, in order."""
    for values, group in frame.groupby(keys, sort=False) if keys else [((), frame)]:
        yield dict(zip(keys, values, strict=True)), group


def whole_figures(group: pd.DataFrame, name: str) -> pd.Series | None:
    """The figures of a choice; None where one of its runs failed or has no such figure."""
    return None if (group["status"] != FINISHED).any() or group[name].isna().any() else group[name]


def shown_table(runs: Sequence[SweepRun]) -> str:
    """The table of choices in Markdown, legible on a terminal too: mean ± sample standard deviation over seeds."""
    axes, columns = axes_of(runs), columns_of(runs)
    rows = [[*axes, "runs", "failed", *(column.heading for column in columns)]]
    for values, group in grouped(runs_frame(runs), axes):
        done = group[group["status"] == FINISHED]
        counts = [str(len(done)), str(len(group) - len(done))]
        rows.append([*values.values(), *counts, *(shown(done[column.name], column.digits) for column in columns)])
    return "\n".join(markdown(rows, aligned=True))


def judged_at(runs: Sequence[SweepRun]) -> str:
    """On which speed runs were judged, and what kind of speed it is."""
    judged = sorted({run.facts["judged"] for run in runs if "judged" in run.facts})
    words = [
        f"{speed}, {'the validation speed, by which one may choose' if kind == 'validation' else 'held out'}"
        for kind, speed in (one.split(", ") for one in judged)
    ]
    return f"judged at {' and '.join(words)}" if words else "nothing judged yet"


def made_by(stands: Standing) -> str:
    """Command, commit, day and machines of a sweep; a warning where there are several."""
    runs = stands.counted
    machines = Counter(run.facts["hardware"] for run in runs if "hardware" in run.facts)
    counted = (f"{machine} ({count} runs)" if len(machines) > 1 else machine for machine, count in machines.items())
    made = {
        "command": stands.sweep.command if stands.sweep else "",
        "day": max((run.ended_at for run in runs), default="")[:10],
        "commit": ", ".join(sorted({run.facts["commit"] for run in runs if "commit" in run.facts})),
        "hardware": "; ".join(counted),
    }
    several = " Times, and what equal time bought, are of several machines: compare with care."
    return stamp(made) + several * (len(machines) > 1)


def best_choices(runs: Sequence[SweepRun]) -> dict[str, tuple[str, float]]:
    """For each error, and the time of a frame, the choice with the smallest mean: its words and the mean, by name.

    A choice with a failed or undefined run is no candidate. The smallest of equal times is chance, and left out.
    """
    axes, frame, found = axes_of(runs), runs_frame(runs), {}
    for column in ranked_columns(columns_of(runs), axes) if runs else ():
        means = {}
        for values, group in grouped(frame, axes):
            if (figures := whole_figures(group, column.name)) is not None:
                means[", ".join(f"{axis}={value}" for axis, value in values.items()) or "the one"] = figures.mean()
        if means:
            found[column.name.removeprefix(HEADLINE)] = min(means.items(), key=lambda choice: choice[1])
    return found


def shown(figures: pd.Series, digits: int) -> str:
    """Mean ± sample standard deviation over seeds, or in how many runs the figure is undefined."""
    if undefined := int(figures.isna().sum()):
        return f"undefined in {undefined}"
    if figures.empty:
        return "-"
    return f"{figures.mean():.{digits}f}" + (f" ± {figures.std():.{digits}f}" if len(figures) > 1 else "")


def _in_order(values: pd.Series) -> pd.Series:
    """Numbers by size before words by letter; numbers within words by size, too."""

    def order(value: object) -> tuple[int, float, str]:
        try:
            if math.isfinite(number := float(str(value))):
                return 0, number, ""
        except ValueError:
            pass
        return 1, 0.0, re.sub(r"\d+", lambda digits: digits[0].zfill(8), str(value))

    return values.map(order)
