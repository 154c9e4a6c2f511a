"""What the jobs of a sweep need of it, and what they do for it: their logs, and the files that say how they ended."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

from gran_bench.provenance import command
from gran_bench.run.record import finished_summary, tell
from gran_bench.sweep.runs import SweepRun, failed_run, finished_run, now
from gran_bench.sweep.sweep_file import SweepJob


@dataclass(frozen=True)
class Sweep:
    """What a job needs of its sweep; plain data.

    Attributes:
        folder: of the sweep, absolute.
        jobs: of the sweep, by number.
        parent: id of the parent run; None without tracking.
        done: why a job has nothing to do, by number.
        hashes: of the source that the sweep began with.
    """

    folder: Path
    jobs: tuple[SweepJob, ...]
    parent: str | None = None
    done: dict[int, str] = field(default_factory=dict)
    hashes: dict[str, str] = field(default_factory=dict)

    def title(self, number: int) -> str:
        """A job for people."""
        return f"job {number + 1} of {len(self.jobs)} ({self.jobs[number].run})"

    @contextmanager
    def logged(self, number: int, apart: bool) -> Iterator[None]:
        """What the block prints goes into the job's log; in a process of its own there alone, else beside the terminal.

        Args:
            number: of the job.
            apart: whether this process does nothing else than the job.
        """
        path = self.folder / self.jobs[number].log_name
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "a", buffering=1, encoding="utf-8") as log:
            log.write(f"---- {now()}  process {os.getpid()}  {command()}\n")
            if not apart:
                with redirect_stdout(_Both(sys.stdout, log)), redirect_stderr(_Both(sys.stderr, log)):
                    yield
                return
            sys.stdout.flush()
            terminal = os.dup(1), os.dup(2)
            os.dup2(log.fileno(), 1)
            os.dup2(log.fileno(), 2)
            try:
                try:
                    yield
                finally:
                    sys.stdout.flush()
            finally:  # on a full disk that flush fails, and the terminal has to hear of it
                for descriptor, saved in enumerate(terminal, start=1):
                    os.dup2(saved, descriptor)
                    os.close(saved)

    def finished(self, number: int, summary: dict[str, Any]) -> SweepRun:
        """Keep what a job found."""
        left = finished_run(self.jobs[number], summary)
        left.write(self.folder)
        return left

    def finished_unrecorded(self, number: int) -> bool:
        """Keep what a job found whose record the tracking store did not take; whether it found anything."""
        identity = self.jobs[number].identity
        summary = None if identity is None else finished_summary(identity)
        if summary is not None:
            self.finished(number, summary)
        return summary is not None

    def failed(self, number: int, reason: str, into_log: bool = False) -> None:
        """Keep why a job failed.

        Args:
            number: of the job.
            reason: for people.
            into_log: whether the job's log has not heard of it.
        """
        job = self.jobs[number]
        if into_log:
            with suppress(OSError), open(self.folder / job.log_name, "a", encoding="utf-8") as log:
                log.write(f"error: {reason}\n")
        try:
            failed_run(job, reason).write(self.folder)
        except OSError as error:  # of a full disk, say: the reason stands on the terminal and in the log
            tell(f"{self.title(number)}: its failure could not be kept in {self.folder}: {error}")


class _Both:
    """A stream that writes to the terminal and, line by line, to a log; progress bars are for the terminal alone."""

    def __init__(self, terminal: TextIO, log: TextIO) -> None:
        self._terminal, self._log = terminal, log

    def write(self, text: str) -> int:
        if "\r" not in text:
            self._log.write(text)
        return self._terminal.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._terminal, name)
