"""kill -9 while data are made, at any moment: the same command again gives the same data."""

from __future__ import annotations

import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
import victim
from tiny import tiny_specs

from gran_bench.dataset import ensure_cases, read_case, read_settled

SPECS = tiny_specs()


def start(root: Path, workers: int = 2) -> subprocess.Popen[str]:
    """A process that makes the data; a test process must not be killed itself."""
    return victim.start("data", root=str(root), workers=workers)


def workers_of(process: subprocess.Popen[str]) -> list[psutil.Process]:
    """The worker processes, as soon as there are any."""
    while True:
        assert process.poll() is None, "the data were made before a worker was seen"
        if workers := psutil.Process(process.pid).children():
            return workers
        time.sleep(0.01)


def digests(root: Path) -> list[str]:
    return [read_case(spec.path(root)).digest for spec in SPECS]


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Digests of a run that nothing disturbed."""
    root = tmp_path_factory.mktemp("undisturbed")
    ensure_cases(SPECS, root, workers=1, progress=False)
    return digests(root)


@pytest.mark.parametrize(("workers", "kills"), [(1, 2), (2, 4)])
def test_kill_9_at_any_moment_and_again_gives_the_same_data(
    tmp_path: Path, expected: list[str], workers: int, kills: int
):
    hits = 0
    for moment in np.random.default_rng(workers).uniform(0.05, 1.2, size=kills):
        hits += victim.kill_after(start(tmp_path, workers), moment)
        for path in tmp_path.rglob("[!.]*.h5"):  # whatever has a final name is whole
            (read_settled if path.parent.name == "settled" else read_case)(path)
    assert hits > 0
    victim.finish(start(tmp_path, workers))
    assert digests(tmp_path) == expected
    assert not list(tmp_path.rglob("*.tmp")), "what killed runs left behind is gone"


def test_workers_end_when_their_parent_is_killed(tmp_path: Path):
    process = start(tmp_path)
    workers = workers_of(process)
    victim.kill_after(process, 0.0)
    _, alive = psutil.wait_procs(workers, timeout=60)
    assert not alive


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_polite_stop_ends_the_workers_too(tmp_path: Path, number: signal.Signals):
    process = start(tmp_path)
    workers = workers_of(process)
    process.send_signal(number)
    process.communicate(timeout=60)
    assert process.returncode != 0
    _, alive = psutil.wait_procs(workers, timeout=60)
    assert not alive
