"""One bar of simulated time for many jobs at once."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any, Protocol

from tqdm import tqdm


class Timed(Protocol):
    """A job that simulates for a known time."""

    @property
    def simulated_seconds(self) -> float:
        """s."""


class SimulatedTimeBar:
    """A bar over the simulated seconds of all jobs; safe to feed from several threads.

    Args:
        jobs: everything that will run; none draws no bar.
        show: False never draws; True draws where there is a terminal.
    """

    def __init__(self, jobs: Sequence[Timed], show: bool) -> None:
        self._covered: dict[int, float] = {id(job): 0.0 for job in jobs}
        self._expected = {id(job): job.simulated_seconds for job in jobs}
        self._done, self._count = 0, len(jobs)
        self._lock = threading.Lock()
        self._bar = tqdm(
            total=round(sum(self._expected.values()), 6),
            desc=self._description(),
            disable=None if show and jobs else True,
            bar_format="{desc}: {percentage:3.0f}%|{bar}| {n:.1f}/{total:.1f} s simulated "
            "[{elapsed}<{remaining}{postfix}]",
        )

    def __enter__(self) -> SimulatedTimeBar:
        return self

    def __exit__(self, *exception: Any) -> None:
        self._bar.close()

    def reached(self, job: Timed, seconds: float) -> None:
        """``job`` has simulated ``seconds`` so far; a bed that takes longer than expected stretches the bar."""
        with self._lock:
            key = id(job)
            if seconds > self._expected[key]:
                self._bar.total += seconds - self._expected[key]
                self._expected[key] = seconds
            self._bar.update(seconds - self._covered[key])
            self._covered[key] = seconds

    def finished(self, job: Timed) -> None:
        """``job`` is done, whoever did it."""
        self.reached(job, self._expected[id(job)])
        with self._lock:
            self._done += 1
            self._bar.set_postfix_str("", refresh=False)
            self._bar.set_description_str(self._description())

    def waits(self, job: Timed) -> None:
        """``job`` waits for another process that is making the same file."""
        with self._lock:
            self._bar.set_postfix_str("waiting for another process")

    def _description(self) -> str:
        return f"data {self._done}/{self._count} files"
