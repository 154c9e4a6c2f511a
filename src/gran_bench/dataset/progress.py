"""One bar of simulated time for many jobs at once."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

from tqdm import tqdm


class SimulatedTimeBar:
    """A bar over the simulated seconds of all jobs; safe to feed from several threads.

    Args:
        jobs: everything that will run, each with its ``simulated_seconds``; none draws no bar.
        show: False never draws; True draws where there is a terminal.
    """

    def __init__(self, jobs: Sequence[Any], show: bool) -> None:
        self._expected = {id(job): job.simulated_seconds for job in jobs}
        self._covered = dict.fromkeys(self._expected, 0.0)
        self._done, self._lock = 0, threading.Lock()
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

    def reached(self, job: Any, seconds: float) -> None:
        """``job`` has simulated ``seconds`` so far; a bed that takes longer than expected stretches the bar."""
        with self._lock:
            self._bar.total += max(0.0, seconds - self._expected[id(job)])
            self._expected[id(job)] = max(seconds, self._expected[id(job)])
            self._bar.update(seconds - self._covered[id(job)])
            self._covered[id(job)] = seconds

    def finished(self, job: Any) -> None:
        """``job`` is done, whoever did it."""
        self.reached(job, self._expected[id(job)])
        with self._lock:
            self._done += 1
            self._bar.set_postfix_str("", refresh=False)
            self._bar.set_description_str(self._description())

    def waits(self, job: Any) -> None:
        """``job`` waits for another process that is making the same file."""
        with self._lock:
            self._bar.set_postfix_str("waiting for another process")

    def _description(self) -> str:
        return f"data {self._done}/{len(self._expected)} files"
