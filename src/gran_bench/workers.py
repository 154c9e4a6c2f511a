"""Processes that answer a line of JSON with one: one that crashes, or hangs, costs its own task and no other."""

import json
import os
import select
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import Any

from gran_bench.processes import ONE_THREAD, kill_group, start_module

SHUTDOWN = 10.0  # s that a process is given to end, once it has closed its pipe


class Worker:
    """A process of a module that calls `serve`, with an environment beside this one's; anew after each end."""

    def __init__(self, module: str, environment: Mapping[str, str] = ONE_THREAD) -> None:
        self._module, self._environment = module, environment
        self._process: subprocess.Popen[str] | None = None
        self._complaints: Any = None

    def ask(self, request: Mapping[str, Any], patience: float) -> dict[str, Any]:
        """The answer to a request of plain data; ``died`` with why, and ``late``, where none came in time (s)."""
        process, line = self._running(), ""
        with suppress(BrokenPipeError):
            process.stdin.write(json.dumps(request) + "\n")
            process.stdin.flush()
        late = not select.select([process.stdout], [], [], patience)[0]
        if not late and (line := process.stdout.readline()).endswith("\n"):
            with suppress(ValueError):
                return json.loads(line)
        why = f"no end within {patience:g} s"
        if not late:
            why = f"its answer is no line of JSON: {line.strip()[:80]}" if line.endswith("\n") else self._last_words()
        self.end()  # whatever it says next would be taken for the answer to another request
        return {"died": why, "late": late}

    def end(self) -> None:
        """End the process, whatever it does."""
        if self._process is not None:
            kill_group(self._process)
            with suppress(BrokenPipeError):
                self._process.stdin.close()
            self._process.stdout.close()
            self._complaints.close()
            self._process = None

    def _running(self) -> subprocess.Popen[str]:
        if self._process is None or self._process.poll() is not None:
            self.end()
            self._complaints = tempfile.TemporaryFile()  # noqa: SIM115 (lives as long as the process)
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": self._complaints, "text": True}
            self._process = start_module(self._module, environment=self._environment, **pipes)
        return self._process

    def _last_words(self) -> str:
        """How a process ended that closed its pipe, with a part of an answer or none."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(SHUTDOWN)
        kill_group(self._process)
        if self._process.returncode < 0:
            return f"its process was ended by signal {-self._process.returncode}"
        self._complaints.seek(0)
        words = self._complaints.read().decode(errors="replace").strip().splitlines()
        return words[-1] if words else f"its process ended with status {self._process.returncode}"


@contextmanager
def crew(workers: Sequence[Worker], at_a_time: int) -> Iterator[ThreadPoolExecutor]:
    """Threads that ask workers; the end of the block ends all, even those that an answer is awaited from."""
    threads = ThreadPoolExecutor(at_a_time)
    try:
        yield threads
    finally:
        threads.shutdown(wait=False, cancel_futures=True)  # nobody waits for what an interruption ends
        for worker in workers:
            worker.end()
        threads.shutdown()


def serve(answer: Callable[[dict[str, Any]], Mapping[str, Any]]) -> None:
    """Answer requests until the parent closes the pipe or is gone."""
    # Whatever a library prints must not get between the lines of JSON.
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    try:
        for line in sys.stdin:
            channel.write(json.dumps(answer(json.loads(line))) + "\n")
    except BrokenPipeError:
        os._exit(1)  # the parent is gone; closing the channel would fail once more
