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
from gran_bench.plots import drawn_for, sweep_axis
from gran_bench.provenance import stamp
from gran_bench.sweep.runs import FAILED, TABLE, SweepFile, SweepFileError, SweepJob, SweepRun, read_sweep
from gran_bench.sweep.table import SEED, Standing, axes_of, best_choices, read_standing, runs_frame, shown_table

PAGE = "README.md"


@dataclass(frozen=True)
class SweepReport:
    """What a report says and wrote: the page, files, metrics and tags of the parent run, and what is not done."""

    text: str
    paths: list[Path]
    metrics: dict[str, float]
    tags: dict[str, str]
    failed: list[SweepRun]
    waiting: list[SweepJob]


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
        for axis, path in zip(axes or [SEED], figures, strict=False):
            others = [other for other in axes if other != axis]
            sweep_axis(frame.astype({axis: str}), axis, others, path, f"{name}: {_judged(runs)}")
    best, failed = best_choices(runs), [run for run in runs if run.status == FAILED]
    metrics = {f"best/{figure}": float(value) for figure, (_, value) in best.items()} | {
        "sweep/runs finished": float(len(runs) - len(failed)),
        "sweep/runs failed": float(len(failed)),
        "sweep/jobs waiting": float(len(stands.waiting)),
    }
    tags = {f"best.{figure}": choice for figure, (choice, _) in best.items()}
    paths = [path for path in (folder / PAGE, folder / TABLE, *figures) if path.exists()]
    return SweepReport(text, paths, metrics, tags, failed, stands.waiting)


def figure_paths(folder: Path, runs: Sequence[SweepRun]) -> list[Path]:
    """Where the figures of a sweep lie: one a swept key; of the seed where nothing else is swept."""
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


def body(stands: Standing, figures: Sequence[str]) -> str:
    """What a page says of a sweep: how many runs there are, their table, what failed, figures, where it comes from."""
    runs, waiting = stands.counted, stands.waiting
    failed = [run for run in runs if run.status == FAILED]
    cut = [run for run in runs if run.training.get("steps", 0) < (run.training.get("planned_steps") or 0)]
    broken = {run.run: run.facts["broken_rollouts"] for run in runs if "broken_rollouts" in run.facts}
    counts = f"{len(runs) - len(failed)} runs finished, {len(failed)} failed, {len(waiting)} wait; {_judged(runs)}."
    notes = [
        *(f"- failed: `{run.run}`: {run.reason} (log: `{run.facts.get('log', 'none')}`)" for run in failed),
        *(f"- cut by the clock, goes on with more trainer.minutes: `{run.run}`" for run in cut),
        *(f"- broke down in a rollout: `{run}` ({where})" for run, where in broken.items()),
        *(f"- not done yet: `{job.run}`" for job in waiting),
        *(f"- not counted, of other code, data or budget: `{run.file_name}`" for run in stands.others),
    ]
    shown = "\n".join(f"![{Path(figure).stem}]({figure})" for figure in figures)
    parts = [counts, shown_table(runs) if runs else "", "\n".join(notes), shown, _made(stands.sweep, runs)]
    return "\n\n".join(filter(None, parts))


def _judged(runs: Sequence[SweepRun]) -> str:
    """On what the runs were judged, in words: whoever chooses by a validation speed must say so."""
    judged = sorted({run.facts["judged"] for run in runs if "judged" in run.facts})
    words = [
        f"{speed}, {'the validation speed, by which one may choose' if kind == 'validation' else 'held out'}"
        for kind, speed in (one.split(", ") for one in judged)
    ]
    return f"judged at {' and '.join(words)}" if words else "nothing judged yet"


def _made(sweep: SweepFile | None, runs: Sequence[SweepRun]) -> str:
    """Command, commits, the last day and the machines of runs."""
    machines = Counter(run.facts["hardware"] for run in runs if "hardware" in run.facts)
    counted = (f"{machine} ({count} runs)" if len(machines) > 1 else machine for machine, count in machines.items())
    said = {
        "command": sweep.command if sweep else "",
        "day": max((run.ended_at for run in runs), default="")[:10],
        "commit": ", ".join(sorted({run.facts["commit"] for run in runs if "commit" in run.facts})),
        "hardware": "; ".join(counted),
    }
    return stamp(said)
