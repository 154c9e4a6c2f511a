"""Where a sweep stands: which runs of its table count, which are of other code, data or budget, which jobs wait.

A folder may hold runs of several commands (``model=contact`` first, ``model=radial`` later), and ``sweep.json`` lists
the jobs of the last one. A run of these jobs is known by its key; a run of another command counts if it was made with
the same code, data, judge and budget as one of the jobs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gran_bench.sweep.runs import SweepRun, read_runs
from gran_bench.sweep.sweep_file import SweepFile, SweepJob, read_sweep
from gran_bench.sweep.table import choice_of, newest

UNEQUAL = 1.5  # times the updates, from which on a sweep's page speaks of it


@dataclass(frozen=True)
class Standing:
    """Where a sweep stands.

    Attributes:
        sweep: what its folder says it is; None where it holds runs alone.
        counted: the runs that stand beside each other, each choice and seed once, by name.
        others: runs that do not: of other code, data or budget, or replaced by a newer one.
        waiting: jobs without a run of their key.
    """

    sweep: SweepFile | None
    counted: list[SweepRun]
    others: list[SweepRun]
    waiting: list[SweepJob]


def read_standing(folder: Path) -> Standing:
    """Where the sweep of a folder stands.

    Raises:
        SweepFileError: a file of the sweep is damaged.
    """
    return standing(read_sweep(folder), read_runs(folder))


def standing(sweep: SweepFile | None, runs: Sequence[SweepRun]) -> Standing:
    """Where a sweep stands.

    Args:
        sweep: with the jobs of its last command; None where none is known, so that all runs count.
        runs: all that its folder holds.
    """
    jobs = sweep.jobs if sweep else []
    identities = {_identity(job) for job in jobs}
    named = [run for run in runs if _identity(run) in identities]
    # The same choices with another key; or a job's own run under the name that another command gave it.
    choices, keys = {choice_of(job) for job in jobs}, {(job.key, job.judged_by) for job in jobs if job.key}
    made = {job.made_with for job in jobs if job.made_with}
    alike = [
        run
        for run in runs
        if choice_of(run) not in choices
        and (run.key, run.judged_by) not in keys
        and (not jobs or run.facts.get("made_with") in made)
    ]
    counted, _ = newest([*named, *alike])
    ended = {_identity(run) for run in named}
    waiting = [job for job in jobs if _identity(job) not in ended]
    return Standing(sweep, counted, [run for run in runs if run not in counted], waiting)


def _identity(one: SweepRun | SweepJob) -> tuple[object, ...]:
    return choice_of(one), one.key, one.judged_by


def unequal_updates(runs: Sequence[SweepRun]) -> list[str]:
    """A sentence for each model whose runs made very different numbers of updates in the same processor time.

    Args:
        runs: that stand beside each other.
    """
    updates: dict[tuple[str, str], list[int]] = {}
    for run in runs:
        if run.training.get("stopped_by") == "time" and not run.training.get("planned_steps"):
            alike = run.facts.get("model", ""), run.facts.get("budget", "")
            updates.setdefault(alike, []).append(run.training["steps"])
    return [
        f"Equal processor time bought {f'`{model}` ' if model else ''}{min(found)} to {max(found)} updates: "
        "compare with care."
        for (model, _), found in updates.items()
        if max(found) > UNEQUAL * min(found)
    ]


def cut_short(runs: Sequence[SweepRun]) -> list[str]:
    """A sentence if the clock has cut the budget of steps of some of the runs.

    Args:
        runs: that stand beside each other.
    """
    done = [run.training["steps"] / run.training["planned_steps"] for run in runs if run.training.get("planned_steps")]
    cut = [share for share in done if share < 1.0]
    return cut and [
        f"The clock has cut the training of {len(cut)} of {len(runs)} runs, one after {min(cut):.0%} of its updates: "
        "compare with care. With more trainer.minutes the same command goes on with them."
    ]
