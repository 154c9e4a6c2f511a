"""The launcher of processes: whatever ends one, the others go on, and nothing of it works on unseen."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass, field
from multiprocessing import forkserver
from pathlib import Path

import psutil
import pytest
from omegaconf import OmegaConf

from gran_bench.sweep.launcher import JobError
from gran_bench.sweep.local import LocalLauncher


@dataclass
class Stub:
    """Jobs that do what their overrides say.

    A number to exit with, ``orphan`` to lose their fork server, else a file to make.
    """

    folder: Path
    finished: tuple[int, ...] = ()
    ends: dict[int, str] = field(default_factory=dict)

    def nothing_to_do(self, number: int) -> bool:
        return number in self.finished

    def exit_code(self, overrides: list[str], number: int) -> int:
        (word,) = overrides
        if word == "orphan":
            (self.folder / "orphan").write_text(str(os.getpid()))
            os.kill(os.getppid(), signal.SIGKILL)
            time.sleep(60.0)
        if word.isdigit():
            os._exit(int(word))
        (self.folder / word).touch()
        return 0

    def recorded(self, number: int) -> bool:
        return True

    def died(self, number: int, why: str) -> None:
        self.ends[number] = why


@pytest.fixture
def launcher(tmp_path: Path):
    made = LocalLauncher(n_jobs=1)
    config = OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path)}}})
    made.setup(hydra_context=None, task_function=Stub(tmp_path), config=config)
    yield made
    # What the test started is not for the tests after it.
    forkserver._forkserver._stop()


@pytest.mark.parametrize("finished", [(0, 1, 2), (1, 2), (0, 1)])
def test_a_sweep_whose_last_jobs_or_all_have_nothing_to_do_ends(launcher: LocalLauncher, tmp_path: Path, finished):
    launcher.task.finished = finished
    assert len(launcher.launch([["one"], ["two"], ["three"]], 0)) == 3
    made = [path.name for path in tmp_path.iterdir()]
    assert sorted(made) == sorted({"one", "two", "three"} - {("one", "two", "three")[k] for k in finished})


def test_a_status_that_no_signal_gives_is_told_and_the_next_job_starts(launcher: LocalLauncher, tmp_path: Path):
    with pytest.raises(JobError, match="3 of 4 jobs failed"):
        launcher.launch([["255"], ["200"], ["137"], ["done"]], 0)
    lost, odd, stopped = (launcher.task.ends[number] for number in range(3))
    assert "forked from" in lost
    assert "status 200" in odd
    assert "SIGKILL" in stopped
    assert (tmp_path / "done").exists()


def test_a_job_whose_fork_server_is_gone_is_ended_and_the_next_goes_on(launcher: LocalLauncher, tmp_path: Path):
    with pytest.raises(JobError, match="1 of 2 jobs failed"):
        launcher.launch([["orphan"], ["done"]], 4)
    assert list(launcher.task.ends) == [4]
    assert "hydra.launcher.n_jobs=1" in launcher.task.ends[4]
    assert (tmp_path / "done").exists()
    orphan, patience = int((tmp_path / "orphan").read_text()), time.monotonic() + 30.0
    while psutil.pid_exists(orphan):
        assert time.monotonic() < patience
        time.sleep(0.05)
