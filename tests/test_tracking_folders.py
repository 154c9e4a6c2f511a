"""The results folder under any name and in any place: its store is in it, and what was recorded is found again."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from mlflow import MlflowClient
from mlflow.artifacts import download_artifacts
from mlflow.entities import Run as MlflowRun

from gran_bench.config import TrackingConfig
from gran_bench.tracking import Store, TrackingError, open_run
from gran_bench.tracking.store import DATABASE

# SQLAlchemy's word to MLflow, which a user never sees either.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

# What ends a path in a URI, stands for another letter there, or is a pattern to a shell.
ODD = "what?x=1&y #a%20b 100% [é]"


def recorded(root: Path, name: str = "run", content: bytes = b"a picture") -> str:
    """The id of a run with a figure, recorded under ``root``."""
    figure = root / "runs" / name / "figure.png"
    figure.parent.mkdir(parents=True)
    figure.write_bytes(content)
    with open_run(TrackingConfig(root=str(root)), name, f"key of {name}", {}) as run:
        run.log_artifact(figure, "figures")
        run.log_dataset("drum", "d1", str(root / "data"))
    return run.run_id


def found(root: Path, run_id: str) -> MlflowRun:
    return MlflowClient(Store(TrackingConfig(root=str(root))).uri).get_run(run_id)


def figure_of(root: Path, run_id: str, to: Path) -> bytes:
    """A run's figure, by where MLflow says that it is."""
    to.mkdir(exist_ok=True)
    uri = f"{found(root, run_id).info.artifact_uri}/figures/figure.png"
    return Path(download_artifacts(artifact_uri=uri, dst_path=str(to))).read_bytes()


def test_a_store_lies_in_its_folder_whatever_the_folder_is_called(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    work, parent = tmp_path / "work", tmp_path / "parent"
    work.mkdir()
    monkeypatch.chdir(work)
    root = parent / ODD / "results"
    run_id = recorded(root)
    assert (root / DATABASE).is_file()
    assert [path.name for path in parent.iterdir()] == [ODD], "nothing lies beside the folder"
    assert list(work.iterdir()) == [], "nor where the command runs"
    assert figure_of(root, run_id, tmp_path / "copy") == b"a picture"
    (data,) = found(root, run_id).inputs.dataset_inputs
    assert json.loads(data.dataset.source)["uri"] == (root / "data").as_uri()
    # A second folder whose name begins alike has a store of its own.
    other = recorded(parent / f"{ODD}2" / "results")
    with pytest.raises(Exception, match=f"Run with id={other} not found|Run '{other}' not found"):
        found(root, other)


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A results folder with a finished run in it, and the run's id."""
    root = tmp_path_factory.mktemp("template") / "results"
    return root, recorded(root)


def test_a_moved_folder_is_opened_with_its_runs_and_figures(template: tuple[Path, str], tmp_path: Path):
    root, moved = tmp_path / "results", tmp_path / ODD
    shutil.copytree(template[0], root)
    recorded(root, "second", b"another picture")
    root.rename(moved)
    third = recorded(moved, "third", b"a third")
    assert figure_of(moved, template[1], tmp_path / "copy") == b"a picture"
    assert figure_of(moved, third, tmp_path / "copy") == b"a third"
    assert not root.exists(), "nothing is written where the folder was"


def test_a_copy_keeps_to_itself(template: tuple[Path, str], tmp_path: Path):
    original, run_id = template
    before = {path: path.read_bytes() for path in original.rglob("*") if path.is_file()}
    copy = tmp_path / "copy of results"
    shutil.copytree(original, copy)
    (copy / "artifacts" / run_id / "artifacts" / "figures" / "figure.png").write_bytes(b"the copy's own")
    new = recorded(copy, "new")
    assert figure_of(copy, run_id, tmp_path / "a") == b"the copy's own"
    assert found(copy, new).info.artifact_uri.startswith(copy.as_uri())
    assert {path: path.read_bytes() for path in original.rglob("*") if path.is_file()} == before
    assert figure_of(original, run_id, tmp_path / "b") == b"a picture"


def test_a_run_keeps_its_figures_in_its_folder_while_another_machine_calls_the_folder_otherwise(
    template: tuple[Path, str], tmp_path: Path
):
    root, alias = tmp_path / "results", tmp_path / "mounted"
    shutil.copytree(template[0], root)
    with open_run(TrackingConfig(root=str(root)), "shared", "key", {}) as run:
        # The other machine opens the same database under its own name of the folder.
        shutil.copytree(root, alias)
        Store(TrackingConfig(root=str(alias)))
        shutil.copy(alias / DATABASE, root / "theirs.db")
        (root / DATABASE).write_bytes((root / "theirs.db").read_bytes())
        run.log_artifact(template[0] / "runs" / "run" / "figure.png", "figures")
    assert not (alias / "artifacts" / run.run_id).exists()
    assert figure_of(root, run.run_id, tmp_path / "copy") == b"a picture"


def test_what_a_moved_store_has_missed_is_sent_from_where_it_lies_now(tmp_path: Path):
    root, moved = tmp_path / "results", tmp_path / "moved"
    config = TrackingConfig(root=str(root))
    figure = root / "runs" / "figure.png"

    def life() -> None:
        with open_run(config, "lost", "key", {}) as run:
            figure.parent.mkdir()
            figure.write_bytes(b"a picture")
            (root / DATABASE).rename(tmp_path / "away.db")
            run.log_artifact(figure, "figures")

    with pytest.raises(TrackingError, match="unsent"):
        life()
    (tmp_path / "away.db").rename(root / DATABASE)
    root.rename(moved)
    with open_run(TrackingConfig(root=str(moved)), "next", "next", {}):
        pass
    (kept,) = (moved / "artifacts").rglob("figure.png")
    assert kept.read_bytes() == b"a picture"


def test_an_experiment_of_somebody_elses_with_its_artifacts_elsewhere_is_refused(tmp_path: Path):
    store = Store(TrackingConfig(root=str(tmp_path)))
    MlflowClient(store.uri).create_experiment("theirs", artifact_location="s3://bucket/theirs")
    with pytest.raises(
        TrackingError, match=r"'theirs'.*keeps its artifacts in s3://bucket/theirs.*tracking\.experiment"
    ):
        Store(TrackingConfig(root=str(tmp_path), experiment="theirs"))


# ---- the UI, as it is typed ----------------------------------------------------------------------------------


@contextmanager
def served(root: Path) -> Iterator[str]:
    """The address of a UI on a store, by a process that is ended with the block."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    sources = str(Path(__file__).parents[1] / "src")
    start = f"from gran_bench.tracking import ui; ui({str(root)!r}, {port})"
    process = subprocess.Popen(
        [sys.executable, "-c", start], env=os.environ | {"PYTHONPATH": sources}, stderr=subprocess.PIPE, text=True
    )
    try:
        for line in process.stderr:
            if "the runs, best first" in line:
                break
        yield f"http://127.0.0.1:{port}"
    finally:
        process.kill()
        process.communicate()


def answered(address: str) -> bytes:
    """What a server that has just been started says."""
    patience = time.monotonic() + 60.0
    while True:
        try:
            with urllib.request.urlopen(address, timeout=60.0) as answer:
                return answer.read()
        except ConnectionError as error:
            if time.monotonic() > patience:
                raise error from None
        except urllib.error.URLError as error:
            if time.monotonic() > patience or not isinstance(error.reason, ConnectionError):
                raise
        time.sleep(0.2)


def test_the_ui_shows_the_figures_of_a_moved_folder_with_an_odd_name(template: tuple[Path, str], tmp_path: Path):
    moved = tmp_path / ODD
    shutil.copytree(template[0], moved)
    with served(moved) as address:
        figure = answered(f"{address}/get-artifact?path=figures%2Ffigure.png&run_uuid={template[1]}")
    assert figure == b"a picture"
