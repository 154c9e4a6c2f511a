"""Runs in MLflow: one SQLite store under the results folder, opened once and shared by any number of processes.

The store must never cost a result. What cannot be recorded (a locked or vanished store) waits in memory while the
run goes on, is kept in a file when the run ends, is said in one clear error, and is sent when the next run opens.
This is the only file that knows MLflow.
"""

from __future__ import annotations

import json
import logging
import math
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gran_bench.atomic import locked, write_text
from gran_bench.config import TrackingConfig

if TYPE_CHECKING:
    from mlflow import MlflowClient

DATABASE = "mlflow.db"
ARTIFACTS = "artifacts"
UNSENT = "unsent"
KEY_TAG = "gran_bench.key"
ENDED_TAG = "ended_by"  # what ended a run that did not finish
FLUSH_SECONDS = 5.0  # between batches of metrics; one log_metric costs 4 ms, a batch hardly more
RETRY_SECONDS = 60.0  # after a store that did not answer; MLflow waits 20 s for a locked one
_BATCH = 900  # metrics a request; MLflow takes 1000
_PARAMS_A_REQUEST = 100
_LONGEST_VALUE = 5000  # characters of a parameter or tag
_ILLEGAL = re.compile(r"[^\w\-.: /]", re.ASCII)  # in the name of a metric
_CLOSED = {"FINISHED", "FAILED", "KILLED"}


class TrackingError(RuntimeError):
    """The tracking store cannot be used; the message names it and the remedy, and says where the record is kept."""


@dataclass
class _Backlog:
    """What has not reached the store."""

    metrics: list[tuple[str, float, int, int]] = field(default_factory=list)  # name, value, step, ms since 1970
    tags: dict[str, str] = field(default_factory=dict)
    artifacts: list[tuple[str, str | None]] = field(default_factory=list)  # path, folder
    status: str | None = None

    def __bool__(self) -> bool:
        return bool(self.metrics or self.tags or self.artifacts or self.status)


class Run:
    """A run that does nothing: the interface, and what disabled tracking uses."""

    run_id: str | None = None

    def log_metrics(self, metrics: Mapping[str, float], step: int = 0) -> None:
        """Record scalars of one step; they reach the store in batches, by names in which / makes groups."""

    def log_artifact(self, path: Path | str, folder: str | None = None) -> None:
        """Copy a file into the run's artifacts, into ``folder`` there."""

    def log_dataset(self, name: str, digest: str, source: str, facts: Mapping[str, Any] | None = None) -> None:
        """Record which data the run used, so that the UI shows them with their digest."""

    def set_tag(self, name: str, value: object) -> None:
        """Set a tag."""

    def flush(self) -> None:
        """Send what waits."""

    def finish(self, status: str = "FINISHED") -> None:
        """Close the run as ``FINISHED``, ``FAILED`` or ``KILLED``."""


class _StoredRun(Run):
    """A run in the store."""

    def __init__(self, store: _Store, run_id: str, resumed: bool) -> None:
        self.run_id, self._store, self._resumed = run_id, store, resumed
        self._backlog, self._finished = _Backlog(), False
        self._next_flush = time.monotonic() + FLUSH_SECONDS
        self._known: dict[str, set[tuple[int, float]]] = {}
        self._kept = store.root / UNSENT / f"{run_id}.json"

    def log_metrics(self, metrics: Mapping[str, float], step: int = 0) -> None:
        now = int(1000 * time.time())
        legal = {_ILLEGAL.sub("_", name): float(value) for name, value in metrics.items()}
        self._backlog.metrics += [(name, value, int(step), now) for name, value in legal.items()]
        if time.monotonic() >= self._next_flush or len(self._backlog.metrics) >= _BATCH:
            self.flush()

    def log_artifact(self, path: Path | str, folder: str | None = None) -> None:
        if not Path(path).is_file():
            raise TrackingError(f"{path} is not there to be recorded")
        self._backlog.artifacts.append((str(Path(path).resolve()), folder))
        self.flush()

    def log_dataset(self, name: str, digest: str, source: str, facts: Mapping[str, Any] | None = None) -> None:
        from mlflow.entities import Dataset, DatasetInput, InputTag

        dataset = Dataset(
            name,
            digest[:36],
            source_type="local",
            source=json.dumps({"uri": str(source)}),
            profile=json.dumps(dict(facts or {}), default=str),
        )
        context = InputTag("mlflow.data.context", "training")
        with self._store.spoken_for():
            self._store.client.log_inputs(self.run_id, [DatasetInput(dataset, [context])])

    def set_tag(self, name: str, value: object) -> None:
        self._backlog.tags[name] = str(value)[:_LONGEST_VALUE]

    def flush(self) -> None:
        try:
            self._send()
            self._next_flush = time.monotonic() + FLUSH_SECONDS
        except TrackingError as error:
            # The run is worth more than its record: it goes on, and the record is tried again.
            self._next_flush = time.monotonic() + RETRY_SECONDS
            print(f"warning: {error}; will try again", file=sys.stderr)

    def finish(self, status: str = "FINISHED") -> None:
        if status not in _CLOSED:
            raise ValueError(f"status={status!r}; choose one of {', '.join(sorted(_CLOSED))}")
        if self._finished:
            return
        self._finished, self._backlog.status = True, status
        try:
            self._send()
        except TrackingError as error:
            write_text(self._kept, json.dumps(asdict(self._backlog)))
            raise TrackingError(
                f"{error}. The results are safe in the run's folder; what the store misses is in {self._kept} and is "
                "sent when the next run opens"
            ) from error

    def _send(self) -> None:
        """Send the backlog in the order metrics, tags, artifacts, status; what was sent leaves it."""
        from mlflow.entities import Metric, RunTag

        waiting, client = self._backlog, self._store.client
        with self._store.spoken_for():
            while waiting.metrics:
                batch = waiting.metrics[:_BATCH]
                fresh = [m for m in batch if not self._is_known(m)]
                if fresh:
                    entities = [Metric(name, value, when, step) for name, value, step, when in fresh]
                    client.log_batch(self.run_id, metrics=entities)
                del waiting.metrics[: len(batch)]
            if waiting.tags:
                client.log_batch(self.run_id, tags=[RunTag(name, value) for name, value in waiting.tags.items()])
                waiting.tags.clear()
            while waiting.artifacts:
                path, folder = waiting.artifacts[0]
                if Path(path).is_file():  # a kept record may name a file that is long gone
                    client.log_artifact(self.run_id, path, folder)
                del waiting.artifacts[0]
            if waiting.status:
                client.set_terminated(self.run_id, waiting.status)
                waiting.status = None

    def _is_known(self, metric: tuple[str, float, int, int]) -> bool:
        """Whether an earlier life of the run logged the same value at the same step."""
        if not self._resumed:
            return False
        name, value, step, _ = metric
        if name not in self._known:
            history = self._store.client.get_metric_history(self.run_id, name)
            self._known[name] = {(m.step, m.value) for m in history}
        return (step, value) in self._known[name] or (
            math.isnan(value) and any(s == step and math.isnan(v) for s, v in self._known[name])
        )


class _Store:
    """The database, its experiment and its artifacts, made by whoever comes first.

    Args:
        config: where.

    Raises:
        TrackingError: the store cannot be made or opened.
    """

    def __init__(self, config: TrackingConfig) -> None:
        self.root = Path(config.root).resolve()
        self.database = self.root / DATABASE
        self.uri = f"sqlite:///{self.database}"
        self.lock = self.root / ".locks" / "mlflow.lock"
        try:
            # Several first starts at once crash each other while they make the tables.
            with locked(self.lock):
                with self.spoken_for(new=True):
                    self.client = _client(self.uri)
                    self.experiment_id = self._experiment(config.experiment)
                self._identity = self._file_identity()
        except OSError as error:
            raise TrackingError(f"{self._place}: {error.strerror or error}; {self._remedy}") from error

    def _experiment(self, name: str) -> str:
        location = (self.root / ARTIFACTS).as_uri()
        experiment = self.client.get_experiment_by_name(name)
        if experiment is None:
            return self.client.create_experiment(name, artifact_location=location)
        if experiment.lifecycle_stage == "deleted":
            raise TrackingError(
                f"the experiment {name!r} was deleted in {self.database}; choose another tracking.experiment"
            )
        if experiment.artifact_location != location:
            raise TrackingError(
                f"the experiment {name!r} in {self.database} keeps its artifacts in {experiment.artifact_location}: "
                "the folder was moved; move it back, or choose another tracking.experiment"
            )
        return experiment.experiment_id

    @contextmanager
    def spoken_for(self, new: bool = False) -> Iterator[None]:
        """Talk to the store; whatever it answers wrongly becomes one clear error."""
        from mlflow.exceptions import MlflowException

        if not new and self._file_identity() != self._identity:
            # SQLite would go on writing to a file that has no name any more.
            raise TrackingError(f"{self._place}: the file is gone or was replaced since the run began")
        try:
            yield
        except TrackingError:
            raise
        except (MlflowException, OSError) as error:
            lines = [line for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
            raise TrackingError(f"{self._place}: {lines[0][:300]}; {self._remedy}") from error
        except Exception as error:
            # SQLAlchemy's errors, which pass through where MLflow makes its tables.
            if not type(error).__module__.startswith("sqlalchemy"):
                raise
            raise TrackingError(f"{self._place}: {str(error).splitlines()[0][:300]}; {self._remedy}") from error

    def _file_identity(self) -> tuple[int, int] | None:
        try:
            found = self.database.stat()
        except OSError:
            return None
        return found.st_dev, found.st_ino

    @property
    def _place(self) -> str:
        return f"the tracking store {self.database} does not answer"

    _remedy = "close what holds it, free space or choose another tracking.root; tracking.enabled=false does without"

    def run_of(self, key: str) -> str | None:
        """The latest run that was opened under a key."""
        found = self.client.search_runs(
            [self.experiment_id], filter_string=f"tags.`{KEY_TAG}` = '{key}'", max_results=1
        )
        return found[0].info.run_id if found else None


@contextmanager
def open_run(
    config: TrackingConfig,
    name: str,
    key: str,
    params: Mapping[str, Any] | object,
    tags: Mapping[str, object] | None = None,
    parent: str | None = None,
) -> Iterator[Run]:
    """Open a run, a new one or the one that the same key has already, and close it with the right status.

    ``FINISHED`` when the block ends, ``KILLED`` on Ctrl-C and SIGTERM, ``FAILED`` on any other exception. A run
    whose process was killed stays ``RUNNING`` until the same key opens it again.

    Args:
        config: where, or that nothing is recorded.
        name: for people.
        key: hash of what determines the result; the same key is the same run.
        params: nested config; recorded with dotted names.
        tags: data digest, commit, hardware, …
        parent: id of the run that this one belongs to.

    Raises:
        TrackingError: the store cannot be opened; or, at the end, something could not be recorded.
    """
    if not config.enabled:
        yield Run()
        return
    with _terminable():
        run = _open(_Store(config), name, key, _dotted(params), dict(tags or {}), parent)
        try:
            yield run
        except BaseException as error:
            killed = isinstance(error, KeyboardInterrupt)
            run.set_tag(ENDED_TAG, f"{type(error).__name__}: {error}")
            try:
                run.finish("KILLED" if killed else "FAILED")
            except TrackingError as second:
                # The first error matters more; the second must not hide it.
                print(f"warning: {second}", file=sys.stderr)
            raise
        run.finish("FINISHED")


def ensure_store(config: TrackingConfig) -> None:
    """Make database and experiment, before jobs start that will use them at once."""
    if config.enabled:
        _Store(config)


def open_parent(config: TrackingConfig, name: str, key: str, params: Mapping[str, Any] | object) -> str | None:
    """The id of a parent run (made where it is missing) that a sweep's runs belong to; None without tracking."""
    if not config.enabled:
        return None
    run = _open(_Store(config), name, key, _dotted(params), {}, None)
    run.finish("FINISHED")
    return run.run_id


def ui(root: Path | str, port: int = 5000, experiment: str = TrackingConfig.experiment) -> None:
    """Become the MLflow UI on the store under ``root``; does not return.

    Raises:
        TrackingError: the store cannot be opened, or the port is taken.
    """
    import socket

    store = _Store(TrackingConfig(experiment=experiment, root=str(root)))
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except (OSError, OverflowError) as error:
            raise TrackingError(
                f"port {port} cannot be used ({error}); is the UI open already? Choose another: make ui PORT={port + 1}"
            ) from error
    print(f"the runs are at http://127.0.0.1:{port} (Ctrl-C ends)", file=sys.stderr, flush=True)
    command = [sys.executable, "-m", "mlflow", "ui", "--backend-store-uri", store.uri]
    command += ["--default-artifact-root", (store.root / ARTIFACTS).as_uri(), "--host", "127.0.0.1"]
    # One worker and no job executor: 2 processes instead of 15.
    command += ["--port", str(port), "--workers", "1"]
    os.execve(sys.executable, command, os.environ | {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"} | _QUIET)


# ---- opening -------------------------------------------------------------------------------------------------


def _open(
    store: _Store, name: str, key: str, params: dict[str, str], tags: dict[str, object], parent: str | None
) -> _StoredRun:
    # Two processes with one key must not both find nothing and make two runs.
    with locked(store.lock), store.spoken_for():
        _send_kept(store)
        run_id = store.run_of(key)
        resumed = run_id is not None
        if run_id is None:
            labels = {KEY_TAG: key} | ({"mlflow.parentRunId": parent} if parent else {})
            run_id = store.client.create_run(store.experiment_id, tags=labels, run_name=name).info.run_id
        else:
            store.client.update_run(run_id, status="RUNNING", name=name)
            if ENDED_TAG in store.client.get_run(run_id).data.tags:
                store.client.delete_tag(run_id, ENDED_TAG)
        changed = _log_params(store.client, run_id, params)
    run = _StoredRun(store, run_id, resumed)
    for label, value in (tags | changed).items():
        run.set_tag(label, value)
    run.flush()
    return run


def _send_kept(store: _Store) -> None:
    """Send what earlier runs could not, and close them as they ended."""
    for path in sorted((store.root / UNSENT).glob("*.json")):
        kept = json.loads(path.read_text("utf-8"))
        run = _StoredRun(store, path.stem, resumed=True)
        metrics = [tuple(metric) for metric in kept["metrics"]]
        run._backlog = _Backlog(metrics, kept["tags"], kept["artifacts"], kept["status"])
        run._send()
        path.unlink()


def _log_params(client: MlflowClient, run_id: str, params: dict[str, str]) -> dict[str, str]:
    """Log the parameters that are new; MLflow never changes one, so a changed one comes back as a tag."""
    from mlflow.entities import Param

    there = client.get_run(run_id).data.params
    new = [Param(name, value) for name, value in params.items() if name not in there]
    for first in range(0, len(new), _PARAMS_A_REQUEST):
        client.log_batch(run_id, params=new[first : first + _PARAMS_A_REQUEST])
    return {f"resumed_with.{name}": value for name, value in params.items() if there.get(name, value) != value}


def _dotted(params: Mapping[str, Any] | object, prefix: str = "") -> dict[str, str]:
    """Nested parameters by dotted name, as text."""
    if is_dataclass(params) and not isinstance(params, type):
        params = asdict(params)
    flat: dict[str, str] = {}
    for name, value in params.items():
        if isinstance(value, Mapping) and value:
            flat |= _dotted(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = str(value)[:_LONGEST_VALUE]
    return flat


# MLflow reads these when it is imported. Nothing leaves the machine, and the terminal belongs to the run.
_QUIET = {"MLFLOW_DISABLE_TELEMETRY": "true", "DO_NOT_TRACK": "true", "MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR": "false"}


def _client(uri: str) -> MlflowClient:
    os.environ.update(_QUIET)
    from mlflow import MlflowClient

    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)
    return MlflowClient(tracking_uri=uri)


@contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM end the block like Ctrl-C, where nobody handles it already; or the run stays RUNNING for ever."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt(signal.Signals(number).name)

    free = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if not free:
        yield
        return
    signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
