"""Sweeps on a real Slurm and a real Ray, of this machine: whatever is killed, they end as `local` does.

Slurm is set up by ``slurm.sh``, which says what it installs; root alone can. Ray has two nodes, as processes.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import pytest
from sweeps import (
    PATIENCE,
    SWEEP,
    finish,
    finished_work,
    group,
    records_of,
    results_of,
    statuses,
    stored,
    sweep_command,
)

from gran_bench.run.summary import SUMMARY
from gran_bench.trainer import CHECKPOINT

JOBS, KILLS = 12, 6
SET_UP = Path(__file__).with_name("slurm.sh")


@dataclass
class Cluster:
    """A cluster of this machine, and what befalls it."""

    overrides: list[str]  # of the command line
    lose_node: Callable[[int], object]  # where the process of this id works; the node comes back, or another has room
    warn: Callable[[int], object]  # the job of this process, as at its time limit


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    pytest.importorskip("submitit", reason="needs the package submitit (pip install 'gran-bench[slurm]')")
    folder = tmp_path_factory.mktemp("slurm")
    done = subprocess.run([SET_UP, "start", folder], capture_output=True, text=True, timeout=PATIENCE, check=False)
    if done.returncode:
        assert done.returncode == 3, done.stderr
        pytest.skip(f"needs Slurm: {done.stderr.strip()}")
    os.environ["SLURM_CONF"] = str(folder / "slurm.conf")

    def lose_node(pid: int) -> None:
        """All of Slurm's processes that the node has, and their jobs."""
        conf = os.environ["SLURM_CONF"]  # one of this test alone
        steps = [one for one in psutil.process_iter(["name"]) if one.info["name"] == "slurmstepd"]
        steps = [one for one in steps if one.environ().get("SLURM_CONF") == conf]
        daemon = psutil.Process(int((folder / "slurmd.pid").read_text()))
        for process in [daemon, *steps, *(child for one in steps for child in _below(one))]:
            with suppress(psutil.Error):
                process.kill()
        _wait_for(lambda: "down" in _said("sinfo", "--noheader", "--format=%T"))
        subprocess.run([SET_UP, "node", folder], check=True, timeout=60)

    def warn(pid: int) -> None:
        with suppress(psutil.Error):
            _said("scancel", "--signal=USR2", psutil.Process(pid).environ()["SLURM_JOB_ID"])

    try:
        yield Cluster(["hydra.launcher.minutes=20", "hydra.launcher.cpus=1"], lose_node, warn)
    finally:
        subprocess.run([SET_UP, "stop", folder], check=False, timeout=60)
        del os.environ["SLURM_CONF"]


@pytest.fixture(scope="module")
def ray() -> Iterator[Cluster]:
    pytest.importorskip("ray", reason="needs the package ray (pip install 'gran-bench[ray]')")
    # Ray's workers are nice to others, too nice for tests beside other work.
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
    from ray.cluster_utils import Cluster as Nodes

    size = {"num_cpus": 1, "object_store_memory": 100 * 2**20}
    nodes = Nodes(initialize_head=True, head_node_args=size | {"include_dashboard": False})
    second = [nodes.add_node(**size)]

    def lose_node(pid: int) -> None:
        """The one that is not the head."""
        nodes.remove_node(second.pop(), allow_graceful=False)
        second.append(nodes.add_node(**size))

    def warn(pid: int) -> None:
        """Ray has no time limits; a polite end is another death to it."""
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGTERM)

    try:
        yield Cluster([f"hydra.launcher.address={nodes.address}", "hydra.launcher.cpus=1"], lose_node, warn)
    finally:
        nodes.shutdown()


@pytest.fixture(scope="module")
def ray_here() -> Cluster:
    """The Ray that the command starts for itself."""
    pytest.importorskip("ray", reason="needs the package ray (pip install 'gran-bench[ray]')")
    return Cluster(["hydra.launcher.cpus=1"], print, print)


@pytest.fixture(scope="module")
def calm(place: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where `local` did the sweep, undisturbed."""
    folder = tmp_path_factory.mktemp("local")
    finish(sweep_command(place / "data", JOBS), folder)
    return folder


@pytest.mark.parametrize("back_end", ["slurm", "ray"])
def test_twelve_jobs_killed_at_random_end_as_local_does_and_none_is_done_twice(
    back_end: str, place: Path, calm: Path, tmp_path: Path, request: pytest.FixtureRequest
):
    cluster: Cluster = request.getfixturevalue(back_end)
    command = [*sweep_command(place / "data", JOBS, back_end), *cluster.overrides]
    rng, deeds = np.random.default_rng(0), []
    with _watched(command, tmp_path) as working:
        while len(deeds) < KILLS:
            time.sleep(float(rng.uniform(1.0, 5.0)))
            pid = int(rng.choice(working()))
            deed = ("child", "parent", "warned")[len(deeds) % 3]
            with suppress(psutil.Error):
                if deed == "warned":
                    cluster.warn(pid)
                else:
                    process = psutil.Process(pid)
                    (process if deed == "child" else process.parent()).kill()
                deeds.append(deed)
        cluster.lose_node(working()[0])
        done = _finished(tmp_path)
        _wait_for(lambda: _finished(tmp_path) > done)
        working()
    # The command itself is killed; what Slurm has of its jobs goes on, and the same command finds it.
    finish(command, tmp_path)
    seen = finished_work(tmp_path)
    assert _finished(tmp_path) == JOBS
    assert results_of(tmp_path) == results_of(calm)
    assert records_of(tmp_path) == records_of(calm)
    logs = [log.read_text("utf-8") for log in tmp_path.glob("results/sweeps/*/logs/*.log")]
    assert [log.count("figures and summary in") for log in logs] == [1] * JOBS, "a job was done twice"
    assert sum(log.count("\n---- ") for log in logs) >= KILLS // 2, "nothing of this was killed at work"
    assert stored(tmp_path / "results")[SWEEP] == ("FINISHED", None)
    assert statuses(tmp_path / "results") == ["FINISHED"] * JOBS
    finish(command, tmp_path)
    assert finished_work(tmp_path) == seen


@pytest.mark.parametrize("back_end", ["slurm", "ray"])
def test_a_job_that_fails_is_told_with_its_reason_and_stops_no_other(
    back_end: str, place: Path, tmp_path: Path, request: pytest.FixtureRequest
):
    cluster: Cluster = request.getfixturevalue(back_end)
    command = [*sweep_command(place / "data", 2, back_end), *cluster.overrides]
    with group(command, tmp_path) as process:
        # Where a run's folder should be there is a file.
        _wait_for(lambda: list(tmp_path.glob("results/sweeps/*/sweep.json")) or process.poll() is not None)
        sweep = next(tmp_path.glob("results/sweeps/*/sweep.json")).read_text("utf-8")
        name, key = re.search(r'"run": "(\S+radius_m-0.06\+\S+)".*?"key": "(\w+)"', sweep, re.DOTALL).groups()
        (tmp_path / "results" / "runs").mkdir(parents=True, exist_ok=True)
        (tmp_path / "results" / "runs" / f"{name}-{key[:8]}").write_text("in the way")
        assert process.wait(PATIENCE) == 1
    said = (tmp_path / "said.txt").read_text()
    assert "1 runs finished, 1 failed" in said
    assert "FileExistsError" in said
    assert statuses(tmp_path / "results") == ["FAILED", "FINISHED"]


@pytest.mark.parametrize(
    ("back_end", "number"), [("slurm", signal.SIGINT), ("ray", signal.SIGINT), ("ray_here", signal.SIGTERM)]
)
def test_a_command_that_is_stopped_stops_its_jobs_at_a_checkpoint_and_goes_on_from_there(
    back_end: str, number: signal.Signals, place: Path, tmp_path: Path, request: pytest.FixtureRequest
):
    cluster: Cluster = request.getfixturevalue(back_end)
    launcher = back_end.partition("_")[0]
    command = [*sweep_command(place / "data", 2, launcher), *cluster.overrides, "trainer.steps=200"]
    with group(command, tmp_path) as process:
        _wait_for(lambda: list(tmp_path.glob(f"results/runs/*/{CHECKPOINT}")) or process.poll() is not None)
        left = _at_work(tmp_path)
        assert left
        psutil.Process(process.pid).children()[0].send_signal(number)
        assert process.wait(PATIENCE) == 128 + number
    assert not _at_work(tmp_path)
    assert "the same command goes on from here" in (tmp_path / "said.txt").read_text()
    finish(command, tmp_path)
    logs = [log.read_text("utf-8") for log in tmp_path.glob("results/sweeps/*/logs/*.log")]
    assert any("training goes on from update" in log for log in logs)


@contextmanager
def _watched(command: list[str], folder: Path) -> Iterator[Callable[[], list[int]]]:
    """A command at work, killed at the end of the block; gives what waits for processes of its jobs to kill."""
    with group(command, folder) as process:

        def working() -> list[int]:
            found: list[int] = []
            _wait_for(lambda: found.extend(_at_work(folder)) or found or process.poll() is not None)
            assert found, (folder / "said.txt").read_text()[-3000:]
            return found

        yield working


def _finished(folder: Path) -> int:
    return len(list(folder.glob(f"results/runs/*/{SUMMARY}")))


def _at_work(folder: Path) -> list[int]:
    """The processes of a sweep's jobs, by their logs."""
    found = []
    for log in folder.glob("results/sweeps/*/logs/*.log"):
        for pid in re.findall(r"^---- \S+  process (\d+)  ", log.read_text("utf-8"), re.MULTILINE)[-1:]:
            with suppress(psutil.Error):
                if "gran_bench.sweep.remote" in psutil.Process(int(pid)).cmdline():
                    found.append(int(pid))
    return found


def _wait_for(is_so: Callable[[], object]) -> None:
    patience = time.monotonic() + PATIENCE
    while not is_so():
        assert time.monotonic() < patience
        time.sleep(0.1)


def _below(process: psutil.Process) -> list[psutil.Process]:
    with suppress(psutil.Error):
        return process.children(recursive=True)
    return []


def _said(*words: str) -> str:
    return subprocess.run(words, capture_output=True, text=True, timeout=60, check=False).stdout
