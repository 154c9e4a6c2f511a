"""The UI at first sight: its address opens the saved view, and the project's own records are there, once."""

import json
import socket
import subprocess
import sys
import time
import urllib.request
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from mlflow import MlflowClient

from gran_bench.config import TrackingConfig
from gran_bench.tracking import HEADLINE, SHIPPED_TAG, VERDICT, open_run
from gran_bench.tracking.store import DATABASE
from gran_bench.tracking.views import FIRST_TAGS, view_path

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy"),  # SQLAlchemy's word to MLflow
]
RESULTS = Path(__file__).parents[1] / "results"


@contextmanager
def make_ui(root: Path, *words: str) -> Iterator[str]:
    """The UI as its command starts it; yields the address that it prints."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "gran_bench.ui", f"port={port}", f"tracking.root={root}", *words]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        told = ""
        while " are at " not in told:
            told = process.stderr.readline()
            assert told, "the UI ended before it answered"
        address, patience = told.split(" are at ")[1].split()[0], time.monotonic() + 120.0
        while True:
            try:
                urllib.request.urlopen(f"{address}/health", timeout=10.0).close()
                break
            except OSError:
                assert time.monotonic() < patience
                time.sleep(0.1)
        yield address
    finally:
        process.terminate()
        process.communicate(timeout=60)


def asked(address: str, path: str, **body: Any) -> Any:
    """What MLflow's HTTP API answers."""
    request = urllib.request.Request(f"{address}/api/2.0/mlflow/{path}", json.dumps(body).encode())
    request.add_header("Content-Type", "application/json")
    with urllib.request.urlopen(request) as answer:
        return json.load(answer)


def runs_at(address: str, experiment: str) -> list[dict[str, Any]]:
    found = asked(address, "runs/search", experiment_ids=[experiment], max_results=1000)
    return [
        run["info"] | {part: {one["key"]: one["value"] for one in run["data"].get(part, ())} for part in run["data"]}
        for run in found.get("runs", [])
    ]


def experiment_of(root: Path) -> str:
    return MlflowClient(f"sqlite:///{root / DATABASE}").get_experiment_by_name("gran-bench").experiment_id


def test_the_first_start_shows_the_own_run_among_the_shipped_ones_and_the_second_adds_none(tmp_path: Path):
    with open_run(TrackingConfig(root=str(tmp_path)), "mine", "my key", {}):
        pass
    experiment = experiment_of(tmp_path)
    with make_ui(tmp_path) as address:
        with urllib.request.urlopen(address) as answer:
            page = answer.read().decode()
        first = runs_at(address, experiment)
    # The address alone opens the saved view; a page that is named in it is left alone.
    assert f'if (location.hash.length < 3) location.replace("{view_path(experiment)[1:]}")' in page
    assert page.index("location.replace") < page.index("static/js/main")
    shipped = [run for run in first if SHIPPED_TAG in run["tags"]]
    assert [run["run_name"] for run in first if run not in shipped] == ["mine"]
    places = Counter(run["tags"][SHIPPED_TAG] for run in shipped)
    assert places["results/holdout30rpm"] == 1
    for table in RESULTS.glob("*/*/*/methods.csv"):
        assert places[table.parent.relative_to(RESULTS.parent).as_posix()] > 10
    for table in RESULTS.glob("sweeps/*/runs.csv"):
        assert any(table.parent.name in run["tags"].get("sweep", "").split(", ") for run in shipped)
    model = next(run for run in shipped if run["run_name"] == "holdout30rpm")
    assert [model["tags"][name] for name in FIRST_TAGS[:3]] == ["drum", "30 rpm, held out", "contact"]
    for run in shipped:
        assert run["status"] in ("FINISHED", "FAILED")
        figures = {name: value for name, value in run.get("metrics", {}).items() if name.startswith(HEADLINE)}
        assert all(value == float(f"{value:.3g}") for value in figures.values())
        missed = figures.get(f"{HEADLINE}requirements failed")
        if missed is not None:
            assert run["tags"][VERDICT] == ("fail" if missed else "pass")
    summary = json.loads((RESULTS / "holdout30rpm" / "summary.json").read_text("utf-8"))
    exact = summary["judged"]["shared"]["errors"]["surface_angle"]["multiple_of_floor"]
    assert model["metrics"]["shared/floors/surface_angle"] == exact
    assert model["metrics"][f"{HEADLINE}angle error floors"] == float(f"{exact:.3g}")
    with make_ui(tmp_path) as address:
        second = runs_at(address, experiment)
    assert sorted(run["run_id"] for run in second) == sorted(run["run_id"] for run in first)


def test_the_shipped_records_can_be_left_out(tmp_path: Path):
    with make_ui(tmp_path, "shipped=false") as address:
        assert runs_at(address, experiment_of(tmp_path)) == []
