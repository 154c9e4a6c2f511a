"""The report of a sweep: table, a figure of each axis, what failed and why; in its folder and its parent run."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

from gran_bench import tracking
from gran_bench.config import TrackingConfig
from gran_bench.files import write_text
from gran_bench.plots.style import drawn_for
from gran_bench.plots.training import sweep_axis
from gran_bench.provenance import stamp
from gran_bench.sweep.runs import FAILED, FINISHED, SweepRun
from gran_bench.sweep.standing import Standing, cut_short, read_standing, unequal_updates
from gran_bench.sweep.sweep_file import TABLE, SweepFile, SweepFileError, SweepJob, read_sweep
from gran_bench.sweep.table import SEED, axes_of, best_choices, runs_frame, shown_table

PAGE = "README.md"


@dataclass(frozen=True)
class SweepReport:
    """What a report says and wrote.

    Attributes:
        text: the page, in Markdown.
        paths: page, table and figures.
        metrics: of the sweep as a whole, by their names in the tracking store.
        tags: the best choice for each error.
        failed: runs that failed.
        waiting: jobs that have not ended.
    """

    text: str
    paths: list[Path]
    metrics: dict[str, float]
    tags: dict[str, str]
    failed: list[SweepRun]
    waiting: list[SweepJob]


def report_sweep(folder: Path) -> SweepReport:
    """Read the runs of a sweep, and write its page and its figures into its folder.

    Args:
        folder: of the sweep.

    Raises:
        SweepFileError: the folder holds no sweep, or a damaged one.
    """
    stands = read_standing(folder)
    sweep, runs = stands.sweep, stands.counted
    if sweep is None and not runs:
        raise SweepFileError(f"{folder} holds no sweep; name a folder in results/sweeps")
    frame, axes = runs_frame(runs), axes_of(runs)
    failed = [run for run in runs if run.status == FAILED]
    name, judged = sweep.name if sweep else folder.name, _judged(runs)
    figures = figure_paths(folder, runs)
    text = f"# {name}\n\n{body(stands, [path.name for path in figures])}\n"
    write_text(folder / PAGE, text)
    # Last: what cannot be drawn must not cost the page.
    with drawn_for(f"{name}-{sweep.key[:8]}") if sweep else nullcontext():
        for axis, path in zip(axes or [SEED], figures, strict=False):
            others = [other for other in axes if other != axis]
            sweep_axis(frame.astype({axis: str}), axis, others, path, f"{name}: {judged}")
    best = best_choices(runs)
    metrics = {f"best/{figure}": value for figure, (_, value) in best.items()}
    metrics |= {
        "sweep/runs finished": sum(run.status == FINISHED for run in runs),
        "sweep/runs failed": len(failed),
        "sweep/jobs waiting": len(stands.waiting),
    }
    tags = {f"best.{figure}": choice for figure, (choice, _) in best.items()}
    paths = [path for path in (folder / PAGE, folder / TABLE, *figures) if path.exists()]
    return SweepReport(text, paths, {key: float(value) for key, value in metrics.items()}, tags, failed, stands.waiting)


def figure_paths(folder: Path, runs: Sequence[SweepRun]) -> list[Path]:
    """Where the figures of a sweep lie: one a swept key; of the seed where nothing else is swept.

    Args:
        folder: of the sweep.
        runs: that stand beside each other.
    """
    axes = axes_of(runs) or [SEED]
    return [folder / f"{axis.replace('/', '_').lstrip('+')}.png" for axis in axes] if runs else []


def log_report(run: tracking.Run, report: SweepReport) -> None:
    """Put a report into the parent run."""
    run.log_metrics(report.metrics, supersede=True)
    for name, value in report.tags.items():
        run.set_tag(name, value)
    for path in report.paths:
        run.log_artifact(path, "sweep")


def report_to_parent(folder: Path, report: SweepReport) -> bool:
    """Put a report into the parent run of its sweep, if the store beside it has one; whether it has.

    Raises:
        TrackingError: the store does not answer.
    """
    sweep, root = read_sweep(folder), folder.parent.parent
    if sweep is None or not tracking.has_store(root):
        return False
    config = TrackingConfig(experiment=sweep.experiment, root=str(root))
    with tracking.reopen_ended(config, sweep.key) as run:
        if run is not None:
            log_report(run, report)
        return run is not None


def report_sweeps(folders: Sequence[Path]) -> bool:
    """Report sweeps: pages and figures in their folders, and in their parent runs where the store has them.

    Args:
        folders: of sweeps.

    Returns:
        Whether every sweep, and the store, could be read; what could not is told on stderr.
    """
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


def _judged(runs: list[SweepRun]) -> str:
    """On what the runs were judged, in words: whoever chooses by a validation speed must say so."""
    judged = sorted({run.facts["judged"] for run in runs if "judged" in run.facts})
    words = [
        f"{speed}, {'the validation speed, by which one may choose' if kind == 'validation' else 'held out'}"
        for kind, speed in (one.split(", ") for one in judged)
    ]
    return f"judged at {' and '.join(words)}" if words else "nothing judged yet"


def body(stands: Standing, figures: Sequence[str]) -> str:
    """What a page says of a sweep: how many runs there are, their table, what failed, figures, where it comes from.

    Args:
        stands: where the sweep stands.
        figures: paths as the page has them.
    """
    sweep, runs, waiting = stands.sweep, stands.counted, stands.waiting
    failed = [run for run in runs if run.status == FAILED]
    lines = [f"{len(runs) - len(failed)} runs finished, {len(failed)} failed, {len(waiting)} wait; {_judged(runs)}."]
    if runs:
        lines += ["", shown_table(runs), "", *unequal_updates(runs), *cut_short(runs)]
    lines += [f"- failed: `{run.run}`: {run.reason} (log: `{run.facts.get('log', 'none')}`)" for run in failed]
    broken = [(run.run, run.facts["broken_rollouts"]) for run in runs if "broken_rollouts" in run.facts]
    lines += [f"- broke down in a rollout: `{run}` ({where})" for run, where in broken]
    lines += [f"- not done yet: `{job.run}`" for job in waiting]
    lines += [f"- not counted, of other code, data or budget: `{run.file_name}`" for run in stands.others]
    lines += ["", *(f"![{Path(figure).stem}]({figure})" for figure in figures), "", _made(sweep, runs)]
    return "\n".join(lines).strip()


def _made(sweep: SweepFile | None, runs: Sequence[SweepRun]) -> str:
    """Command, commits, the last day and hardware of runs; a warning where that was not one machine."""
    machines = Counter(run.facts["hardware"] for run in runs if "hardware" in run.facts)
    said = {"command": sweep.command if sweep else "", "day": max((run.ended_at for run in runs), default="")[:10]}
    said |= {"commit": ", ".join(sorted({run.facts["commit"] for run in runs if "commit" in run.facts}))}
    counted = (f"{machine} ({count} runs)" if len(machines) > 1 else machine for machine, count in machines.items())
    several = " Times, and what equal time bought, are of several machines: compare with care."
    return stamp(said | {"hardware": "; ".join(counted)}) + several * (len(machines) > 1)
