"""The processes of a benchmark: hired one a method, asked in turn, ended at its end or when they take too long."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import gran_bench

PATIENCE = 3600.0  # s that a method may prepare itself, or take for one run: the slowest take minutes
SHUTDOWN = 10.0  # s that a process is given to end, once it has closed its pipe
_ONE_THREAD = {name: "1" for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
_ONE_THREAD |= {"MKL_NUM_THREADS": "1"}


@contextmanager
def crew() -> Iterator[Callable[[], subprocess.Popen]]:
    """Hires processes, and ends all of them when the block ends in any way."""
    sources = str(Path(gran_bench.__file__).parent.parent)
    paths = os.pathsep.join([sources, *filter(None, [os.environ.get("PYTHONPATH")])])
    hired: list[subprocess.Popen] = []

    def hire() -> subprocess.Popen:
        complaints = tempfile.TemporaryFile()  # noqa: SIM115 (lives as long as its worker)
        worker = subprocess.Popen(
            [sys.executable, "-m", "gran_bench.comparison.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=complaints,
            text=True,
            env=os.environ | _ONE_THREAD | {"PYTHONPATH": paths},
            start_new_session=True,  # Ctrl-C is for the parent, which then ends its workers
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
