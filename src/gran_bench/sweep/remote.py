"""A job of a sweep as it travels to another machine, where a process of its own does it.

The process beside it takes what a scheduler sends, and ends with the job; ``kill -9`` of either is the job's end.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gran_bench.processes import WATCH_SECONDS, Child, kill_group, start_module
from gran_bench.sweep.task import GRACE_SECONDS, Task

FORWARDED = ("MLFLOW_", "NUMBA_", "OMP_", "MKL_", "OPENBLAS_", "XDG_", "MPL")  # beginnings of variables


@dataclass
class RemoteJob:
    """A job: a call does it, and gives its exit code. It needs a file system that all machines share."""

    task: Task
    overrides: list[str]
    number: int
    place: Path  # where the command runs, from where its paths are
    environment: Mapping[str, str]  # that the job has beside its machine's
    _child: Child | None = field(default=None, compare=False)

    @classmethod
    def of(cls, task: Task, overrides: list[str], number: int, forward: bool) -> RemoteJob:
        """A job without what only this process can use; ``forward`` sends the environment of this process along."""
        if task.sweep is not None:  # configs are composed anew from the overrides
            jobs = tuple(replace(job, config=None, identity=None) for job in task.sweep.jobs)
            task = replace(task, sweep=replace(task.sweep, jobs=jobs, record=None))
        kept = {name: text for name, text in os.environ.items() if forward and name.startswith(FORWARDED)}
        environment = kept | {"HYDRA_FULL_ERROR": "1"}
        return cls(replace(task, failures=[]), overrides, number, Path.cwd(), environment)

    def __call__(self) -> int:
        """Do the job to its end, which is here where this process is interrupted."""
        import cloudpickle  # MLflow's, submitit's and Ray's; an entry's own function has no module to be found in

        self._child = start_module(
            "gran_bench.sweep.remote", environment=self.environment, cwd=self.place, stdin=subprocess.PIPE
        )
        try:
            with self._child.stdin as words:
                words.write(cloudpickle.dumps((self.task, self.overrides, self.number)))
            # A signal's handler stops the job, which `wait` would not let it do.
            while self._child.poll() is None:
                time.sleep(WATCH_SECONDS)
        except BaseException:
            self._stop()
            raise
        return self._child.returncode

    def checkpoint(self) -> Any:
        """What submitit calls before it requeues the job: stop it at a checkpoint; gives what goes on from there."""
        from submitit.helpers import DelayedSubmission

        self._stop()
        return DelayedSubmission(replace(self, _child=None))

    def _stop(self) -> None:
        if self._child is None:
            return
        self._child.terminate()
        try:
            self._child.wait(GRACE_SECONDS)
        except subprocess.TimeoutExpired:
            kill_group(self._child)


if __name__ == "__main__":
    # Slurm warns every process of a job, and the one that started this one stops it.
    signal.signal(signal.SIGUSR2, signal.SIG_IGN)
    done, words, which = pickle.load(sys.stdin.buffer)
    sys.exit(done.exit_code(words, which))
