"""Skin and threads of the fast engine, chosen by the clock while the run goes on; neither changes a bit of the result.

Every stretch is timed. A better neighbour of the present choice is looked for at the start and again from time to time:
a bed that falls wants another skin than one that rests, and a machine that others use another number of threads.
"""

from __future__ import annotations

from dataclasses import replace

import numba

from gran_bench.dem.fast.engine import chunk_bounds
from gran_bench.dem.integrate import Physics

# Tried skins, as shares of the usual one.
SKIN_SHARES = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)
STRETCHES_A_TRIAL = 2  # the faster counts: what disturbs a stretch makes it slower
STRETCHES_BETWEEN = 40  # until the neighbours are tried again
WORTH_CHANGING = 0.97  # of the time of the present choice


def available_threads() -> int:
    """Cores that Numba may use: those of this process, or NUMBA_NUM_THREADS."""
    return int(numba.config.NUMBA_NUM_THREADS)


class Tuner:
    """Gives each stretch of N particles its skin and threads, and learns from the time that it took.

    The skin of ``physics`` is the usual one, which stays where the user chose it; so do threads unless None.
    """

    def __init__(self, physics: Physics, count: int, skin_is_given: bool, threads: int | None) -> None:
        self._physics, self._usual_skin = physics, physics.skin
        most = min(len(chunk_bounds(count)) - 1, available_threads())
        fitting = tuple(s for s in SKIN_SHARES if s <= 1.0 or physics.period == 0.0)
        self._skins = (1.0,) if skin_is_given else fitting
        self._threads = tuple(2**k for k in range(most.bit_length()) if 2**k <= most) if threads is None else (threads,)
        self._choice = (self._skins.index(1.0), 0)
        self._trials: list[tuple[int, int]] = [self._choice]
        self._times: dict[tuple[int, int], float] = {}
        self._stretches = 0

    @property
    def physics(self) -> Physics:
        """What the next stretch is run with."""
        return self._with(self._trials[0] if self._trials else self._choice)

    @property
    def chosen(self) -> Physics:
        """The best so far."""
        return self._with(self._choice)

    def took(self, seconds: float) -> None:
        """Learns that a stretch took so long, in s."""
        self._stretches += 1
        if not self._trials:
            if self._stretches >= STRETCHES_BETWEEN and len(self._skins) + len(self._threads) > 2:
                self._times, self._trials, self._stretches = {}, [self._choice], 0
            return
        trial = self._trials[0]
        self._times[trial] = min(seconds, self._times.get(trial, seconds))
        if self._stretches < STRETCHES_A_TRIAL:
            return
        self._stretches = 0
        self._trials.pop(0)
        best = min(self._times, key=self._times.__getitem__)
        if self._times[best] < WORTH_CHANGING * self._times.get(self._choice, float("inf")):
            self._choice, self._trials = best, []
        if not self._trials:
            self._trials = [near for near in self._neighbors() if near not in self._times]

    def _neighbors(self) -> list[tuple[int, int]]:
        skin, threads = self._choice
        around = [(skin, threads + 1), (skin, threads - 1), (skin + 1, threads), (skin - 1, threads)]
        return [(s, t) for s, t in around if 0 <= s < len(self._skins) and 0 <= t < len(self._threads)]

    def _with(self, choice: tuple[int, int]) -> Physics:
        skin, threads = self._skins[choice[0]] * self._usual_skin, self._threads[choice[1]]
        return replace(self._physics, skin=skin, threads=threads)
