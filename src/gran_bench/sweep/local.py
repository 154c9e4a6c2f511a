"""The jobs of a sweep on this machine, each forked from a process that has loaded what all of them need.

submitit's executor for one machine starts all jobs at once, each from nothing, and lets them go on when it is killed.
"""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from multiprocessing import connection, forkserver
from typing import Any

import psutil

from gran_bench.config.launchers import LocalConfig
from gran_bench.processes import WATCH_SECONDS
from gran_bench.sweep.launcher import JobLauncher, last_words
from gran_bench.sweep.task import GRACE_SECONDS, SAID, Task

LOST = 255  # what `multiprocessing` gives for a job whose fork server, which would know its exit code, is gone
MEMORY = "hydra.launcher.n_jobs=1"


class LocalLauncher(JobLauncher):
    """Start each job in a process of its own; it ends with this one."""

    schema = LocalConfig

    def prepare(self, modules: Sequence[str]) -> None:
        """Start the process that jobs are forked from, and let it load modules while this one goes on."""
        multiprocessing.get_context("forkserver").set_forkserver_preload(["gran_bench.entry", *modules])
        forkserver.ensure_running()

    def start(self, overrides: list[str], number: int) -> Any:
        process = multiprocessing.get_context("forkserver").Process(target=_run, args=(self.task, overrides, number))
        process.start()
        return process

    def ended(self, running: Mapping[int, Any]) -> dict[int, int | str]:
        connection.wait([process.sentinel for process in running.values()])
        found: dict[int, int | str] = {}
        for number, process in running.items():
            if process.is_alive():
                continue
            code = process.exitcode
            if code == LOST:  # it ends when it sees that, too
                with suppress(psutil.Error):
                    psutil.Process(process.pid).wait(GRACE_SECONDS)
                code = f"the process that jobs are forked from was ended (often a lack of memory; try {MEMORY})"
            found[number] = code if code in (0, SAID) or isinstance(code, str) else last_words(code, MEMORY)
        return found

    def stop(self, running: Mapping[int, Any]) -> None:
        for process in running.values():
            process.terminate()
        for process in running.values():
            process.join(GRACE_SECONDS)
            process.kill()
            process.join()


def _run(task: Task, overrides: list[str], number: int) -> None:
    threading.Thread(target=_stop_with, args=(multiprocessing.parent_process(), os.getppid()), daemon=True).start()
    sys.exit(task.exit_code(overrides, number))


def _stop_with(parent: Any, server: int) -> None:
    """Stop politely where a process that this one came from was killed: nobody waits for the job any more."""
    while os.getppid() == server and not connection.wait([parent.sentinel], WATCH_SECONDS):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
