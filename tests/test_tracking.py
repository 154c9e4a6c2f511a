"""Runs in the store: what the UI will show, one run through all its lives, and nothing lost when the store fails."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from mlflow import MlflowClient
from mlflow.entities import Run as StoredRun
from mlflow.exceptions import MlflowException

from gran_bench.config import RolloutConfig, TrackingConfig
from gran_bench.tracking import (
    Child,
    Store,
    TrackingError,
    end_child,
    open_run,
    reopen_ended,
    schedule_children,
    ui,
    user_interface,
)
from gran_bench.tracking.store import DATABASE, QUIET

# SQLAlchemy's word to MLflow, which a user never sees either.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The root of a store; making its tables takes a second, so the tests of this module share it."""
    root = tmp_path_factory.mktemp("results")
    Store(TrackingConfig(root=str(root)))
    return root


@pytest.fixture
def config(template: Path, request: pytest.FixtureRequest) -> TrackingConfig:
    """An experiment of the test's own in the shared store."""
    return TrackingConfig(experiment=request.node.name, root=str(template))


def client(config: TrackingConfig) -> MlflowClient:
    return MlflowClient(f"sqlite:///{Path(config.root) / DATABASE}")


def runs(config: TrackingConfig) -> list[StoredRun]:
    store = client(config)
    return store.search_runs([store.get_experiment_by_name(config.experiment).experiment_id])


def only_run(config: TrackingConfig) -> StoredRun:
    (run,) = runs(config)
    return run


# ---- what a run shows ----------------------------------------------------------------------------------------


def test_a_run_shows_params_metrics_tags_data_and_figures(config: TrackingConfig, tmp_path: Path):
    figure = tmp_path / "angle.png"
    figure.write_bytes(b"a picture")
    params = {"seed": 0, "rollout": RolloutConfig(frames=3).__dict__, "speeds": [20.0, 25.0]}
    with open_run(config, "holdout30rpm", "key", params, {"commit": "abc"}) as run:
        run.log_dataset("drum", "d1", "data", {"cases": 6})
        for step in range(3):
            run.log_metrics({"training/loss": 1.0 / (1 + step), "learning_rate": 1e-4}, step)
        run.log_artifact(figure, "figures")
        run.set_tag("data_digest", "d1")
    found = only_run(config)
    assert found.info.status == "FINISHED"
    assert found.info.run_name == "holdout30rpm"
    assert found.data.params["rollout.frames"] == "3"
    assert found.data.params["speeds"] == "[20.0, 25.0]"
    assert found.data.tags["commit"] == "abc"
    assert found.data.tags["data_digest"] == "d1"
    history = client(config).get_metric_history(found.info.run_id, "training/loss")
    assert [(m.step, m.value) for m in history] == [(0, 1.0), (1, 0.5), (2, pytest.approx(1 / 3))]
    (data,) = found.inputs.dataset_inputs
    assert (data.dataset.name, data.dataset.digest) == ("drum", "d1")
    stored = Path(config.root) / "artifacts" / found.info.run_id / "artifacts" / "figures" / "angle.png"
    assert stored.read_bytes() == b"a picture"


def test_many_params_and_metrics_fit(config: TrackingConfig):
    with open_run(config, "many", "key", {f"p{i}": i for i in range(250)}) as run:
        for step in range(500):
            run.log_metrics({f"m{i}": float(step) for i in range(5)}, step)
    found = only_run(config)
    assert len(found.data.params) == 250
    assert len(client(config).get_metric_history(found.info.run_id, "m4")) == 500


def test_metrics_travel_in_batches(config: TrackingConfig, monkeypatch: pytest.MonkeyPatch):
    sent = []
    original = MlflowClient.log_batch

    def counted(self: MlflowClient, *arguments: object, **options: object) -> None:
        sent.append(len(options.get("metrics", ())))
        original(self, *arguments, **options)

    monkeypatch.setattr(MlflowClient, "log_batch", counted)
    monkeypatch.setattr("gran_bench.tracking.run.FLUSH_SECONDS", 1e9)
    with open_run(config, "batches", "key", {}) as run:
        for step in range(100):
            run.log_metrics({"loss": 1.0}, step)
    assert [count for count in sent if count] == [100]


def test_a_diverged_loss_is_recorded_as_it_is(config: TrackingConfig):
    with open_run(config, "nan", "key", {}) as run:
        run.log_metrics({"loss": float("nan")}, 1)
    assert str(only_run(config).data.metrics["loss"]) == "nan"


def test_a_name_that_mlflow_would_refuse_is_made_legal(config: TrackingConfig):
    with open_run(config, "names", "key", {}) as run:
        run.log_metrics({"angle error (°)": 1.0, "steady/speed W1": 2.0}, 1)
    assert only_run(config).data.metrics == {"angle error ___": 1.0, "steady/speed W1": 2.0}


def test_without_tracking_nothing_is_written(tmp_path: Path):
    config = TrackingConfig(root=str(tmp_path / "none"), enabled=False)
    with open_run(config, "off", "key", {"a": 1}) as run:
        run.log_metrics({"loss": 1.0}, 0)
        run.log_artifact(tmp_path / "figure.png")
        run.log_dataset("drum", "d1", "data")
        run.set_tag("a", "b")
        run.finish()
    assert schedule_children(config, None, [Child("a", "key")]) == set()
    end_child(config, "key", "no store")
    assert not (tmp_path / "none").exists()


def sweep_parent(config: TrackingConfig) -> str:
    axes, tags = {"sweep": {"model.radius": "1,2"}}, {"sweep": "sweep_radius"}
    with open_run(config, "sweep_radius", "sweep", axes, tags) as run:
        return run.run_id


def test_a_sweeps_runs_wait_under_its_parent_before_their_jobs_start(config: TrackingConfig):
    parent = sweep_parent(config)
    children = [Child("R1", "one"), Child("R2", "two"), Child("R3", "three", finished=True)]
    # The third was done before, by a store that is gone.
    assert schedule_children(config, parent, children) == {"three"}
    waiting = {run.info.run_name: run for run in runs(config) if run.info.run_id != parent}
    assert {run.info.status for run in waiting.values()} == {"SCHEDULED"}
    assert {run.data.tags["mlflow.parentRunId"] for run in waiting.values()} == {parent}
    assert {run.data.tags["sweep"] for run in waiting.values()} == {"sweep_radius"}
    with open_run(config, "R1", "one", {}, parent=parent) as run:
        assert run.run_id == waiting["R1"].info.run_id
        assert client(config).get_run(run.run_id).info.status == "RUNNING"
    # The same command again: nothing is made twice, what is finished stays so, what was killed waits again.
    client(config).update_run(waiting["R2"].info.run_id, status="RUNNING")
    assert sweep_parent(config) == parent
    assert schedule_children(config, parent, [Child("R1", "one", finished=True), *children[1:]]) == {"three"}
    statuses = {run.info.run_name: run.info.status for run in runs(config) if run.info.run_id != parent}
    assert statuses == {"R1": "FINISHED", "R2": "SCHEDULED", "R3": "SCHEDULED"}


def test_a_run_that_another_sweep_made_stays_there_and_an_orphan_is_taken_in(config: TrackingConfig):
    with open_run(config, "single", "one", {}):
        pass
    parent = sweep_parent(config)
    schedule_children(config, parent, [Child("single", "one", finished=True)])
    with open_run(config, "another sweep", "second", {}, {"sweep": "another"}) as other:
        pass
    schedule_children(config, other.run_id, [Child("single", "one", finished=True)])
    tags = {run.info.run_name: run.data.tags for run in runs(config)}
    assert (tags["single"]["mlflow.parentRunId"], tags["single"]["sweep"]) == (parent, "sweep_radius")
    client(config).delete_run(parent)
    schedule_children(config, other.run_id, [Child("single", "one", finished=True)])
    tags = {run.info.run_name: run.data.tags for run in runs(config)}
    assert (tags["single"]["mlflow.parentRunId"], tags["single"]["sweep"]) == (other.run_id, "another")


def test_a_child_that_could_not_close_itself_is_closed_with_the_reason_and_no_other(config: TrackingConfig):
    parent = sweep_parent(config)
    schedule_children(config, parent, [Child("killed", "one"), Child("done", "two")])
    with open_run(config, "done", "two", {}):
        pass
    for key in ("one", "two", "no such key"):
        end_child(config, key, "signal 9")
    found = {run.info.run_name: run for run in runs(config)}
    assert found["killed"].info.status == "FAILED"
    assert found["killed"].data.tags["ended_by"] == "signal 9"
    assert found["done"].info.status == "FINISHED"
    with open_run(config, "killed", "one", {}):
        pass
    killed = next(run for run in runs(config) if run.info.run_name == "killed")
    assert killed.info.status == "FINISHED"
    assert "ended_by" not in killed.data.tags


def test_a_run_that_has_ended_takes_a_later_report_and_keeps_its_status(config: TrackingConfig, tmp_path: Path):
    parent = sweep_parent(config)
    with reopen_ended(config, "sweep") as run:
        run.log_metrics({"best/angle": 1.5}, supersede=True)
    with reopen_ended(config, "no such key") as run:
        assert run is None
    found = client(config).get_run(parent)
    assert found.info.status == "FINISHED"
    assert found.data.metrics["best/angle"] == 1.5


# ---- how a run ends, and its next life -----------------------------------------------------------------------


@pytest.mark.parametrize(("error", "status"), [(KeyboardInterrupt("SIGINT"), "KILLED"), (ValueError("no"), "FAILED")])
def test_the_status_says_how_a_run_ended(config: TrackingConfig, error: BaseException, status: str):
    def life() -> None:
        with open_run(config, "ends", "key", {}) as run:
            run.log_metrics({"loss": 1.0}, 7)
            raise error

    with pytest.raises(type(error)):
        life()
    found = only_run(config)
    assert found.info.status == status
    assert found.data.tags["ended_by"].startswith(type(error).__name__)
    assert found.data.metrics["loss"] == 1.0


KILLED_BY_SIGNAL = """
import signal, sys, time
from gran_bench.config import TrackingConfig
from gran_bench.tracking import open_run
with open_run(TrackingConfig(experiment=sys.argv[2], root=sys.argv[1]), "killed", "key", {}) as run:
    run.log_metrics({"loss": 1.0}, 0)
    run.flush()
    print("open", flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGTERM, "KILLED"), (signal.SIGINT, "KILLED"), (signal.SIGKILL, "RUNNING")]
)
def test_a_killed_run_is_marked_and_reopened(config: TrackingConfig, number: signal.Signals, status: str):
    sources = str(Path(__file__).parents[1] / "src")
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED_BY_SIGNAL, config.root, config.experiment],
        env=os.environ | {"PYTHONPATH": sources},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "open\n", "MLflow must not chatter"
    process.send_signal(number)
    _, complaints = process.communicate(timeout=60)
    assert "INFO" not in complaints
    before = only_run(config)
    assert before.info.status == status
    with open_run(config, "killed", "key", {}) as run:
        assert run.run_id == before.info.run_id
        assert only_run(config).info.status == "RUNNING"
    after = only_run(config)
    assert after.info.status == "FINISHED"
    assert "ended_by" not in after.data.tags


def test_a_resumed_run_logs_a_repeated_step_once_and_a_changed_param_as_a_tag(config: TrackingConfig):
    def first_life() -> None:
        with open_run(config, "resumed", "key", {"minutes": 1, "seed": 0}) as run:
            for step in range(4):
                run.log_metrics({"loss": 1.0 / (step + 1)}, step)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        first_life()
    # The last checkpoint was at step 2: steps 2 and 3 are computed again, to the same values.
    with open_run(config, "resumed", "key", {"minutes": 2, "seed": 0, "new": "x"}) as run:
        for step in range(2, 6):
            run.log_metrics({"loss": 1.0 / (step + 1)}, step)
    found = only_run(config)
    assert [m.step for m in client(config).get_metric_history(found.info.run_id, "loss")] == list(range(6))
    assert found.data.params == {"minutes": "1", "seed": "0", "new": "x"}
    assert found.data.tags["resumed_with.minutes"] == "2"


def test_a_replayed_step_stays_as_it_is_and_a_lost_one_is_filled_in(
    config: TrackingConfig, monkeypatch: pytest.MonkeyPatch
):
    def rows(steps: range, pace: float) -> list[tuple[int, dict[str, float]]]:
        return [(step, {"training/loss": 1.0 / (1 + step), "training/seconds": pace * step}) for step in steps]

    with open_run(config, "killed", "key", {}) as run:
        # Steps 3 to 5 were never sent: the process was killed between two flushes.
        for step, metrics in (*rows(range(3), 1.0), *rows(range(6, 8), 1.0)):
            run.log_metrics(metrics, step)
    asked = []
    original = MlflowClient.get_metric_history

    def counted(self: MlflowClient, run_id: str, name: str, *arguments: object) -> list:
        asked.append(name)
        return original(self, run_id, name, *arguments)

    monkeypatch.setattr(MlflowClient, "get_metric_history", counted)
    with open_run(config, "killed", "key", {}) as run:
        # All rows that survived on disk, then the steps after the checkpoint anew, at another pace.
        for step, metrics in (*rows(range(5), 1.0), *rows(range(5, 10), 2.0)):
            run.log_metrics(metrics, step)
            if step % 3 == 0:
                run.flush()
        run.log_metrics({"training/loss": 0.0}, 9)  # within one life, too, a step is logged once
    assert sorted(asked) == ["training/loss", "training/seconds"]
    store, run_id = client(config), only_run(config).info.run_id
    loss, seconds = (
        {m.step: m.value for m in original(store, run_id, f"training/{name}")} for name in ("loss", "seconds")
    )
    assert len(original(store, run_id, "training/seconds")) == len(original(store, run_id, "training/loss")) == 10
    assert loss == pytest.approx({step: 1.0 / (1 + step) for step in range(10)})
    assert seconds == {step: (1.0 if step in (0, 1, 2, 3, 4, 6, 7) else 2.0) * step for step in range(10)}


def test_figures_found_anew_take_the_place_of_the_old(config: TrackingConfig):
    for angle in (30.0, 31.0, 31.0, 30.0):
        with open_run(config, "judged anew", "key", {}) as run:
            run.log_metrics({"angle": angle, "nan": float("nan")}, 100, supersede=True)
        assert only_run(config).data.metrics["angle"] == angle
    store, run_id = client(config), only_run(config).info.run_id
    assert len(store.get_metric_history(run_id, "angle")) == 3
    assert len(store.get_metric_history(run_id, "nan")) == 1


def test_another_key_is_another_run(config: TrackingConfig):
    for key in ("one", "two", "one"):
        with open_run(config, key, key, {}):
            pass
    assert sorted(run.info.run_name for run in runs(config)) == ["one", "two"]


def test_a_status_that_does_not_exist_is_refused(config: TrackingConfig):
    with open_run(config, "status", "key", {}) as run, pytest.raises(ValueError, match="status='DONE'"):
        run.finish("DONE")


# ---- first starts at once ------------------------------------------------------------------------------------

FIRST_START = """
import sys
from gran_bench.config import TrackingConfig
from gran_bench.tracking import open_run
with open_run(TrackingConfig(root=sys.argv[1]), "run" + sys.argv[2], sys.argv[2], {}) as run:
    run.log_metrics({"loss": 1.0}, 0)
"""


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


def test_a_moved_results_folder_is_told(own: TrackingConfig, tmp_path: Path):
    Store(own)
    Path(own.root).rename(tmp_path / "moved")
    with pytest.raises(TrackingError, match="the folder was moved"):
        Store(TrackingConfig(experiment="own", root=str(tmp_path / "moved")))


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


# ---- the UI --------------------------------------------------------------------------------------------------


def test_the_ui_serves_this_store_in_this_process(template: Path, monkeypatch: pytest.MonkeyPatch):
    for name, value in os.environ.items():
        monkeypatch.setenv(name, value)  # so that what the UI sets is undone
    served = []
    monkeypatch.setattr(user_interface, "_serve", lambda port, ready: served.append((port, ready)))
    ui(template, port=50123)
    ((port, ready),) = served
    store = Store(TrackingConfig(root=str(template)))
    assert port == 50123
    assert f"http://127.0.0.1:50123/#/experiments/{store.experiment_id}/runs?viewStateShareKey=what-matters" in ready
    told = {name: os.environ[name] for name in user_interface.server_environment(store)}
    assert told["_MLFLOW_SERVER_FILE_STORE"] == f"sqlite:///{template / DATABASE}"
    assert told["MLFLOW_SERVER_ENABLE_JOB_EXECUTION"] == "false"


def test_the_server_is_told_about_the_store_by_the_names_that_mlflow_reads(template: Path):
    from mlflow.environment_variables import _MLFLOW_SERVER_BOOT_ID, MLFLOW_SERVER_ENABLE_JOB_EXECUTION
    from mlflow.server import constants

    told = user_interface.server_environment(Store(TrackingConfig(root=str(template))))
    names = {constants.BACKEND_STORE_URI_ENV_VAR, constants.REGISTRY_STORE_URI_ENV_VAR}
    names |= {constants.ARTIFACT_ROOT_ENV_VAR, _MLFLOW_SERVER_BOOT_ID.name, MLFLOW_SERVER_ENABLE_JOB_EXECUTION.name}
    assert set(told) - set(QUIET) == names


def test_the_ui_says_when_its_port_is_taken(template: Path):
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(TrackingError, match=rf"port {port} cannot be used.*make ui PORT={port + 1}"):
            ui(template, port)
