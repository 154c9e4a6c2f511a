"""The unit of error: distances between runs of the DEM, with as many spheres as the candidate has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gran_bench.metrics.comparisons import Comparison
from gran_bench.metrics.measured import Measured, mean_of
from gran_bench.metrics.position_error import divergence_horizon, mean_spread
from gran_bench.metrics.summary import TrajectorySummary
from gran_bench.state import FloatArray

REPLICAS, PACKINGS = "replicas", "packings"


@dataclass(frozen=True)
class Floor:
    """Runs of the DEM whose mean distance is one noise floor.

    Speeds of n spheres scatter by sampling alone. So where a candidate has fewer spheres, one run of each pair is
    thinned to as many.
    """

    runs: Sequence[TrajectorySummary]
    thinned: Sequence[TrajectorySummary]  # the same, of as many spheres as the candidate has
    between: str  # ``replicas``, or ``packings`` where nudges hardly grow
    spheres: int  # of the candidate
    _known: dict[tuple[str, int, int], Measured] = field(default_factory=dict)

    @classmethod
    def of_runs(cls, runs: Sequence[TrajectorySummary], spheres: int, between: str = REPLICAS) -> Floor:
        """The floor beside a candidate of so many spheres."""
        return cls(runs, [thinned(run, spheres) for run in runs], between, spheres)

    @property
    def words(self) -> str:
        """What the distances are between."""
        full = self.runs[0].sorted_speed.shape[1]
        less = f", one thinned to {self.spheres} of {full} spheres" if self.spheres < full else ""
        return f"{self.between}{less}"

    def of(self, row: Comparison) -> Measured:
        """Mean over all ordered pairs of different runs of the distance; undefined below two runs."""
        if len(self.runs) < 2:
            run = "replica" if self.between == REPLICAS else "packing"
            return Measured.undefined(row.unit, f"a single {run} has no noise floor; make two or more")
        return mean_of([error for k in range(len(self.runs)) for error in self._errors(row, k)], row.unit)

    def own(self, row: Comparison) -> list[Measured]:
        """The error of each run from the others, as if it were a candidate; none of a single one."""
        count = len(self.runs) if len(self.runs) > 1 else 0
        return [mean_of(self._errors(row, k), row.unit) for k in range(count)]

    def _errors(self, row: Comparison, k: int) -> list[Measured]:
        return [self._distance(row, k, i) for i in range(len(self.runs)) if i != k]

    def _distance(self, row: Comparison, k: int, i: int) -> Measured:
        """Computed once; of runs that are not thinned it is the same both ways."""
        first, second = (k, i) if self.thinned[k] is not self.runs[k] else sorted((k, i))
        if (row.key, first, second) not in self._known:
            self._known[row.key, first, second] = row.distance(self.thinned[first], self.runs[second])
        return self._known[row.key, first, second]


def nudges_grow(replicas: Sequence[TrajectorySummary]) -> bool:
    """Whether replicas are 0.1 d apart in the mean by the middle of the scene, as in a flow.

    In a bed that comes to rest they stay together; where they separate late, their distances say little of the flow.
    """
    positions = [run.position for run in replicas]
    if len(positions) < 2 or any(position is None for position in positions):
        return True
    shared = min(map(len, positions))
    spread = mean_spread([position[:shared] for position in positions], replicas[0].period)
    horizon = divergence_horizon(spread, replicas[0].diameter)
    return horizon is not None and horizon <= shared // 2


def thinned(run: TrajectorySummary, spheres: int) -> TrajectorySummary:
    """A run whose speeds are those of ``spheres`` of its spheres, others in each state; itself where it has no more.

    Which ones does not depend on the run. Only distributions of speed are of fewer spheres.
    """
    count = run.sorted_speed.shape[1]
    if spheres >= count:
        return run
    rng = np.random.default_rng(spheres)
    chosen = np.sort(np.argsort(rng.random((len(run.time), count)), axis=1)[:, :spheres], axis=1)

    def some(values: FloatArray) -> FloatArray:
        return np.take_along_axis(values, np.broadcast_to(chosen, (*values.shape[:-1], spheres)), axis=-1)

    return replace(run, sorted_speed=some(run.sorted_speed), sorted_component=some(run.sorted_component))


def beside_floor(
    candidate: TrajectorySummary, replicas: Sequence[TrajectorySummary], packings: Sequence[TrajectorySummary] = ()
) -> tuple[TrajectorySummary, Floor]:
    """A candidate and its floor: between packings where nudges do not grow; with as many spheres on both sides.

    A candidate of more spheres than the replicas is thinned itself.
    """
    count = replicas[0].sorted_speed.shape[1]
    still = len(packings) > 1 and not nudges_grow(replicas)
    runs, between = (packings, PACKINGS) if still else (replicas, REPLICAS)
    mine = thinned(candidate, count)
    return mine, Floor.of_runs(runs, mine.sorted_speed.shape[1], between)
