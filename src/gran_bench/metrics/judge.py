"""The judge: one candidate against the replicas of the DEM, every figure in its unit and in noise floors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gran_bench.metrics.acceptance import acceptance
from gran_bench.metrics.comparisons import COMPARISONS, FIGURES, Figure
from gran_bench.metrics.judgement import ErrorRow, FigureRow, Judgement
from gran_bench.metrics.measured import Measured, mean_of
from gran_bench.metrics.noise_floor import noise_floor, prediction_interval, score
from gran_bench.metrics.speeds import sorted_frames, velocities, wasserstein_series
from gran_bench.metrics.summary import TrajectorySummary, summarise
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, Trajectory


def judge(
    candidate: Trajectory | TrajectorySummary,
    replicas: Sequence[Trajectory | TrajectorySummary],
    scene: Scene,
    others: Mapping[str, Trajectory | TrajectorySummary] | None = None,
) -> Judgement:
    """Hold a candidate against the replicas of the DEM.

    Velocities are compared by the candidate's definition on both sides. Summaries may be given instead of
    trajectories, so that replicas are summarised once for many candidates; they must then have that definition.

    Args:
        candidate: a rollout, another run of the DEM, or a baseline's statistics.
        replicas: runs of the DEM from one settled state; two or more for a noise floor.
        scene: that all were made for.
        others: further runs of the DEM by name, each a column of its own beside the noise floor.

    Raises:
        ValueError: no replica, states at different times, or definitions of velocity that do not fit.
    """
    if not replicas:
        raise ValueError("no replica to judge against; make at least one run of the DEM")
    kind = candidate.velocity_kind
    mine = _summary(candidate, scene, kind)
    truth = [_summary(replica, scene, kind) for replica in replicas]
    beside = {name: _summary(run, scene, kind) for name, run in (others or {}).items()}
    return Judgement(
        errors=[
            ErrorRow(
                row.key,
                row.label,
                row.unit,
                score(row.distance, mine, truth, row.unit),
                noise_floor(row.distance, truth, row.unit),
                {name: score(row.distance, run, truth, row.unit) for name, run in beside.items()},
            )
            for row in COMPARISONS
        ],
        figures=[_figure_row(row, mine, truth) for row in FIGURES],
        requirements=acceptance(mine, truth),
        failures=mine.failures,
        dem_outside=_share_outside(truth),
        velocity_kind=kind,
        replicas=len(truth),
    )


def nearest_case(
    candidate: Trajectory, cases: Mapping[float, Trajectory], period: float = 0.0
) -> tuple[float | None, dict[float, Measured]]:
    """The case of the DEM that a rollout is most like: smallest speed W1 a frame.

    Args:
        candidate: a rollout.
        cases: runs of the DEM by speed, rpm.
        period: of the y axis, m.

    Returns:
        The nearest case's speed in rpm, None where the distance to any case is undefined, and all distances in m/s.
    """
    mine = _sorted_speeds(candidate, candidate.velocity_kind, period)
    distances = {}
    for rpm, case in cases.items():
        theirs = _sorted_speeds(case, candidate.velocity_kind, period)
        distances[rpm] = wasserstein_series(candidate.time, mine, case.time, theirs).mean()
    if not all(distance.defined for distance in distances.values()):
        return None, distances
    return min(distances, key=lambda rpm: distances[rpm].number), distances


def _summary(run: Trajectory | TrajectorySummary, scene: Scene, kind: str) -> TrajectorySummary:
    return run if isinstance(run, TrajectorySummary) else summarise(run, scene, kind)


def _share_outside(truth: Sequence[TrajectorySummary]) -> float | None:
    counts = [run.failures for run in truth]
    return None if None in counts else float(np.mean([count.share(count.outside) for count in counts]))


def _figure_row(row: Figure, mine: TrajectorySummary, truth: Sequence[TrajectorySummary]) -> FigureRow:
    found = [row.measure(replica) for replica in truth]
    mean = mean_of(found, row.unit)
    interval = prediction_interval([figure.number for figure in found]) if mean.defined else None
    return FigureRow(row.key, row.label, row.unit, row.measure(mine), mean, interval)


def _sorted_speeds(trajectory: Trajectory, kind: str, period: float) -> FloatArray:
    velocity = velocities(trajectory, kind, period)
    with np.errstate(invalid="ignore", over="ignore"):
        return sorted_frames(np.sqrt(np.einsum("fnk,fnk->fn", velocity, velocity)))
