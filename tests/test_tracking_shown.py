"""What the UI shows: all that a run logs, in the store that it serves."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import stored_runs
from mlflow import MlflowClient
from stored_runs import client, only_run

from gran_bench.config import RolloutConfig, TrackingConfig
from gran_bench.tracking import (
    Child,
    Store,
    TrackingError,
    end_child,
    open_run,
    schedule_children,
    ui,
    user_interface,
)
from gran_bench.tracking.store import QUIET

# SQLAlchemy's word to MLflow, which a user never sees either.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

# Fixtures.
template, config = stored_runs.template, stored_runs.config


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


def test_headline_figures_are_rounded_to_three_figures_and_no_others(config: TrackingConfig):
    with open_run(config, "rounded", "key", {}) as run:
        run.log_metrics({"headline/speed W1": 0.0123456, "headline/requirements failed": 0.0, "loss": 0.0123456})
    assert only_run(config).data.metrics == {
        "headline/speed W1": 0.0123,
        "headline/requirements failed": 0.0,
        "loss": 0.0123456,
    }


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


# ---- the UI --------------------------------------------------------------------------------------------------


def test_the_ui_serves_this_store_in_this_process(template: Path, monkeypatch: pytest.MonkeyPatch):
    for name, value in os.environ.items():
        monkeypatch.setenv(name, value)  # so that what the UI sets is undone
    served = []
    monkeypatch.setattr(user_interface, "_serve", lambda *given: served.append(given))
    ui(template, port=50123)
    ((port, ready, experiment),) = served
    store = Store(TrackingConfig(root=str(template)))
    assert port == 50123
    assert ready == "the runs, best first, are at http://127.0.0.1:50123 (Ctrl-C ends)"
    assert experiment == store.experiment_id
    told = {name: os.environ[name] for name in user_interface.server_environment(store)}
    assert told["_MLFLOW_SERVER_FILE_STORE"] == store.uri
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
        with pytest.raises(TrackingError, match=rf"port {port} cannot be used.*gran_bench.ui .* port={port + 1}"):
            ui(template, port)
