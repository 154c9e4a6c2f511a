"""Stand-ins: a run that two sweeps share hangs under the first; under the other a copy of its figures stands for it.

MLflow gives a run one parent, and the run table groups by it. Without the copy the second sweep would miss the very
choice that it shares. A stand-in has no key, so that no command takes it for the run, and says whose place it takes.
"""

from __future__ import annotations

import time

from gran_bench.config import TrackingConfig
from gran_bench.tracking.names import shown_name
from gran_bench.tracking.store import PARENT_TAG, MetricPoint, Store

STANDS_FOR = "gran_bench.stands_for"  # id of the run
NOTE_TAG = "mlflow.note.content"
_OWN_TAGS = ("mlflow.", "gran_bench.", "sweep")  # beginnings of tags that a stand-in has for itself


def let_stand_in(store: Store, run_id: str, parent: str, name: str) -> None:
    """Make a waiting run under ``parent`` that stands for the run of another sweep, unless there is one.

    Args:
        store: held alone.
        run_id: of the run.
        parent: id of the second sweep's parent.
        name: of the run in that sweep.
    """
    if _stand_ins(store, parent, run_id):
        return
    with store.answering() as client:
        tags = {**store.tags_of_child(parent), STANDS_FOR: run_id}
        stand_in = client.create_run(store.experiment_id, tags=tags, run_name=shown_name(name)).info.run_id
        client.update_run(stand_in, status="SCHEDULED")


def dismiss_stand_ins(store: Store, run_id: str, parent: str) -> None:
    """Delete what stands for a run that hangs under ``parent`` itself by now."""
    with store.answering() as client:
        for stand_in in _stand_ins(store, parent, run_id):
            client.delete_run(stand_in)


def fill_stand_ins(config: TrackingConfig, parent: str | None) -> None:
    """Give each stand-in under a parent the parameters, figures, tags and status that its run has by now.

    Args:
        config: where, or that nothing is recorded.
        parent: id of a sweep's parent; None without tracking.

    Raises:
        TrackingError: the store cannot be used.
    """
    if parent is None:
        return
    store = Store(config)
    with store.alone():
        for stand_in, run_id in _stand_ins(store, parent).items():
            _fill(store, stand_in, run_id)


def _stand_ins(store: Store, parent: str, run_id: str | None = None) -> dict[str, str]:
    """What each stand-in under a parent stands for, by its id; of one run, or of all."""
    of_run = "" if run_id is None else f" and tags.`{STANDS_FOR}` = '{run_id}'"
    with store.answering() as client:
        found = client.search_runs([store.experiment_id], f"tags.`{PARENT_TAG}` = '{parent}'{of_run}")
    return {run.info.run_id: run.data.tags[STANDS_FOR] for run in found if STANDS_FOR in run.data.tags}


def _fill(store: Store, stand_in: str, run_id: str) -> None:
    with store.answering() as client:
        run, there = client.get_run(run_id), client.get_run(stand_in)
    store.add_params(stand_in, run.data.params)
    tags = {name: value for name, value in run.data.tags.items() if not name.startswith(_OWN_TAGS)}
    note = f"Stands for [{run.info.run_name}](#/experiments/{store.experiment_id}/runs/{run_id}) of "
    note += f"{run.data.tags.get('sweep', 'another command')}: its model, figures and losses are there."
    store.add_tags(stand_in, {**tags, NOTE_TAG: note})
    known, when = there.data.metrics, time.time_ns() // 1_000_000
    news = {name: value for name, value in run.data.metrics.items() if known.get(name) != value}
    store.add_metrics(stand_in, [MetricPoint(name, value, 0, when) for name, value in news.items()])
    with store.answering() as client:
        if run.info.status in ("FINISHED", "FAILED", "KILLED"):
            client.set_terminated(stand_in, run.info.status)
        else:
            client.update_run(stand_in, status=run.info.status)
