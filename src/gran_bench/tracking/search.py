"""Runs that a store knows, for readers: nothing is made or changed there."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

from gran_bench.tracking.store import DATABASE, QUIET, TrackingError, database_uri, has_store, server_uri, shown_uri


class StoredRun(NamedTuple):
    """A run as the store knows it; of a sweep it has no folder of files."""

    run_id: str
    name: str
    status: str
    folder: str | None
    command: str | None


def stored_runs(root: Path) -> list[StoredRun]:
    """The runs of all experiments, the latest first.

    Args:
        root: of the results.

    Raises:
        TrackingError: the store does not answer.
    """
    if not has_store(root):
        return []
    os.environ.update(QUIET)
    found, page = [], None
    try:
        from mlflow import MlflowClient

        client = MlflowClient(server_uri() or database_uri(str(root.resolve() / DATABASE)))
        experiments = [experiment.experiment_id for experiment in client.search_experiments()]
        while page != "":
            some = client.search_runs(experiments, page_token=page)
            found, page = [*found, *some], some.token or ""
    except Exception as error:  # of any kind: MLflow lets those of SQLAlchemy through
        reason = shown_uri(f"{type(error).__name__}: {error}".splitlines()[0])[:300]
        raise TrackingError(f"the tracking store of {root} does not answer: {reason}; name a run's folder") from error
    return [
        StoredRun(run.info.run_id, run.info.run_name, run.info.status, *map(run.data.tags.get, ("folder", "command")))
        for run in found
    ]
