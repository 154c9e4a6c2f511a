"""The processes of a benchmark: hired one a method, asked in turn, ended at its end or when they take too long."""

from __future__ import annotations

import json
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from gran_bench.processes import ONE_THREAD, start_module

PATIENCE = 3600.0  # s that a method may prepare itself, or take for one run: the slowest take minutes
SHUTDOWN = 10.0  # s that a process is given to end, once it has closed its pipe


@contextmanager
def crew() -> Iterator[Callable[[], subprocess.Popen]]:
    """Start processes on request, and end all of them when the block ends in any way."""
    hired: list[subprocess.Popen] = []

    def hire() -> subprocess.Popen:
        complaints = tempfile.TemporaryFile()  # noqa: SIM115 (lives as long as its worker)
        worker = start_module(
            "gran_bench.benchmark.worker",
            environment=ONE_THREAD,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=complaints,
            text=True,
        )
        worker.complaints = complaints
        hired.append(worker)
        return worker

    try:
        yield hire
    finally:
        for worker in hired:
            worker.kill()
            worker.wait()
            with suppress(BrokenPipeError):
                worker.stdin.close()
            worker.stdout.close()
            worker.complaints.close()


def ask(worker: subprocess.Popen, request: dict[str, Any], patience: float = PATIENCE) -> dict[str, Any]:
    """A worker's answer; ``died`` and why, where none came.

    Args:
        worker: a process that answers a line of JSON with one.
        request: plain data.
        patience: s; a worker that takes longer is ended.
    """
    late = threading.Event()

    def end() -> None:
        late.set()
        worker.kill()

    clock = threading.Timer(patience, end)
    clock.daemon = True  # an interrupted benchmark does not wait for it
    clock.start()
    line = ""
    try:
        worker.stdin.write(json.dumps(request) + "\n")
        worker.stdin.flush()
        line = worker.stdout.readline()
    except BrokenPipeError:
        pass
    finally:
        clock.cancel()
    if late.is_set():
        return {"died": f"no end within {patience:g} s"}
    if line.endswith("\n"):
        return _answer(worker, line)
    return {"died": _last_words(worker)}


def _answer(worker: subprocess.Popen, line: str) -> dict[str, Any]:
    with suppress(ValueError):
        return json.loads(line)
    worker.kill()  # whatever it says next would be taken for the answer to another request
    return {"died": f"its answer is no line of JSON: {line.strip()[:80]}"}


def _last_words(worker: subprocess.Popen) -> str:
    """How a process ended that closed its pipe, with a part of an answer or none."""
    with suppress(subprocess.TimeoutExpired):
        worker.wait(SHUTDOWN)
    worker.kill()
    if worker.wait() < 0:
        return f"its process was ended by signal {-worker.returncode}"
    worker.complaints.seek(0)
    words = worker.complaints.read().decode(errors="replace").strip().splitlines()
    return words[-1] if words else f"its process ended with status {worker.returncode}"
