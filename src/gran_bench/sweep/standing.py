"""Where a sweep stands: which runs of its folder count, which are of other code, data or budget, which jobs wait.

A folder may hold runs of several commands (``model=contact`` first, ``model=radial`` later), and ``sweep.json`` lists
the jobs of the last one. A run of these jobs is known by its key; one of an earlier command counts unless what it left
says that it was made otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gran_bench.run.run_file import MADE, RunFile, read_runs
from gran_bench.sweep.sweep_file import SweepFile, SweepJob, read_sweep
from gran_bench.sweep.table import newest

# Sections of the config that a judgement, data and a budget follow: a run that chose among them may differ there.
DATA_CHOICES = ("experiment", "scene", "dem", "dataset")
JUDGE_CHOICES = (*DATA_CHOICES, "judge")
BUDGET_CHOICES = ("experiment", "trainer")

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
    counted: list[RunFile]
    others: list[RunFile]
    waiting: list[SweepJob]


def read_standing(folder: Path) -> Standing:
    """Where the sweep of a folder stands.

    Raises:
        SweepFileError: a file of the sweep is damaged.
    """
    return standing(read_sweep(folder), read_runs(folder))


def standing(sweep: SweepFile | None, runs: Sequence[RunFile]) -> Standing:
    """Where a sweep stands.

    Args:
        sweep: with the jobs of its last command; None where none is known.
        runs: all that its folder holds.
    """
    jobs = sweep.jobs if sweep else []
    listed, identities = {_choice(job) for job in jobs}, {_identity(job) for job in jobs}
    keys = {(job.key, job.judged_by) for job in jobs if job.key}
    named = [run for run in runs if _identity(run) in identities]
    # The same choices with another key; or a job's own run under the name that another command gave it.
    superseded = [
        run for run in runs if run not in named and (_choice(run) in listed or (run.key, run.judged_by) in keys)
    ]
    earlier = [run for run in runs if run not in named and run not in superseded]
    alike = [run for run in earlier if _made_alike(run, jobs, named)]
    counted, _ = newest([*named, *alike])
    ended = {_identity(run) for run in named}
    waiting = [job for job in jobs if _identity(job) not in ended]
    return Standing(sweep, counted, [run for run in runs if run not in counted], waiting)


def _choice(one: RunFile | SweepJob) -> tuple[Any, ...]:
    return tuple(sorted(one.choices.items())), one.seed


def _identity(one: RunFile | SweepJob) -> tuple[Any, ...]:
    return *_choice(one), one.key, one.judged_by


def _made_alike(run: RunFile, jobs: Sequence[SweepJob], named: Sequence[RunFile]) -> bool:
    """Whether nothing that a run of an earlier command left says that it was made otherwise than the current ones."""
    return (
        _agrees(run, jobs, lambda one: one.judged_by or None, JUDGE_CHOICES)
        and _agrees(run, named, lambda one: one.facts.get("data_digest"), DATA_CHOICES)
        and _agrees(run, named, lambda one: one.facts.get(MADE, {}).get("budget"), BUDGET_CHOICES)
        and _agrees(run, named, lambda one: one.facts.get(MADE, {}).get("judging_code"), ())
        and _agrees(run, named, lambda one: one.facts.get(MADE, {}).get("training_code", {}).get(model_of(run)), ())
    )


def _agrees(run: RunFile, current: Sequence[Any], said: Callable[[Any], Any], sections: tuple[str, ...]) -> bool:
    """Whether a run says what a current one says that chose the same in ``sections``; who says nothing agrees."""
    mine = said(run)
    theirs = [said(one) for one in current if _chosen(one, sections) == _chosen(run, sections)]
    theirs = [value for value in theirs if value is not None]
    return mine is None or not theirs or mine in theirs


def _chosen(one: RunFile | SweepJob, sections: tuple[str, ...]) -> dict[str, str]:
    """The choices of a run within some sections of the config."""
    return {key: value for key, value in one.choices.items() if key.partition(".")[0].partition("/")[0] in sections}


def unequal_updates(runs: Sequence[RunFile]) -> list[str]:
    """A sentence for each model whose runs made very different numbers of updates in the same processor time.

    Args:
        runs: that stand beside each other.
    """
    updates: dict[tuple[str, str], list[int]] = {}
    for run in runs:
        if run.training.get("stopped_by") == "time" and run.training.get("planned_steps") is None:
            alike = model_of(run), str(_chosen(run, BUDGET_CHOICES))
            updates.setdefault(alike, []).append(run.training["steps"])
    return [
        f"Equal processor time bought {f'`{model}` ' if model else ''}{min(found)} to {max(found)} updates: "
        "compare with care."
        for (model, _), found in updates.items()
        if max(found) > UNEQUAL * min(found)
    ]


def cut_short(runs: Sequence[RunFile]) -> list[str]:
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


def model_of(run: RunFile) -> str:
    """The model that a run trained, as far as its file says it; else empty: the one of its recipe."""
    return run.facts.get(MADE, {}).get("model") or run.choices.get("model", "")
