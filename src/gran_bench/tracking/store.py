"""The tracking store, shared by any number of processes: a database under the results folder, or a server.

MLflow is imported when a store is opened: a run without tracking never waits for it. Beside this file only
`user_interface` imports it, to serve what is stored.
"""

from __future__ import annotations

import importlib
import json
import logging
import os
import re
import shlex
import shutil
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote, urlsplit

from gran_bench.config import TrackingConfig
from gran_bench.files import locked, whole_file
from gran_bench.tracking.views import VIEW_TAG, experiment_tags

if TYPE_CHECKING:
    from mlflow.entities import Run as MlflowRun

DATABASE = "mlflow.db"
ARTIFACTS = "artifacts"
SERVER = "MLFLOW_TRACKING_URI"  # MLflow's own variable
KEY_TAG = "gran_bench.key"
UNSENT = "unsent"  # folder below the store's root
PARENT_TAG = "mlflow.parentRunId"
SWEEP_TAG = "sweep"  # folder of the sweep; a child names all that have it, so that the UI can search by it
SWEEP_SEPARATOR = ", "

# MLflow reads these when it is imported. Nobody is told of its use, and the terminal belongs to the run.
QUIET = {
    **{"MLFLOW_DISABLE_TELEMETRY": "true", "DO_NOT_TRACK": "true"},
    **{"MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR": "false", "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true"},
}
# A server that does not answer is asked three times in six seconds, not eight times in four minutes.
_PATIENCE = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2"}

_LOCK_SECONDS = 20.0  # that a locked database is waited for, as MLflow does
_METRICS_A_REQUEST = 900  # MLflow takes 1000
_PARAMS_A_REQUEST = 100
_LONGEST_VALUE = 5000  # characters of a parameter or tag
_LONGEST_DIGEST = 36
_MOST_RUNS = 50_000  # that MLflow finds at once

# The files that this process opened under each name of a database, by device and number; None while one is opened.
_opened: dict[Path, list[tuple[int, int] | None]] = {}


class TrackingError(RuntimeError):
    """The tracking store cannot be used; the message names it and the remedy."""


class MetricPoint(NamedTuple):
    """One value of a metric, logged at ``when`` (ms since 1970).

    One that ``supersedes`` takes the place of another value at the same step; else the first one stays.
    """

    name: str
    value: float
    step: int
    when: int
    supersedes: bool = False


def legal_name(name: str) -> str:
    """The name of a metric with _ for every character that MLflow refuses."""
    return re.sub(r"[^\w\-.: /]", "_", name, flags=re.ASCII)


def _hush() -> ModuleType:
    """MLflow, which reads the environment when it is loaded, and says warnings alone."""
    os.environ.update(QUIET | {name: os.environ.get(name, value) for name, value in _PATIENCE.items()})
    mlflow = importlib.import_module("mlflow")  # which sets levels of its own
    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)
    return mlflow


class Client:
    """MLflow's `MlflowClient`, each of whose calls is made under a guard that turns what it raises into one error."""

    def __init__(self, uri: str, guard: Callable[[], AbstractContextManager[None]]) -> None:
        self._guard, mlflow = guard, _hush()
        with guard():
            self._client = mlflow.MlflowClient(tracking_uri=uri)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        call = getattr(self._client, name)

        def guarded(*arguments: Any, **options: Any) -> Any:
            with self._guard():
                return call(*arguments, **options)

        return guarded


class Store:
    """The database or the server, the experiment and its artifacts, made by whoever comes first.

    A store that cannot be made or opened is a `TrackingError`.
    """

    def __init__(self, config: TrackingConfig) -> None:
        self.root = Path(config.root).resolve()
        self.server = server_uri()
        self.database = self.root / DATABASE  # where there is no server
        # Of the first file of that name that this process opens.
        self.uri = self.server or database_uri(str(self.database))
        self.artifacts_uri = (self.root / ARTIFACTS).as_uri()
        self._identity: tuple[int, int] | None = None
        # Several first starts at once crash each other while they make the tables.
        with self.alone():
            if self.server is None and not self.database.exists():
                self._make_database()
            self.client = Client(self.server or database_uri(self._spelling()), self._answers)
            if self.server is None:
                with self._answers():
                    follow_folder(self.database, self.artifacts_uri)
            self.experiment_id = self._experiment(config.experiment)
            if self.server is None:
                self._identity = _opened[self.database][-1] = self._file_identity()

    @property
    def shown(self) -> str:
        """The store for people: its file, or its"""
        return str(self.database) if self.server is None else shown_uri(self.server)

    @property
    def unsent(self) -> Path:
        """The folder of what this store has not taken yet; each server has one of its own."""
        return self.root / UNSENT / ("" if self.server is None else quote(self.shown, safe=""))

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Hold the lock of the store, for what two processes must not do at once."""
        try:
            with locked(self.root / ".locks" / "mlflow.lock"):
                yield
        except OSError as error:
            raise TrackingError(self._complaint(error.strerror or str(error))) from error

    def _make_database(self) -> None:
        """Make a new database, whole or not there: MLflow opens none that a kill left with a part of its tables."""
        _hush()
        from mlflow.store.db.utils import _initialize_tables, create_sqlalchemy_engine

        with self._answers(), whole_file(self.database) as temporary:
            _initialize_tables(engine := create_sqlalchemy_engine(database_uri(str(temporary))))
            engine.dispose()

    def _find(self, condition: str, most: int) -> list[MlflowRun]:
        return self.client.search_runs([self.experiment_id], condition, max_results=most)

    def run_of(self, key: str) -> MlflowRun | None:
        """The latest run that was opened under a key."""
        return next(iter(self._find(f"tags.`{KEY_TAG}` = '{key}'", 1)), None)

    def running(self) -> list[MlflowRun]:
        """The runs that are ``RUNNING`` by their status."""
        return self._find("attributes.status = 'RUNNING'", _MOST_RUNS)

    def status_of(self, run_id: str) -> str:
        """``SCHEDULED``, ``RUNNING``, ``FINISHED``, ``FAILED`` or ``KILLED``."""
        return self.client.get_run(run_id).info.status

    def create_run(
        self, name: str, key: str, parent: str | None, status: str = "RUNNING", tags: Mapping[str, str] | None = None
    ) -> str:
        """Make a run under a key; returns its id."""
        tags = {KEY_TAG: key} | dict(tags or {}) | (self._tags_of_child(parent) if parent else {})
        run_id = self.client.create_run(self.experiment_id, tags=tags, run_name=name).info.run_id
        if status != "RUNNING":
            self.client.update_run(run_id, status=status)
        return run_id

    def adopt_run(self, run_id: str, parent: str) -> None:
        """Put a run under a parent, unless it has another one that is there; its tag names all its sweeps."""
        there = self.client.get_run(run_id).data.tags
        tags, present = self._tags_of_child(parent), there.get(PARENT_TAG)
        if present is not None and self._there(present):
            tags[PARENT_TAG] = present
        sweeps = [*there.get(SWEEP_TAG, "").split(SWEEP_SEPARATOR), tags.get(SWEEP_TAG, "")]
        tags[SWEEP_TAG] = SWEEP_SEPARATOR.join(dict.fromkeys(filter(None, sweeps)))
        self.add_tags(run_id, {name: value for name, value in tags.items() if value and there.get(name) != value})

    def runs_by_key(self) -> dict[str, MlflowRun]:
        """The latest run of each key."""
        return {run.data.tags.get(KEY_TAG, ""): run for run in reversed(self._find("", _MOST_RUNS))}

    def add_ended_run(
        self, name: str, key: str, params: Mapping[str, str], metrics: Mapping[str, float], tags: Mapping[str, str],
        ended: int, status: str = "FINISHED",
    ) -> str:  # fmt: skip
        """Record a run that was made elsewhere and ended at ``ended`` (ms since 1970); returns its id."""
        from mlflow.entities import Metric, Param

        run_id = self.client.create_run(self.experiment_id, ended, {KEY_TAG: key, **tags}, name).info.run_id
        values = [Metric(legal_name(figure), value, ended, 0) for figure, value in metrics.items()]
        self.client.log_batch(run_id, values, [Param(param, value) for param, value in params.items()])
        self.client.set_terminated(run_id, status, ended)
        return run_id

    def reopen_run(self, run_id: str, name: str, without: Sequence[str], status: str = "RUNNING") -> None:
        """Mark a run as running again, or as waiting to, and remove the tags that say how it ended."""
        self.client.update_run(run_id, status=status, name=name)
        for tag in set(without) & set(self.client.get_run(run_id).data.tags):
            self.client.delete_tag(run_id, tag)

    def _there(self, run_id: str) -> list[MlflowRun]:
        """The run of an id, if it was not deleted."""
        return self._find(f"attributes.run_id = '{run_id}'", 1)

    def _tags_of_child(self, parent: str) -> dict[str, str]:
        """Its parent's id, and the name of its sweep."""
        tags = {PARENT_TAG: parent}
        for run in self._there(parent):
            tags |= {name: value for name, value in run.data.tags.items() if name == SWEEP_TAG and value}
        return tags

    def dress_experiment(self) -> None:
        """Give the experiment what the UI starts with, as of this version; what a user has written stays."""
        there = self.client.get_experiment(self.experiment_id).tags
        for name, value in experiment_tags().items():
            if name not in there or (name == VIEW_TAG and there[name] != value):
                self.client.set_experiment_tag(self.experiment_id, name, value)

    def add_params(self, run_id: str, params: Mapping[str, str]) -> dict[str, str]:
        """Record the parameters that are new; returns those that differ from what the run has, which MLflow keeps."""
        from mlflow.entities import Param

        wanted = {name: value[:_LONGEST_VALUE] for name, value in params.items()}
        there = self.client.get_run(run_id).data.params
        new = [Param(name, value) for name, value in wanted.items() if name not in there]
        for first in range(0, len(new), _PARAMS_A_REQUEST):
            self.client.log_batch(run_id, params=new[first : first + _PARAMS_A_REQUEST])
        return {name: value for name, value in wanted.items() if there.get(name, value) != value}

    def add_metrics(self, run_id: str, points: Sequence[MetricPoint]) -> int:
        """Record the first points, as many as a request takes; returns how many."""
        from mlflow.entities import Metric

        batch = [Metric(point.name, point.value, point.when, point.step) for point in points[:_METRICS_A_REQUEST]]
        self.client.log_batch(run_id, metrics=batch)
        return len(batch)

    def add_tags(self, run_id: str, tags: Mapping[str, str]) -> None:
        """Set tags."""
        from mlflow.entities import RunTag

        self.client.log_batch(run_id, tags=[RunTag(name, value[:_LONGEST_VALUE]) for name, value in tags.items()])

    def add_artifact(self, run_id: str, path: str, folder: str | None) -> None:
        """Copy a file into the run's artifacts."""
        if self.server is not None:
            self.client.log_artifact(run_id, path, folder)
            return
        # Into this folder, whatever the database says by now: a machine that has the folder under another name may
        # have opened it meanwhile.
        place = self.root / ARTIFACTS / run_id / ARTIFACTS / (folder or "") / Path(path).name
        with self._answers(), whole_file(place) as temporary:
            shutil.copyfile(path, temporary)

    def add_dataset(self, run_id: str, name: str, digest: str, source: str, facts: Mapping[str, Any]) -> None:
        """Say which data a run used."""
        from mlflow.entities import Dataset, DatasetInput, InputTag

        uri, profile = json.dumps({"uri": Path(source).resolve().as_uri()}), json.dumps(dict(facts), default=str)
        dataset = Dataset(name, digest[:_LONGEST_DIGEST], "local", uri, profile=profile)
        self.client.log_inputs(run_id, [DatasetInput(dataset, [InputTag("mlflow.data.context", "training")])])

    def _experiment(self, name: str) -> str:
        experiment = self.client.get_experiment_by_name(name)
        if experiment is None:
            try:
                location = self.artifacts_uri if self.server is None else None
                return self.client.create_experiment(name, artifact_location=location)
            except TrackingError:
                # Another machine was faster on the server.
                experiment = self.client.get_experiment_by_name(name)
                if experiment is None:
                    raise
        refused = ""
        if experiment.lifecycle_stage == "deleted":
            refused = f"was deleted in {self.shown}"
        elif self.server is None and experiment.artifact_location != self.artifacts_uri:
            place = experiment.artifact_location
            refused = f"in {self.shown} keeps its artifacts in {place}, outside of this folder"
        if refused:
            raise TrackingError(f"the experiment {name!r} {refused}; choose another tracking.experiment")
        return experiment.experiment_id

    def _spelling(self) -> str:
        """The database's path, spelt anew where another file has taken its name.

        MLflow keeps a database open for the life of a process, by the letters of its URI, the file gone or not.
        """
        files = _opened.setdefault(self.database, [])
        if not files or files[-1] not in (self._file_identity(), None):
            files.append(None)
        return "/." * (len(files) - 1) + str(self.database)

    @contextmanager
    def _answers(self) -> Iterator[None]:
        """Talk to the database; whatever it answers wrongly becomes one clear error."""
        if self._identity is not None and self._file_identity() != self._identity:
            # SQLite would go on writing to a file that has no name any more.
            raise TrackingError(self._complaint("the file is gone or was replaced since the run began"))
        try:
            yield
        except Exception as error:
            # Of any kind: MLflow lets those of SQLAlchemy and of its own lookups through, and none may cost a result.
            if "out-of-date database schema" in str(error):
                raise TrackingError(
                    f"the tracking store {self.database} was made by another version of MLflow; copy it, then "
                    f"upgrade it by `python -m mlflow db upgrade {shlex.quote(self.uri)}`, which takes older ones, "
                    "or choose another tracking.root (tracking.enabled=false does without)"
                ) from error
            lines = [line for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
            raise TrackingError(self._complaint(shown_uri(lines[0])[:300])) from error

    def _complaint(self, reason: str) -> str:
        what, remedy = "store", "close what holds it, free space or choose another tracking.root"
        if self.server is not None:
            what, remedy = "server", f"start it, or unset {SERVER} to record in {self.root}"
        told = f"the tracking {what} {self.shown} does not answer: {reason}; {remedy}"
        return f"{told} (tracking.enabled=false does without)"

    def _file_identity(self) -> tuple[int, int]:
        try:
            found = self.database.stat()
        except OSError:
            return 0, 0
        return found.st_dev, found.st_ino


def _named() -> str:
    return os.environ.get(SERVER, "").strip()


def server_uri() -> str | None:
    """The server that the environment names; None where it names none."""
    return _named().rstrip("/") if urlsplit(_named()).scheme in ("http", "https") else None


def shown_uri(text: str) -> str:
    """A server's address, or a text with one, as it may be printed: without user and password."""
    return re.sub(r"(?<=://)[^/@\s]*@", "", text)


def has_store(root: Path) -> bool:
    """Whether there is a store for a results folder: the server, or the folder's database."""
    return server_uri() is not None or (root / DATABASE).exists()


def said_place(config: TrackingConfig) -> str | None:
    """A line that says where runs are recorded, if the environment names a place; None where it names none."""
    database, shown = Path(config.root).resolve() / DATABASE, shown_uri(_named())
    if _named() in ("", f"sqlite:///{database}", database_uri(str(database))):
        return None
    if server_uri() is None:
        return (
            f"{SERVER}={shown} is not used, for it is no server (http:// or https://); runs are recorded in {database}"
        )
    return f"runs are recorded on {shown}, as {SERVER} says; their files are in {database.parent}"


def database_uri(path: str) -> str:
    """The URI of an SQLite database at an absolute path; SQLAlchemy quotes what would end the path, such as ``?``."""
    from sqlalchemy.engine import URL

    # With its driver named, MLflow does not take the quoted path for that of a folder to make.
    return URL.create("sqlite+pysqlite", database=path).render_as_string()


def follow_folder(database: Path, artifacts_uri: str) -> None:
    """Let a database name the artifacts beside it, where its folder was moved or copied since it was written.

    One transaction: any other process sees the old names or the new ones.
    """
    moved = (
        "UPDATE experiments SET artifact_location = :here "
        f"WHERE artifact_location LIKE 'file:%/{ARTIFACTS}' AND artifact_location <> :here",
        f"UPDATE runs SET artifact_uri = :here || '/' || run_uuid || '/{ARTIFACTS}' "
        f"WHERE artifact_uri LIKE 'file:%/{ARTIFACTS}/' || run_uuid || '/{ARTIFACTS}' "
        f"AND artifact_uri <> :here || '/' || run_uuid || '/{ARTIFACTS}'",
    )
    with closing(sqlite3.connect(database, timeout=_LOCK_SECONDS)) as store, store:
        for update in moved:
            store.execute(update, {"here": artifacts_uri})
