"""The MLflow UI on the store, in this process: ``mlflow ui`` would import MLflow twice more, seconds each."""

import os
import socket
import sys
import uuid
import warnings
from collections.abc import Callable
from pathlib import Path

from gran_bench.config import TrackingConfig
from gran_bench.tracking.abandoned import close_abandoned
from gran_bench.tracking.names import ui_command
from gran_bench.tracking.store import QUIET, Store, TrackingError, said_place, server_uri
from gran_bench.tracking.views import first_page, view_path

HOST = "127.0.0.1"
SHUTDOWN_SECONDS = 5  # that an answer under way may take after Ctrl-C


def ui(
    root: Path | str,
    port: int = 5000,
    experiment: str = TrackingConfig.experiment,
    fill: Callable[[Store], None] | None = None,
) -> None:
    """Serve the MLflow UI on the store under ``root`` until Ctrl-C; a server's own UI is only named.

    ``fill`` may add runs to the folder's own store before it is shown.
    """
    config = TrackingConfig(experiment=experiment, root=str(root))
    if (place := said_place(config)) is not None:
        print(place, file=sys.stderr, flush=True)
    if server_uri() is None:
        _refuse_taken(port, ui_command(config, port + 1 if port < 65535 else port - 1))
        print("opening the UI takes some seconds", file=sys.stderr, flush=True)
    store = Store(config)
    store.dress_experiment()
    if fill is not None and store.server is None:
        fill(store)
    with store.alone():
        elsewhere = close_abandoned(store)
    if elsewhere:
        print(f"left as RUNNING, for only their own machines know: {', '.join(elsewhere)}", file=sys.stderr, flush=True)
    ready = "the runs, best first, are at"
    if store.server is None:
        os.environ.update(server_environment(store))
        _serve(port, f"{ready} http://{HOST}:{port} (Ctrl-C ends)", store.experiment_id)
    else:  # which has its own UI
        print(f"{ready} {store.shown}{view_path(store.experiment_id)}", file=sys.stderr, flush=True)


def server_environment(store: Store) -> dict[str, str]:
    """What MLflow's server reads about its store when it is imported, by the names of MLflow 3.17."""
    return QUIET | {
        "_MLFLOW_SERVER_FILE_STORE": store.uri,  # also switches on that it answers this machine alone
        "_MLFLOW_SERVER_REGISTRY_STORE": store.uri,
        "_MLFLOW_SERVER_ARTIFACT_ROOT": store.artifacts_uri,
        # Its presence tells MLflow that this process is a server, which must not run code found in a store.
        "_MLFLOW_SERVER_BOOT_ID": uuid.uuid4().hex,
        # An executor of jobs would be a dozen processes more.
        "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
    }


def _refuse_taken(port: int, other: str) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError) as error:
            raise TrackingError(
                f"port {port} cannot be used ({error}); is the UI open already? Choose another: {other}"
            ) from error


def _serve(port: int, ready: str, experiment_id: str) -> None:
    import uvicorn
    from starlette.responses import HTMLResponse
    from starlette.routing import Route

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of MLflow's own use of other packages
        from mlflow.server import app as pages
        from mlflow.server.fastapi_app import app
    page = first_page((Path(pages.static_folder) / "index.html").read_text("utf-8"), experiment_id)
    app.router.routes.insert(0, Route("/", lambda request: HTMLResponse(page)))
    print(ready, file=sys.stderr, flush=True)
    uvicorn.run(app, host=HOST, port=port, log_level="warning", timeout_graceful_shutdown=SHUTDOWN_SECONDS)
