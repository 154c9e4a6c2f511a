"""A store that the tests of tracking share, an experiment in it for each of them, and the runs found there."""

from __future__ import annotations

from pathlib import Path

import pytest
from mlflow import MlflowClient
from mlflow.entities import Run as StoredRun

from gran_bench.config import TrackingConfig
from gran_bench.tracking import Store
from gran_bench.tracking.store import DATABASE


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The root of a store; making its tables takes a second, so the tests of one module share it."""
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
