"""Stress cases in processes of their own: one that crashes, or hangs, costs its own case and no other."""

from __future__ import annotations

import json
import subprocess
import threading
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from gran_bench.processes import kill_group, start_module
from gran_bench.stress.expectation import Failure, Observation, Outcome
from gran_bench.stress.perform import Task


class Worker:
    """A process that carries out one task after another; started when it is needed, and anew after a crash.

    Args:
        patience: s that a task may take.
    """

    def __init__(self, patience: float) -> None:
        self.patience = patience
        self._process: subprocess.Popen[str] | None = None

    def perform(self, task: Task) -> Outcome:
        """The outcome of a task; a crash and a task without end are failures."""
        process = self._running()
        late = threading.Event()

        def give_up() -> None:
            late.set()
            kill_group(process)

        watch = threading.Timer(self.patience, give_up)
        watch.daemon = True
        watch.start()
        try:
            process.stdin.write(json.dumps(asdict(task)) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except BrokenPipeError:
            line = ""
        finally:
            watch.cancel()
        if line:
            return outcome_of(json.loads(line))
        status = process.wait()
        if late.is_set():
            return Failure("Hang", f"no end after {self.patience:g} s; its process was killed")
        return Failure("Crash", f"its process ended with status {status}")

    def dismiss(self) -> None:
        """End the process, whatever it does."""
        if self._process is not None:
            kill_group(self._process)
            for pipe in (self._process.stdin, self._process.stdout):
                pipe.close()
            self._process = None

    def _running(self) -> subprocess.Popen[str]:
        if self._process is None or self._process.poll() is not None:
            self.dismiss()
            self._process = start_module(
                "gran_bench.stress.worker",
                environment={"OMP_NUM_THREADS": "1"},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
            )
        return self._process


def outcome_of(document: Mapping[str, Any]) -> Outcome:
    """An outcome from its JSON."""
    if "failure" in document:
        return Failure(**document["failure"])
    values = document["observation"]
    return Observation(values["quantities"], tuple(values["flags"]), values["curves"], values["unflagged"])
