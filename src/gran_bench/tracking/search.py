"""Runs by name, key or id, as folders and the store know them: nothing is made or changed there."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

import gran_bench
from gran_bench.config.rules import ConfigError
from gran_bench.tracking.names import shown_name
from gran_bench.tracking.store import DATABASE, QUIET, TrackingError, database_uri, has_store, server_uri, shown_uri

if TYPE_CHECKING:
    from mlflow.entities import Run as MlflowRun

SUMMARY, CONFIG = "summary.json", "config.json"  # a finished run has the first, any run the second
CLONE = Path(gran_bench.__file__).resolve().parents[2] / "results"  # with the records that ship
_MOST_RUNS = 50_000  # that MLflow finds at once


class RunError(ConfigError):
    """A run that is not there, or not fit for what it is named for; the message names it and the remedy."""


def is_run(folder: Path) -> bool:
    """Whether a folder holds a run, finished or not."""
    return (folder / SUMMARY).is_file() or (folder / CONFIG).is_file()


def find_run(word: str, root: Path, cases: Iterable[Path] = (), beginnings: bool = True) -> Path:
    """The folder of the run, or the file of the case, that a word names.

    Args:
        word: a run's folder; its name as the folder or the UI spells it, its key, its id in MLflow; the name of a case;
            or the beginning of one of these.
        root: of the results.
        cases: files that may be meant as well.
        beginnings: whether the beginning of a name will do; that of an id always does.

    Raises:
        RunError: nothing of the name (with names that are near), or several things.
        TrackingError: the word may be an id, and the store does not answer.
    """
    if is_run(Path(word)):
        return Path(word)
    folders = (path for place in (CLONE, root, root / "evaluations", root / "runs") for path in sorted(place.glob("*")))
    runs = {path.resolve(): path for path in folders if is_run(path)}.values()
    names = {path: (path.name, shown_name(path.name), path.name.rpartition("-")[2]) for path in runs}
    names |= {path: (path.name, path.stem) for path in cases}
    found = [path for path, its in names.items() if word in its]
    if beginnings and not found:
        found = [path for path, its in names.items() if any(name.startswith(word) for name in its)]
    if not found and re.fullmatch("[0-9a-f]{4,32}", word):
        here = {path.name: path for path in runs}
        for run in stored_runs(root):
            if run.info.run_id.startswith(word):
                folder = Path(run.data.tags.get("folder", run.info.run_name))
                found.append(here.get(folder.name, folder))
        if len(found) == 1 and not is_run(found[0]):
            raise RunError(f"{word}: the files of this run, {found[0].name!r}, are not in {root}; give a folder")
    if len(found) > 1:
        raise RunError(f"{word}: this is the beginning of {', '.join(map(str, found))}; give more of one, or a path")
    if not found:
        every = {name: path.name for path, its in names.items() for name in its}
        near = [name for name in every if word in name] or get_close_matches(word, every, 8, 0.4) or [*every][:24]
        near = ", ".join(dict.fromkeys(map(every.get, near))) or "none yet"
        what = "run or case has this name, id or path" if cases else "run has this name, id or folder"
        raise RunError(f"{word}: no {what} in {root}; there are {near}")
    return found[0]


def stored_runs(root: Path) -> list[MlflowRun]:
    """The runs of all experiments of a results folder, the latest first, as MLflow describes them.

    Raises:
        TrackingError: the store does not answer.
    """
    if not has_store(root):
        return []
    os.environ.update(QUIET)
    try:
        from mlflow import MlflowClient

        client = MlflowClient(server_uri() or database_uri(str(root.resolve() / DATABASE)))
        experiments = [experiment.experiment_id for experiment in client.search_experiments()]
        return client.search_runs(experiments, max_results=_MOST_RUNS)
    except Exception as error:  # of any kind: MLflow lets those of SQLAlchemy through
        reason = shown_uri(f"{type(error).__name__}: {error}".splitlines()[0])[:300]
        raise TrackingError(f"the tracking store of {root} does not answer: {reason}; name a run's folder") from error
