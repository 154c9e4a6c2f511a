"""The MLflow UI on the store."""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path

from gran_bench.config import TrackingConfig
from gran_bench.tracking.store import QUIET, Store, TrackingError
from gran_bench.tracking.views import view_path

HOST = "127.0.0.1"


def ui(root: Path | str, port: int = 5000, experiment: str = TrackingConfig.experiment) -> None:
    """Become the MLflow UI on the store under ``root``; does not return.

    Raises:
        TrackingError: the store cannot be opened, or the port is taken.
    """
    store = Store(TrackingConfig(experiment=experiment, root=str(root)))
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError) as error:
            raise TrackingError(
                f"port {port} cannot be used ({error}); is the UI open already? Choose another: make ui PORT={port + 1}"
            ) from error
    store.dress_experiment()
    page = f"http://{HOST}:{port}{view_path(store.experiment_id)}"
    print(f"the runs, best first, are in some seconds at {page} (Ctrl-C ends)", file=sys.stderr, flush=True)
    command = [sys.executable, "-m", "mlflow", "ui", "--backend-store-uri", store.uri]
    # One worker and no job executor: 2 processes instead of 15.
    command += ["--default-artifact-root", store.artifacts_uri, "--host", HOST, "--port", str(port), "--workers", "1"]
    os.execve(sys.executable, command, os.environ | {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"} | QUIET)
