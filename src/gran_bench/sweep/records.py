"""The runs of a sweep in the store: waiting before their jobs, recorded again where lost, closed afterwards."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from gran_bench import tracking
from gran_bench.compose import PlannedJob
from gran_bench.config import TrackingConfig
from gran_bench.run.identity import RunIdentity
from gran_bench.run.record import Clock, RunRecord, tell
from gran_bench.run.run_file import RUNS, RunFile
from gran_bench.sweep.jobs import Sweep


def schedule_jobs(
    sweep: Sweep,
    planned: Sequence[PlannedJob],
    identities: Sequence[RunIdentity | None],
    summaries: dict[int, dict[str, Any]],
) -> None:
    """A run in the store for each job; one that is finished is recorded where the store does not know it.

    Args:
        sweep: with its parent, and which jobs have nothing to do.
        planned: its jobs.
        identities: who their runs are; None where the data could not be made.
        summaries: of the runs that are finished in this results folder, by number.

    Raises:
        TrackingError: the store does not take it.
    """
    known = [(number, identity) for number, identity in enumerate(identities) if identity is not None]
    children = [
        tracking.Child(
            identity.name, identity.key, number in sweep.done, f"{sweep.jobs[number].run}-{identity.key[:8]}"
        )
        for number, identity in known
    ]
    missing = tracking.schedule_children(planned[0].config.tracking, sweep.parent, children)
    for number, identity in known:
        if number not in sweep.done or identity.key not in missing:
            continue
        config = planned[number].config
        config.tracking.parent = sweep.parent
        record = RunRecord(identity, config, config.scene.name, Clock())
        if number in summaries:
            record.record_again(summaries[number])
        else:
            record.record_file(sweep.folder / RUNS / sweep.jobs[number].file_name)


def settle_runs(config: TrackingConfig, parent: str | None, failed: Iterable[RunFile]) -> None:
    """Close the runs whose own process could not, and let stand-ins say what their runs say by now.

    A store that does not answer is told: the report that comes next matters more.

    Args:
        config: where, or that nothing is recorded.
        parent: id of the sweep's parent.
        failed: runs of the sweep that failed.
    """
    for run in failed:
        try:
            tracking.end_child(config, run.key, run.reason or "failed")
        except tracking.TrackingError as error:
            tell(f"{run.run} is not closed in the store: {error}")
    try:
        tracking.fill_stand_ins(config, parent)
    except tracking.TrackingError as error:
        tell(f"runs that this sweep shares with others are not shown under it: {error}")
