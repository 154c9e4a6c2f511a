"""``hydra/launcher=local``: the jobs of a multirun in processes of their own, a few at a time, none at another's mercy.

A pool of workers would die as a whole where the system kills one of them. Here a job that is killed is a failed job,
and the others go on. Processes are forked from one that has loaded PyTorch and the rest already, so a start is quick;
it has done no work, so no thread and no lock of it is inherited.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from multiprocessing import connection, forkserver
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from gran_bench.compose import LAUNCHER
from gran_bench.sweep.task import Task

SAID = 3  # exit code of a job's process that failed and said so; Python itself ends with 1
LOST = 255  # what `multiprocessing` gives for a job whose fork server, which would know its exit code, is gone
GRACE_SECONDS = 60.0  # for jobs that were asked to stop: an update, a checkpoint, a last word to the store


class JobError(RuntimeError):
    """A job of a multirun failed; what went wrong was said where it happened."""


class ProcessLauncher(Launcher):
    """Start each job in a process of its own, ``n_jobs`` at a time."""

    def __init__(self, n_jobs: int = 2) -> None:
        self.n_jobs = max(1, n_jobs)
        self.task: Task | None = None
        self.sweep_dir = Path()

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self.task, self.sweep_dir = task_function, Path(str(config.hydra.sweep.dir))

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run jobs, numbered from the initial one, to their end, whoever fails: a `JobError` then, or a stop."""
        self.sweep_dir.mkdir(parents=True, exist_ok=True)
        waiting = [(initial_job_idx + i, list(overrides)) for i, overrides in enumerate(job_overrides)]
        results = [JobReturn(overrides=overrides, status=JobStatus.COMPLETED) for _, overrides in waiting]
        context, running, failed = multiprocessing.get_context("forkserver"), {}, 0
        try:
            while waiting or running:
                while waiting and len(running) < self.n_jobs:
                    number, overrides = waiting.pop(0)
                    if (reason := self.task.nothing_to_do(number)) is not None:
                        print(reason, file=sys.stderr, flush=True)
                        continue
                    running[number] = context.Process(target=_run, args=(self.task, overrides, number))
                    running[number].start()
                if not running:  # none of the rest had anything to do, and no end of theirs would come
                    break
                connection.wait([process.sentinel for process in running.values()])
                for number in [number for number, process in running.items() if not process.is_alive()]:
                    process = running.pop(number)
                    if process.exitcode == LOST:
                        _end_lost(process.pid)
                    if process.exitcode not in (0, SAID):
                        self.task.died(number, _last_words(process.exitcode))
                    failed += process.exitcode != 0
        except BaseException:
            _stop(list(running.values()))
            raise
        if failed:
            raise JobError(f"{failed} of {len(results)} jobs failed")
        return results


def register_launcher() -> None:
    """Let Hydra make the launcher that ``hydra/launcher=local`` names."""
    plugins = Plugins.instance()
    plugins.register(ProcessLauncher)
    plugins.class_name_to_class[LAUNCHER] = ProcessLauncher


def load_ahead(modules: Sequence[str]) -> None:
    """Start the process that jobs are forked from, and let it load modules while this one goes on."""
    multiprocessing.get_context("forkserver").set_forkserver_preload(["gran_bench.entry", *modules])
    forkserver.ensure_running()


def _run(task: Task, overrides: list[str], number: int) -> None:
    """The whole life of a job's process."""
    threading.Thread(target=_stop_with, args=(multiprocessing.parent_process(),), daemon=True).start()
    try:
        code = 0 if task.apart(overrides, number) else SAID
    except KeyboardInterrupt as stop:
        code = 128 + getattr(signal.Signals, str(stop), signal.SIGINT)
    sys.stdout.flush()
    sys.exit(code)


def _stop_with(parent: Any) -> None:
    """Stop politely where the process that started this one was killed: nobody waits for the job any more."""
    connection.wait([parent.sentinel])
    os.kill(os.getpid(), signal.SIGTERM)


def _stop(processes: Sequence[ForkServerProcess]) -> None:
    """Ask jobs to stop, and wait for them."""
    for process in processes:
        process.terminate()
    for process in processes:
        process.join(GRACE_SECONDS)
        if process.is_alive():
            process.kill()
            process.join()


def _end_lost(pid: int) -> None:
    """End a process whose fork server is gone: it may go on, and its run must not be done twice at a time."""
    patience = time.monotonic() + GRACE_SECONDS
    try:
        os.kill(pid, signal.SIGTERM)
        while time.monotonic() < patience:
            os.kill(pid, 0)  # whether it is there
            time.sleep(0.05)
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        pass


def _last_words(code: int) -> str:
    """Why a process ended without a word of its own."""
    if code == LOST:
        return "the process that jobs are forked from was ended (often a lack of memory; try hydra.launcher.n_jobs=1)"
    if code < 0:
        return f"its process was ended by signal {-code} (9: often a lack of memory; try hydra.launcher.n_jobs=1)"
    if code - 128 in signal.valid_signals():
        return f"it was stopped by {signal.Signals(code - 128).name}"
    return f"its process ended with status {code}"
