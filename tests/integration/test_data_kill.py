"""kill -9 while data are made, at any moment: the same command again gives the same data."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from gran_bench.config import ContainerConfig, FillingConfig, SceneConfig
from gran_bench.dataset import CaseSpec, ensure_cases, read_case, read_settled
from gran_bench.dataset.workers import spec_to_document
from gran_bench.scene import build_scene

SCENE = build_scene(
    SceneConfig(
        name="drum_tiny",
        container=ContainerConfig(diameter=0.4, length=0.2),
        filling=FillingConfig(count=60),
        start_time=1.0,
        end_time=3.0,
    )
)
SPECS = [CaseSpec(SCENE.at_speed(speed)) for speed in (20.0, 30.0, 40.0)]

# What a user's script would do. A test process must not be killed itself, so the data are made in another.
PROGRAM = """
import json, sys
from gran_bench.dataset import ensure_cases
from gran_bench.dataset.workers import spec_from_document
specs = [spec_from_document(document) for document in json.loads(sys.argv[2])]
print("begins", flush=True)
ensure_cases(specs, sys.argv[1], workers=int(sys.argv[3]), progress=False)
"""


def start(root: Path, workers: int = 2) -> subprocess.Popen:
    """A process that makes the data; returns when it begins to."""
    sources = str(Path(__file__).parents[2] / "src")
    process = subprocess.Popen(
        [
            sys.executable,
            "-c",
            PROGRAM,
            str(root),
            json.dumps([spec_to_document(spec) for spec in SPECS]),
            str(workers),
        ],
        env=os.environ | {"PYTHONPATH": sources, "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "begins\n"
    return process


def workers_of(process: subprocess.Popen) -> list[psutil.Process]:
    """The worker processes, as soon as there are any."""
    while True:
        assert process.poll() is None, "the data were made before a worker was seen"
        if workers := psutil.Process(process.pid).children():
            return workers
        time.sleep(0.01)


def digests(root: Path) -> list[str]:
    return [read_case(spec.path(root)).digest for spec in SPECS]


def final_names(root: Path) -> list[Path]:
    return [path for path in root.rglob("*.h5") if not path.name.startswith(".")]


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Digests of a run that nothing disturbed."""
    root = tmp_path_factory.mktemp("undisturbed")
    ensure_cases(SPECS, root, workers=1, progress=False)
    return digests(root)


@pytest.mark.parametrize(("workers", "kills"), [(1, 2), (2, 3)])
def test_kill_9_at_any_moment_and_again_gives_the_same_data(
    tmp_path: Path, expected: list[str], workers: int, kills: int
):
    moments = np.random.default_rng(workers).uniform(0.05, 1.2, size=kills)
    for moment in moments:
        process = start(tmp_path, workers)
        time.sleep(moment)
        process.kill()
        process.communicate()
        # Whatever has a final name is whole.
        for path in final_names(tmp_path):
            (read_settled if path.parent.name == "settled" else read_case)(path)
    again = start(tmp_path, workers)
    assert again.wait(timeout=120) == 0
    again.stdout.close()
    assert digests(tmp_path) == expected
    assert not list(tmp_path.rglob("*.tmp")), "what killed runs left behind is gone"


def test_workers_end_when_their_parent_is_killed(tmp_path: Path):
    process = start(tmp_path)
    workers = workers_of(process)
    process.kill()
    process.communicate()
    _, alive = psutil.wait_procs(workers, timeout=60)
    assert not alive


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_polite_stop_ends_the_workers_too(tmp_path: Path, number: signal.Signals):
    process = start(tmp_path)
    workers = workers_of(process)
    process.send_signal(number)
    assert process.wait(timeout=60) != 0
    process.stdout.close()
    _, alive = psutil.wait_procs(workers, timeout=60)
    assert not alive
