"""The store itself: first starts at once make it together, and nothing is lost when it fails."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import stored_runs
from mlflow import MlflowClient
from mlflow.exceptions import MlflowException
from stored_runs import client, only_run, runs

from gran_bench.config import TrackingConfig
from gran_bench.tracking import Store, TrackingError, open_run
from gran_bench.tracking.store import DATABASE

# SQLAlchemy's word to MLflow, which a user never sees either.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

# Fixtures.
template, config = stored_runs.template, stored_runs.config


# ---- first starts at once ------------------------------------------------------------------------------------

FIRST_START = """
import sys
from gran_bench.config import TrackingConfig
from gran_bench.tracking import open_run
with open_run(TrackingConfig(root=sys.argv[1]), "run" + sys.argv[2], sys.argv[2], {}) as run:
    run.log_metrics({"loss": 1.0}, 0)
"""


@pytest.mark.slow
def test_first_starts_at_once_do_not_crash_each_other(tmp_path: Path):
    sources = str(Path(__file__).parents[1] / "src")
    starts = [
        subprocess.Popen(
            [sys.executable, "-c", FIRST_START, str(tmp_path), str(i)],
            env=os.environ | {"PYTHONPATH": sources},
            stderr=subprocess.PIPE,
            text=True,
        )
        for i in range(2)
    ]
    complaints = [process.communicate(timeout=120)[1] for process in starts]
    assert [process.returncode for process in starts] == [0] * 2, complaints
    assert complaints == [""] * 2
    found = runs(TrackingConfig(root=str(tmp_path)))
    assert sorted(run.info.run_name for run in found) == ["run0", "run1"]
    assert {run.info.status for run in found} == {"FINISHED"}


# ---- a store that fails --------------------------------------------------------------------------------------


@pytest.fixture
def own(template: Path, tmp_path: Path) -> TrackingConfig:
    """A store of the test's own, which it may break."""
    root = tmp_path / "results"
    root.mkdir()
    (root / DATABASE).write_bytes((template / DATABASE).read_bytes())
    return TrackingConfig(experiment="own", root=str(root))


def test_a_vanished_store_is_told_and_the_record_is_kept_and_sent_later(
    own: TrackingConfig, tmp_path: Path, capsys: pytest.CaptureFixture
):
    database, away = Path(own.root) / DATABASE, tmp_path / "away.db"
    figure = tmp_path / "figure.png"
    figure.write_bytes(b"a picture")

    def first_life() -> None:
        with open_run(own, "lost", "key", {}) as run:
            database.rename(away)
            run.log_metrics({"loss": 0.5}, 3)
            run.log_artifact(figure, "figures")

    with pytest.raises(TrackingError, match=r"mlflow\.db does not answer: the file is gone.*unsent.*next run opens"):
        first_life()
    assert "will try again" in capsys.readouterr().err
    assert not database.exists(), "no empty store may appear in place of the lost one"
    away.rename(database)
    assert only_run(own).info.status == "RUNNING"
    with open_run(own, "another", "another key", {}):
        pass
    found = next(run for run in runs(own) if run.info.run_name == "lost")
    assert found.info.status == "FINISHED"
    assert found.data.metrics["loss"] == 0.5
    stored = Path(own.root) / "artifacts" / found.info.run_id / "artifacts" / "figures" / "figure.png"
    assert stored.read_bytes() == b"a picture"
    assert not list((Path(own.root) / "unsent").iterdir())


def test_a_store_that_is_locked_for_a_while_loses_nothing(
    own: TrackingConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    def locked(self: MlflowClient, *arguments: object, **options: object) -> None:
        # What MLflow raises after waiting 20 s for another writer.
        raise MlflowException("(sqlite3.OperationalError) database is locked")

    with open_run(own, "locked", "key", {}) as run:
        with monkeypatch.context() as patch:
            patch.setattr(MlflowClient, "log_batch", locked)
            run.log_metrics({"loss": 0.5}, 3)
            run.flush()
        assert "database is locked" in capsys.readouterr().err
    assert only_run(own).data.metrics["loss"] == 0.5


def test_a_store_that_fails_is_not_tried_at_every_step(own: TrackingConfig, monkeypatch: pytest.MonkeyPatch):
    tried = []

    def locked(self: MlflowClient, *arguments: object, **options: object) -> None:
        tried.append(1)
        raise MlflowException("(sqlite3.OperationalError) database is locked")

    with open_run(own, "patient", "key", {}) as run:
        with monkeypatch.context() as patch:
            patch.setattr(MlflowClient, "log_batch", locked)
            for step in range(1500):
                run.log_metrics({"loss": 1.0, "norm": 2.0}, step)
        assert len(tried) == 1
    assert len(client(own).get_metric_history(only_run(own).info.run_id, "norm")) == 1500


def test_a_failing_store_does_not_hide_why_the_run_failed(own: TrackingConfig, capsys: pytest.CaptureFixture):
    def life() -> None:
        with open_run(own, "both", "key", {}):
            (Path(own.root) / DATABASE).unlink()
            raise ValueError("the real reason")

    with pytest.raises(ValueError, match="the real reason"):
        life()
    assert "does not answer" in capsys.readouterr().err


def test_a_store_that_is_no_store_is_told_before_any_work(tmp_path: Path):
    (tmp_path / DATABASE).write_bytes(b"this is no database, however long it may be" * 100)
    config = TrackingConfig(root=str(tmp_path))
    with pytest.raises(TrackingError, match=r"mlflow\.db does not answer.*tracking\.enabled=false"):
        Store(config)
    (tmp_path / "file").write_text("")
    with pytest.raises(TrackingError, match=r"tracking\.root"):
        Store(TrackingConfig(root=str(tmp_path / "file" / "results")))


def test_a_missing_figure_is_told_and_costs_nothing(
    config: TrackingConfig, tmp_path: Path, capsys: pytest.CaptureFixture
):
    with open_run(config, "missing", "key", {}) as run:
        run.log_artifact(tmp_path / "none.png")
    assert "none.png is not there" in capsys.readouterr().err
    assert only_run(config).info.status == "FINISHED"


@pytest.mark.parametrize("content", ['{"metrics": [["loss", 1.0, 0, 0]]}', "no record at all"])
def test_a_kept_record_of_no_run_is_told_and_stops_nobody(
    own: TrackingConfig, capsys: pytest.CaptureFixture, content: str
):
    kept = Path(own.root) / "unsent" / "0123456789abcdef.json"
    kept.parent.mkdir()
    kept.write_text(content)
    with open_run(own, "later", "key", {}):
        pass
    assert only_run(own).info.status == "FINISHED"
    assert "0123456789abcdef.json could not be sent" in capsys.readouterr().err
    assert kept.exists()


def test_where_nothing_can_be_kept_either_the_error_is_still_one_of_tracking(own: TrackingConfig):
    finished = []

    def life() -> None:
        with open_run(own, "nowhere", "key", {}) as run:
            (Path(own.root) / DATABASE).unlink()
            (Path(own.root) / "unsent").write_text("a file where the folder should be")
            run.log_metrics({"loss": 1.0}, 0)
            finished.append(True)

    with pytest.raises(TrackingError, match="could not be kept"):
        life()
    assert finished
