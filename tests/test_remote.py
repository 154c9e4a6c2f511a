"""A job that travels: its exit code, its place and environment, and that it is stopped with whoever started it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cloudpickle
import psutil
import pytest

from gran_bench.compose import Source
from gran_bench.config import TrainConfig
from gran_bench.config.rules import ConfigError
from gran_bench.sweep.launcher import last_words
from gran_bench.sweep.remote import RemoteJob
from gran_bench.sweep.runs import SweepJob
from gran_bench.sweep.task import SAID, Sweep, Task

# As a scheduler's process on another machine: it knows of the job what it was sent.
ELSEWHERE = "import pickle, sys; job = pickle.load(sys.stdin.buffer); sys.exit(job())"


def remote(folder: Path, *overrides: str, sweep: Sweep | None = None) -> RemoteJob:
    """A job that does what its seed says, and leaves a file that says where."""

    def work(config: TrainConfig) -> None:  # within a function, so that it has no module that a child could import
        if config.seed == 1:
            raise ConfigError("seed=1 is odd; choose an even one")
        Path("left.txt").write_text(f"{os.getpid()} {config.seed} {os.environ.get('MLFLOW_TRACKING_URI')}")
        if config.seed == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        if config.seed == 4:
            time.sleep(600.0)

    task = Task(work, Source("train"), TrainConfig, ["train"], sweep)
    return RemoteJob(task, [*overrides], 0, folder, {"MLFLOW_TRACKING_URI": "http://server:5000"})


def test_a_job_gives_its_exit_code_and_works_where_its_command_did(tmp_path: Path, capfd: pytest.CaptureFixture):
    assert remote(tmp_path, "seed=0")() == 0
    assert (tmp_path / "left.txt").read_text().endswith(" 0 http://server:5000")
    assert remote(tmp_path, "seed=1")() == SAID
    assert "seed=1 is odd; choose an even one" in capfd.readouterr().err
    killed = remote(tmp_path, "seed=2")()
    assert "signal 9 (often a lack of memory; try less)" in last_words(killed, "less")


@pytest.mark.parametrize(("by", "code"), [(signal.SIGINT, 128 + signal.SIGINT), (signal.SIGKILL, -signal.SIGKILL)])
def test_a_job_ends_with_the_process_that_a_scheduler_started(tmp_path: Path, by: signal.Signals, code: int):
    process = subprocess.Popen([sys.executable, "-c", ELSEWHERE], stdin=subprocess.PIPE)
    with process.stdin as words:
        words.write(cloudpickle.dumps(remote(tmp_path, "seed=4")))
    left, patience = tmp_path / "left.txt", time.monotonic() + 60.0
    while not left.exists() or not left.read_text():
        assert process.poll() is None
        assert time.monotonic() < patience
        time.sleep(0.05)
    child = int(left.read_text().split()[0])
    process.send_signal(by)
    assert process.wait(60.0) in (code, -by)
    while psutil.pid_exists(child):
        assert time.monotonic() < patience
        time.sleep(0.05)


def test_a_job_takes_neither_configs_nor_what_this_process_alone_can_use_along(tmp_path: Path):
    job = SweepJob("one", {"seed": "0"}, 0, key="k", config=TrainConfig, identity=object())
    sweep = Sweep(tmp_path, (job,), record=lambda number: None, files_only=True)
    task = Task(print, Source("train"), TrainConfig, ["train"], sweep, [ValueError("of another job")])
    sent = RemoteJob.of(task, ["seed=0"], 0, forward=False).task
    assert sent.failures == []
    assert sent.sweep.record is None
    assert (sent.sweep.jobs[0].config, sent.sweep.jobs[0].identity, sent.sweep.jobs[0].key) == (None, None, "k")
    assert sweep.jobs[0].config is TrainConfig
