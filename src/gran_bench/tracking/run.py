"""A run as its user sees it: it takes metrics, tags and files, and the store never costs a result.

What the store does not take (it is locked, or has vanished) waits in memory while the run goes on, is kept in a file
when the run ends, is said in one clear error, and is sent when the next run opens.
"""

import json
import os
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from gran_bench.files import write_text
from gran_bench.tracking.names import HEADLINE, three_figures
from gran_bench.tracking.store import MetricPoint, Store, TrackingError, legal_name

ENDINGS = ("FINISHED", "FAILED", "KILLED")
FLUSH_SECONDS = 5.0  # between batches of metrics; one metric costs 4 ms, a batch hardly more
FLUSH_METRICS = 900
RETRY_SECONDS = 60.0  # after a store that did not answer; MLflow waits 20 s for a locked one


@dataclass
class Backlog:
    """What has not reached the store, oldest first; ``status`` is how the run ended, None while it goes on."""

    metrics: list[MetricPoint] = field(default_factory=list)
    tags: dict[str, str] = field(default_factory=dict)
    # Path of the file, from the store's root in a kept record, and folder in the artifacts or None.
    artifacts: list[tuple[str, str | None]] = field(default_factory=list)
    datasets: list[tuple[str, str, str, dict[str, Any]]] = field(default_factory=list)  # of ``Store.add_dataset``
    status: str | None = None


class Run:
    """An open run in a store, or one that records nothing; what a ``resumed`` one has logged before is not repeated."""

    def __init__(self, store: Store | None = None, run_id: str | None = None, resumed: bool = False) -> None:
        self.run_id, self._store, self._resumed = run_id, store, resumed
        self._backlog, self._finished = Backlog(), store is None
        self._next_flush, self._failing = time.monotonic() + FLUSH_SECONDS, False
        self._history: dict[str, dict[int, str]] = {}

    def log_metrics(self, metrics: Mapping[str, float], step: int = 0, supersede: bool = False) -> None:
        """Record scalars of one step, by names in which / makes groups; they reach the store in batches.

        In a run that goes on, a step that the store has already is left as it is, so that all that should be there can
        be logged again and fills what a kill has left out. With ``supersede`` a value that differs from the one at the
        same step takes its place in what the UI shows, not in the history: for figures that were found anew. Headline
        figures are rounded to three figures.
        """
        if self._store is None:
            return
        now = int(1000 * time.time())
        for name, value in metrics.items():
            shown = three_figures(value) if name.startswith(HEADLINE) else float(value)
            self._backlog.metrics.append(MetricPoint(legal_name(name), shown, int(step), now, supersede))
        # A store that fails makes each attempt wait: however much has gathered, it is tried again after a while only.
        full = len(self._backlog.metrics) >= FLUSH_METRICS and not self._failing
        if full or time.monotonic() >= self._next_flush:
            self.flush()

    def log_artifact(self, path: Path | str, folder: str | None = None) -> None:
        """Copy a file into the run's artifacts, into ``folder`` there; one that is missing is a warning."""
        if self._store is not None and not Path(path).is_file():
            print(f"warning: {path} is not there to be recorded", file=sys.stderr)
            return
        self._backlog.artifacts.append((str(Path(path).resolve()), folder))
        self.flush()

    def log_dataset(self, name: str, digest: str, source: str, facts: Mapping[str, Any] | None = None) -> None:
        """Record which data the run used, so that the UI shows them with their digest."""
        self._backlog.datasets.append((name, digest, str(source), dict(facts or {})))
        self.flush()

    def set_tag(self, name: str, value: object) -> None:
        """Set a tag."""
        self._backlog.tags[name] = str(value)

    def flush(self) -> None:
        """Send what waits."""
        try:
            self.send()
            self._next_flush, self._failing = time.monotonic() + FLUSH_SECONDS, False
        except TrackingError as error:
            # The run is worth more than its record: it goes on, and the record is tried again.
            self._next_flush, self._failing = time.monotonic() + RETRY_SECONDS, True
            print(f"warning: {error}; will try again", file=sys.stderr)

    def finish(self, status: str = "FINISHED") -> None:
        """Close the run as ``FINISHED``, ``FAILED`` or ``KILLED``."""
        if status not in ENDINGS:
            raise ValueError(f"status={status!r}; choose one of {', '.join(ENDINGS)}")
        if self._finished:
            return
        self._finished, self._backlog.status = True, status
        try:
            self.send()
        except TrackingError as error:
            root, kept = self._store.root, self._store.unsent / f"{self.run_id}.json"
            # The results folder may be moved until then.
            self._backlog.artifacts = [(os.path.relpath(path, root), place) for path, place in self._backlog.artifacts]
            told = f"is in {kept} and is sent when the next run opens"
            try:
                write_text(kept, json.dumps(asdict(self._backlog)))
            except OSError as second:
                told = f"could not be kept in {kept} either: {second}"
            raise TrackingError(
                f"{error}. The results are safe in the run's folder; what the store misses {told}"
            ) from error

    def send(self) -> None:
        """Send the backlog; what was sent leaves it, so that a failure in the middle repeats nothing."""
        waiting, store = self._backlog, self._store
        if store is None:
            return
        if self._resumed:
            waiting.metrics = [point for point in waiting.metrics if not self._is_known(point)]
        while waiting.metrics:
            sent = waiting.metrics[: store.add_metrics(self.run_id, waiting.metrics)]
            del waiting.metrics[: len(sent)]
            for point in sent if self._resumed else ():
                self._history[point.name][point.step] = repr(point.value)
        if waiting.tags:
            store.add_tags(self.run_id, waiting.tags)
            waiting.tags.clear()
        while waiting.datasets:
            store.add_dataset(self.run_id, *waiting.datasets[0])
            del waiting.datasets[0]
        while waiting.artifacts:
            path, folder = waiting.artifacts[0]
            if (store.root / path).is_file():  # a kept record may name a file that is long gone
                store.add_artifact(self.run_id, str(store.root / path), folder)
            del waiting.artifacts[0]
        if waiting.status:
            store.client.set_terminated(self.run_id, waiting.status)
            waiting.status = None

    def _is_known(self, point: MetricPoint) -> bool:
        """Whether the store has the point's step already, from an earlier life or this one; one query a metric."""
        if point.name not in self._history:
            history = self._store.client.get_metric_history(self.run_id, point.name)
            ordered = sorted(history, key=lambda one: one.timestamp)
            self._history[point.name] = {one.step: repr(one.value) for one in ordered}
        there = self._history[point.name].get(point.step)
        # By its text, because a NaN does not equal itself.
        return there is not None and not (point.supersedes and there != repr(point.value))


def send_kept(store: Store) -> None:
    """Send what earlier runs could not, and close them as they ended; what can't be sent is told and stays."""
    for path in sorted(store.unsent.glob("*.json")):
        try:
            kept = json.loads(path.read_text("utf-8"))
            run = Run(store, path.stem, resumed=True)
            run._backlog = Backlog(**kept | {"metrics": [MetricPoint(*point) for point in kept["metrics"]]})
            run.send()
        except (TrackingError, ValueError, TypeError, KeyError) as error:
            # Its run may be gone with an older store; that must not keep all later runs from being recorded.
            print(f"warning: {path} could not be sent ({error}); delete it if its run is gone", file=sys.stderr)
            continue
        path.unlink()
