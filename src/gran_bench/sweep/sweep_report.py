"""The reports of sweeps: table, a figure of each axis, what failed and why; and over all sweeps what matters."""

import functools
import math
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gran_bench import tracking
from gran_bench.config import TrackingConfig
from gran_bench.files import markdown, write_part, write_text
from gran_bench.plots.style import drawn_for
from gran_bench.plots.training import sweep_axis
from gran_bench.sweep import runs as files
from gran_bench.sweep import table
from gran_bench.sweep.models_page import compares_models, write_models
from gran_bench.sweep.runs import FAILED, SweepFileError, SweepRun, read_sweep
from gran_bench.sweep.table import axes_of, read_standing, runs_frame

PAGE = "README.md"
UNEQUAL = 1.5  # times the updates, from which on a page speaks of it
CHANCE = 0.05  # share of rows without any effect whose ratio chance alone brings above what a page calls chance


@dataclass(frozen=True)
class SweepReport:
    """What a report says and wrote: the page, files, metrics and tags of the parent run, and what is not done."""

    text: str
    paths: list[Path]
    metrics: dict[str, float]
    tags: dict[str, str]
    failed: list[SweepRun]


def report_sweep(folder: Path) -> SweepReport:
    """Write page and figures of a sweep into its folder; a `SweepFileError` where it holds none, or a damaged one."""
    stands = read_standing(folder)
    sweep, runs = stands.sweep, stands.counted
    if sweep is None and not runs:
        raise SweepFileError(f"{folder} holds no sweep; name a folder in results/sweeps")
    name, figures = sweep.name if sweep else folder.name, figure_paths(folder, runs)
    text = f"# {name}\n\n{body(stands, [path.name for path in figures])}\n"
    write_text(folder / PAGE, text)
    # Last: what cannot be drawn must not cost the page.
    axes, frame = axes_of(runs), runs_frame(runs)
    with drawn_for(f"{name}-{sweep.key[:8]}") if sweep else nullcontext():
        for axis, path in zip(axes or [table.SEED], figures, strict=False):
            others = [other for other in axes if other != axis]
            scenes = sorted({run.facts["scene"] for run in runs if "scene" in run.facts})
            title = f"{name}: {', '.join([*scenes, table.judged_at(runs)])}, shared packing"
            sweep_axis(frame.astype({axis: str}), axis, others, path, title)
    best, failed = table.best_choices(runs), [run for run in runs if run.status == FAILED]
    metrics = {f"best/{figure}": float(value) for figure, (_, value) in best.items()} | {
        "sweep/runs finished": float(len(runs) - len(failed)),
        "sweep/runs failed": float(len(failed)),
        "sweep/jobs waiting": float(len(stands.waiting)),
    }
    tags = {f"best.{figure}": choice for figure, (choice, _) in best.items()}
    pages = write_models(folder, stands) if compares_models(folder) and runs else []
    paths = [path for path in (folder / PAGE, folder / files.TABLE, *figures, *pages) if path.exists()]
    return SweepReport(text, paths, metrics, tags, failed)


def figure_paths(folder: Path, runs: Sequence[SweepRun]) -> list[Path]:
    """Where the figures of a sweep lie: one a swept key; of the seed where nothing else is swept."""
    axes = axes_of(runs) or [table.SEED]
    return [folder / f"{axis.replace('/', '_').lstrip('+')}.png" for axis in axes] if runs else []


def log_report(run: tracking.Run, report: SweepReport) -> None:
    """Put a report into the parent run."""
    run.log_metrics(report.metrics, supersede=True)
    for name, value in report.tags.items():
        run.set_tag(name, value)
    for path in report.paths:
        run.log_artifact(path, "sweep")


def report_to_parent(folder: Path, report: SweepReport) -> bool:
    """Put a report into the parent run of its sweep, if the store beside it has one; whether it has."""
    sweep, root = read_sweep(folder), folder.parent.parent
    if sweep is None or not tracking.has_store(root):
        return False
    config = TrackingConfig(experiment=sweep.experiment, root=str(root))
    with tracking.reopen_ended(config, sweep.key) as run:
        if run is not None:
            log_report(run, report)
        return run is not None


def report_sweeps(folders: Sequence[Path]) -> bool:
    """Report sweeps in their folders, and in their parent runs where the store has them; whether all could be read."""
    every = True
    for folder in folders:
        try:
            report = report_sweep(folder.resolve())
            print(report.text)
            report_to_parent(folder.resolve(), report)
        except BrokenPipeError:
            raise
        except (SweepFileError, tracking.TrackingError, OSError) as error:
            print(f"error: {error}", file=sys.stderr)
            every = False
    return every


def body(stands: table.Standing, figures: Sequence[str]) -> str:
    """What a page says of a sweep: how many runs there are, their table, what failed, figures, where it comes from."""
    runs, waiting = stands.counted, stands.waiting
    failed = [run for run in runs if run.status == FAILED]
    cut = [run for run in runs if run.training.get("steps", 0) < (run.training.get("planned_steps") or 0)]
    broken = {run.run: run.facts["broken_rollouts"] for run in runs if "broken_rollouts" in run.facts}
    counts = f"{len(runs) - len(failed)} runs finished, {len(failed)} failed, {len(waiting)} wait"
    counts += f"; {table.judged_at(runs)}."
    notes = [
        *(f"- failed: `{run.run}`: {run.reason} (log: `{run.facts.get('log', 'none')}`)" for run in failed),
        *(f"- cut by the clock, goes on with more trainer.minutes: `{run.run}`" for run in cut),
        *(f"- broke down in a rollout: `{run}` ({where})" for run, where in broken.items()),
        *(f"- not done yet: `{job.run}`" for job in waiting),
        *(f"- not counted, of other code, data or budget: `{run.run}-{run.key[:8]}`" for run in stands.others),
    ]
    shown = "\n".join(f"![{Path(figure).stem}]({figure})" for figure in figures)
    notes = [*unequal_updates(runs), *notes]
    parts = [counts, table.shown_table(runs) if runs else "", "\n".join(notes), shown]
    return "\n\n".join(filter(None, [*parts, table.made_by(stands)]))


def unequal_updates(runs: Sequence[SweepRun]) -> Iterator[str]:
    """A sentence for each model whose runs made very different numbers of updates in the same processor time."""
    updates: dict[tuple[str, str], list[int]] = defaultdict(list)
    for run in runs:
        if run.training.get("stopped_by") == "time" and not run.training.get("planned_steps"):
            updates[run.facts.get("model", ""), run.facts.get("budget", "")].append(run.training["steps"])
    for (model, _), found in updates.items():
        if max(found) > UNEQUAL * min(found):
            bought = f"{f'`{model}` ' if model else ''}{min(found)} to {max(found)} updates"
            yield f"- equal processor time bought {bought}: compare with care"


@dataclass(frozen=True)
class Reach:
    """How far the choice of one key moves one figure, everything else alike."""

    axis: str  # the swept key
    beside: str  # values of the other swept keys, in words; empty where there is none
    figure: str  # heading of the figure
    best: tuple[str, float]  # choice with the smallest mean, and the mean
    worst: tuple[str, float]  # choice with the largest mean, and the mean
    chance: float  # `chance_ratio`, of worst to best by seeds alone; NaN where nothing says so
    lost: tuple[str, ...]  # choices that have no mean, because a run of theirs failed or has no such figure

    @property
    def factor(self) -> float:
        return self.worst[1] / self.best[1] if self.best[1] > 0 else math.nan

    @property
    def counts(self) -> bool:
        return self.factor > self.chance


def reaches(runs: Sequence[SweepRun]) -> Iterator[Reach]:
    """For each swept key of a sweep, each choice of the others and each error: how far that key moves it."""
    axes, frame = axes_of(runs), runs_frame(runs)
    for axis in axes:
        for values, group in table.grouped(frame, [other for other in axes if other != axis]):
            beside = ", ".join(f"{other}={value}" for other, value in values.items())
            for column in table.ranked_columns(table.COLUMNS, [axis]):
                by_choice = {
                    its[axis]: table.whole_figures(runs, column.name) for its, runs in table.grouped(group, [axis])
                }
                samples = {choice: found.to_numpy() for choice, found in by_choice.items() if found is not None}
                if len(samples) < 2:
                    continue
                lost = tuple(choice for choice in by_choice if choice not in samples)
                means = sorted(((choice, float(s.mean())) for choice, s in samples.items()), key=lambda one: one[1])
                chance = chance_ratio(list(samples.values()))
                yield Reach(axis, beside, column.heading, means[0], means[-1], chance, lost)


def chance_ratio(samples: Sequence[np.ndarray]) -> float:
    """The ratio of the largest to the smallest mean that chance alone exceeds in one of 20 rows of such samples.

    exp(q s / √n): Tukey's studentised range (1949) of as many means as there are choices, on logarithms, because errors
    of choices that run away scatter in proportion; s is pooled over choices, n the harmonic mean of numbers of seeds.
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
    folders, path = files.sweep_folders(root), root / files.SWEEPS / PAGE
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
    rows = [("sweep", "key", "beside", "figure", "best", "worst", "worst / best", "chance")]
    ordered = sorted(counted, key=lambda one: one[1].factor)
    for (name, axis, figure), reach in sorted({(name, one.axis, one.figure): one for name, one in ordered}.items()):
        best, worst = (f"{choice} ({value:.3g})" for choice, value in (reach.best, reach.worst))
        worst += f"; no figure: {', '.join(reach.lost)}" if reach.lost else ""
        rows.append((name, axis, reach.beside, figure, best, worst, f"{reach.factor:.2f}", f"{reach.chance:.2f}"))
    yield from markdown(rows)
