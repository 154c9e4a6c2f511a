"""Where runs are recorded: on the server that ``MLFLOW_TRACKING_URI`` names, else in the results folder's database."""

from __future__ import annotations

import os
import re
import sqlite3
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

from gran_bench.config import TrackingConfig

DATABASE = "mlflow.db"
ARTIFACTS = "artifacts"
SERVER = "MLFLOW_TRACKING_URI"  # MLflow's own variable

_LOCK_SECONDS = 20.0  # that a locked database is waited for, as MLflow does


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
