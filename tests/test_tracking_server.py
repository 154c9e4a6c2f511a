"""A tracking server that ``MLFLOW_TRACKING_URI`` names: runs, sweeps and figures go there; what is none is said."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from mlflow import MlflowClient
from mlflow.artifacts import download_artifacts
from mlflow.entities import Run as MlflowRun

from gran_bench.config import TrackingConfig
from gran_bench.sweep.runs import SweepFile
from gran_bench.sweep.sweep_report import SweepReport, report_to_parent
from gran_bench.tracking import (
    Child,
    Store,
    TrackingError,
    abandoned,
    end_child,
    open_run,
    schedule_children,
    ui,
)
from gran_bench.tracking.store import said_place

# SQLAlchemy's word to MLflow, which a user never sees either.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

SERVER = """
import os, sys, threading
folder, port = sys.argv[1], int(sys.argv[2])
os.environ |= {
    "MLFLOW_DISABLE_TELEMETRY": "true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
    "_MLFLOW_SERVER_FILE_STORE": f"sqlite:///{folder}/server.db",
    "_MLFLOW_SERVER_REGISTRY_STORE": f"sqlite:///{folder}/server.db",
    "_MLFLOW_SERVER_ARTIFACT_ROOT": "mlflow-artifacts:/", "_MLFLOW_SERVER_SERVE_ARTIFACTS": "true",
    "_MLFLOW_SERVER_ARTIFACT_DESTINATION": f"{folder}/kept",
}
# It ends with whoever started it, however that ends.
threading.Thread(target=lambda: (sys.stdin.read(), os._exit(0)), daemon=True).start()
import uvicorn
from mlflow.server.fastapi_app import app
uvicorn.run(app, host="127.0.0.1", port=port, log_level="error")
"""


@dataclass
class Server:
    """MLflow's own server, in a process that ends with this one."""

    folder: Path
    port: int
    process: subprocess.Popen | None = None

    @property
    def uri(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def start(self) -> None:
        words = [sys.executable, "-c", SERVER, str(self.folder), str(self.port)]
        with open(self.folder / "server.log", "ab") as log:
            self.process = subprocess.Popen(words, cwd=self.folder, stdin=subprocess.PIPE, stdout=log, stderr=log)
        patience = time.monotonic() + 120.0
        while True:
            try:
                urllib.request.urlopen(f"{self.uri}/health", timeout=10.0).close()
                return
            except OSError:
                assert self.process.poll() is None, (self.folder / "server.log").read_text()
                assert time.monotonic() < patience
                time.sleep(0.1)

    def stop(self) -> None:
        self.process.kill()
        self.process.wait()
        self.process.stdin.close()


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        server = Server(tmp_path_factory.mktemp("server"), free.getsockname()[1])
    server.start()
    try:
        yield server
    finally:
        server.stop()


@pytest.fixture
def server(running: Server, monkeypatch: pytest.MonkeyPatch) -> Server:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", running.uri)
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    return running


@pytest.fixture
def config(tmp_path: Path, request: pytest.FixtureRequest) -> TrackingConfig:
    return TrackingConfig(experiment=request.node.name, root=str(tmp_path / "results"))


def runs(server: Server, config: TrackingConfig) -> dict[str, MlflowRun]:
    client = MlflowClient(server.uri)
    found = client.search_runs([client.get_experiment_by_name(config.experiment).experiment_id])
    return {run.info.run_name: run for run in found}


def test_a_run_is_recorded_on_the_server_and_nowhere_else(
    server: Server, config: TrackingConfig, tmp_path: Path, capsys: pytest.CaptureFixture
):
    figure = tmp_path / "figure.png"
    figure.write_bytes(b"a picture")
    for _ in "12":  # the same key is the same run there, too
        with open_run(config, "run", "key", {"seed": 0}, {"scene": "drum"}) as run:
            run.log_metrics({"loss": 0.5}, 3)
            run.log_artifact(figure, "figures")
            run.log_dataset("drum", "d1", str(tmp_path / "data"))
    said = capsys.readouterr()
    assert f"runs are recorded on {server.uri}, as MLFLOW_TRACKING_URI says" in said.err
    assert said.out == "", "which is for the table alone"
    ((name, found),) = runs(server, config).items()
    assert (name, found.info.status, found.data.metrics) == ("run", "FINISHED", {"loss": 0.5})
    assert found.data.params == {"seed": "0"}
    assert found.data.tags["scene"] == "drum"
    assert found.inputs.dataset_inputs[0].dataset.name == "drum"
    kept = download_artifacts(
        run_id=run.run_id, artifact_path="figures/figure.png", tracking_uri=server.uri, dst_path=str(tmp_path)
    )
    assert Path(kept).read_bytes() == b"a picture"
    page = f"{server.uri}/get-artifact?path=figures%2Ffigure.png&run_uuid={run.run_id}"
    with urllib.request.urlopen(page) as answer:
        assert answer.read() == b"a picture"
    left = [path.name for path in Path(config.root).rglob("*") if path.is_file()]
    assert left == ["mlflow.lock"], "no database, no figure"


def test_a_sweep_has_its_parent_children_and_report_on_the_server(
    server: Server, config: TrackingConfig, tmp_path: Path
):
    with open_run(config, "first", "first key", {}, {"sweep": "first"}) as first:
        schedule_children(config, first.run_id, [Child("R1", "one"), Child("R2", "two")])
        with open_run(config, "R1", "one", {}, parent=first.run_id) as child:
            child.log_metrics({"angle": 30.0}, 0)
        end_child(config, "two", "killed")
    with open_run(config, "second", "second key", {}, {"sweep": "second"}) as second:
        schedule_children(config, second.run_id, [Child("R1", "one", finished=True)])
    found = runs(server, config)
    assert {name: run.info.status for name, run in found.items()} == {
        "first": "FINISHED", "R1": "FINISHED", "R2": "FAILED", "second": "FINISHED",
    }  # fmt: skip
    assert found["R1"].data.tags["mlflow.parentRunId"] == first.run_id
    assert found["R1"].data.tags["sweep"] == "first, second"
    # A report that is made anew later finds the parent, although the folder has no database.
    folder = Path(config.root) / "sweeps" / "first"
    SweepFile("first", "first key", "train", config.experiment, []).write(folder)
    (folder / "runs.csv").write_text("a table")
    report = SweepReport("", [folder / "runs.csv"], {"best": 1.0}, {}, [])
    assert report_to_parent(folder, report)
    assert runs(server, config)["first"].data.metrics == {"best": 1.0}


def test_the_ui_of_a_server_is_its_own(server: Server, config: TrackingConfig, capsys: pytest.CaptureFixture):
    gone = json.loads(abandoned.this_process()) | {"start": "1"}
    Store(config).create_run("gone", "gone", None, tags={abandoned.PROCESS_TAG: json.dumps(gone)})
    ui(config.root, experiment=config.experiment)  # returns: nothing is served here
    said = capsys.readouterr().err
    place = MlflowClient(server.uri).get_experiment_by_name(config.experiment)
    assert f"the runs, best first, are at {server.uri}/#/experiments/{place.experiment_id}/runs?" in said
    assert "mlflow.sharedViewState.what-matters" in place.tags
    assert runs(server, config)["gone"].info.status == "KILLED"


@pytest.mark.slow
def test_a_server_that_falls_silent_costs_no_result_and_hears_of_it_later(server: Server, config: TrackingConfig):
    def life() -> None:
        with open_run(config, "lost", "key", {}) as run:
            server.stop()
            run.log_metrics({"loss": 0.5}, 3)

    try:
        with pytest.raises(TrackingError, match=rf"server {server.uri} does not answer.*MLFLOW_TRACKING_URI.*unsent"):
            life()
        with pytest.raises(TrackingError, match="start it, or unset MLFLOW_TRACKING_URI"):
            Store(config)
    finally:
        server.start()
    assert runs(server, config)["lost"].info.status == "RUNNING"
    # The folder's own database must not be asked to take what the server has missed.
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("MLFLOW_TRACKING_URI")
        with open_run(config, "at home", "home", {}):
            pass
    with open_run(config, "next", "next", {}):
        pass
    lost = runs(server, config)["lost"]
    assert (lost.info.status, lost.data.metrics) == ("FINISHED", {"loss": 0.5})


def test_what_is_no_server_is_said_and_the_folders_database_is_used(
    config: TrackingConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    database = Path(config.root) / "mlflow.db"
    for uri in ("file:///mlruns", "sqlite:///elsewhere.db", "databricks", "postgresql://me:secret@host/db"):
        monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
        said = said_place(config)
        assert f"MLFLOW_TRACKING_URI={uri.replace('me:secret@', '')} is not used, for it is no server" in said
        assert f"runs are recorded in {database}" in said
    with open_run(config, "run", "key", {}):
        pass
    assert said in capsys.readouterr().err
    assert database.is_file()
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{database}")
    assert said_place(config) is None, "the folder's own database by its URI is no news"


def test_no_password_is_printed(config: TrackingConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://me:secret@127.0.0.1:1")  # a port that nobody listens to
    with pytest.raises(TrackingError) as told, open_run(config, "run", "key", {}):
        pass
    assert "secret" not in str(told.value) + capsys.readouterr().err
