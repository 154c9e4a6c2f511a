"""SIGTERM and Ctrl-C as one polite request: finish the update, save, say how to go on."""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class StopRequest:
    """Whether someone asked this process to stop.

    Outside ``deferred()`` a signal interrupts at once (``KeyboardInterrupt``); inside it only sets
    ``requested``, so that the work in progress can reach a state worth saving. A second signal interrupts
    even there.
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
        """A stretch of work that polls ``requested`` itself."""
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Handle SIGTERM and SIGINT for the span of the block; the old handlers come back after it.

    Outside the main thread Python allows no handlers: there the request is never set.
    """
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
