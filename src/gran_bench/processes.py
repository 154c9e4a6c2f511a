"""Processes: children that end with whoever started them, and SIGTERM and Ctrl-C as one polite request.

A child gets a session of its own, where Ctrl-C and ``kill -9`` of its parent do not reach it. So it runs
``python -m gran_bench.processes``, which ends itself and its whole group once the parent is gone. A module of the
package runs in that process; any other command is started by it, and its exit code handed on.
"""

import argparse
import os
import runpy
import select
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any

import gran_bench

WATCH_SECONDS = 0.2  # between two looks whether the parent is still there
ONE_THREAD = {name: "1" for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
Child = subprocess.Popen


class MissingProgramError(RuntimeError):
    """A program that is needed is not installed; the message names it and the remedy."""


def start_module(module: str, *arguments: str, environment: Mapping[str, str] | None = None, **pipes: Any) -> Child:
    """A process of ``python -m module arguments`` of this package, found wherever the process works.

    The environment is added to the environment of this process; ``pipes`` are further keys of `subprocess.Popen`.
    """
    return _started(["-m", module, *arguments], environment, pipes)


def start_program(command: Sequence[str], environment: Mapping[str, str] | None = None, **pipes: Any) -> Child:
    """A process of any other command, as `start_module` does; a `MissingProgramError` where it is not installed."""
    require_program(command[0], "install it")
    return _started(["--", *command], environment, pipes)


def require_program(name: str, remedy: str) -> None:
    """Refuse, before any work and as a `MissingProgramError`, what needs a program that is not there."""
    if shutil.which(name) is None:
        raise MissingProgramError(f"{name} is not on this machine; {remedy}")


def watched(*words: str) -> list[str]:
    """The command line that ends with this process: of ``-m module …`` or ``-- command …``, in a session of its own."""
    return [sys.executable, "-P", "-m", "gran_bench.processes", str(os.getpid()), *words]


def _started(words: list[str], environment: Mapping[str, str] | None, pipes: dict[str, Any]) -> Child:
    sources = str(Path(gran_bench.__file__).parent.parent)
    paths = os.pathsep.join([sources, *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {"PYTHONPATH": paths} | dict(environment or {})
    return subprocess.Popen(watched(*words), env=environment, start_new_session=True, **pipes)


def kill_group(process: Child) -> None:
    """``kill -9`` of a process and of all in its group, where it has not ended by itself."""
    if process.poll() is None:  # once it is reaped, its number may be another's
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


class StopRequest:
    """Whether someone asked this process to stop.

    Outside ``deferred()`` a signal interrupts at once (``KeyboardInterrupt``); inside it only sets ``requested``, so
    that the work in progress can reach a state worth saving. A second signal interrupts even there.
    """

    def __init__(self) -> None:
        self.requested = False
        self.signal_name = ""
        self._deferring = False

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        again, self.requested = self.requested, True
        self.signal_name = signal.Signals(number).name
        if again or not self._deferring:
            raise KeyboardInterrupt(self.signal_name)

    @contextmanager
    def deferred(self) -> Iterator[None]:
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Handle SIGTERM and SIGINT for the span of the block; never set outside the main thread, which has no handlers."""
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    former = {number: signal.signal(number, request._on_signal) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield request
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


@contextmanager
def quiet_without_reader() -> Iterator[None]:
    """End the process in silence, with the exit code of SIGPIPE, where nobody reads stdout any more (``| head``)."""
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        look = select.poll()
        look.register(sys.stdout.fileno(), 0)
        if not any(event & select.POLLERR for _, event in look.poll(0)):
            raise  # of another pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at the end of Python
        sys.exit(128 + signal.SIGPIPE)


def tell(line: str) -> None:
    """One line on stderr, so that stdout holds tables alone."""
    print(line, file=sys.stderr, flush=True)


def run_command(
    parser: argparse.ArgumentParser, task: Callable[[argparse.Namespace], None], words: Sequence[str] | None
) -> int:
    """Do what a command line asks for, and say in a line what the house refuses or the disk does not take.

    The exit code is 1 where a file cannot be written, 2 where the house refuses.
    """
    try:
        with quiet_without_reader():
            task(parser.parse_args(words))
    except BrokenPipeError:
        raise
    except OSError as error:
        tell(f"error: {error.filename} cannot be written ({error.strerror or error}); choose another place")
        return 1
    except Exception as error:
        if not type(error).__module__.startswith("gran_bench."):
            raise
        tell(f"error: {error}")
        return 2
    return 0


def main(parent: int, words: list[str]) -> int:
    """Run a module here, or a command, to its end or until the parent is gone; the exit code as a shell gives it."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_SECONDS)
        os.killpg(0, signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()
    if words[0] == "-m":
        sys.argv = words[1:]
        runpy.run_module(words[1], run_name="__main__", alter_sys=True)
        return 0
    code = subprocess.run(words[1:], check=False).returncode
    return code if code >= 0 else 128 - code


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), sys.argv[2:]))
