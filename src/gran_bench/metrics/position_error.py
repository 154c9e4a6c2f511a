"""Distance between a model's spheres and the DEM's, over a short horizon and frame by frame.

Two runs of the DEM itself separate within some 30 frames; beyond that, only statistics can be compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from gran_bench.config import JudgeConfig
from gran_bench.config.rules import check_arguments, checked
from gran_bench.metrics.measured import Measured
from gran_bench.state import FloatArray, Trajectory

HORIZONS = (1, 3, 10)  # frames
DIVERGED = 0.1  # of a diameter: mean distance of two replicas beyond which they are no longer one trajectory


def separation(a: FloatArray, b: FloatArray, period: float = 0.0) -> FloatArray:
    """Mean Euclidean distance, to the nearest image along y, of two ``(F, N, 3)`` in each frame, ``(F,)`` m, or NaN."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if a.shape != b.shape:
        raise ValueError(f"positions have shapes {a.shape} and {b.shape}; compare the same spheres in the same frames")
    offset = a - b
    with np.errstate(invalid="ignore", over="ignore"):
        if period > 0:
            offset[..., 1] -= period * np.round(offset[..., 1] / period)
        distance = np.sqrt((offset**2).sum(axis=-1)).mean(axis=-1)
    return np.where(np.isfinite(distance), distance, np.nan)


def mean_spread(replicas: Sequence[FloatArray], period: float = 0.0) -> FloatArray:
    """Mean over all pairs of two or more replicas of their `separation`: how far the DEM separates from itself."""
    pairs = [(i, j) for i in range(len(replicas)) for j in range(i)]
    if not pairs:
        raise ValueError(f"{len(replicas)} replica has no spread; give two or more")
    return np.mean([separation(replicas[i], replicas[j], period) for i, j in pairs], axis=0)


def divergence_horizon(spread: FloatArray, diameter: float) -> int | None:
    """First frame in which the replicas lie 0.1 d apart in the mean; None if they never do."""
    beyond = np.flatnonzero(spread > DIVERGED * diameter)
    return int(beyond[0]) if len(beyond) else None


def short_horizon_errors(
    predict: Callable[[int, int], FloatArray],
    truth: Trajectory,
    starts: Sequence[int],
    horizons: Sequence[int] = HORIZONS,
    period: float = 0.0,
) -> dict[int, Measured]:
    """Mean position error a few frames after many starts on the DEM's own trajectory, by horizon in frames, m.

    It is undefined, naming the first start, where any prediction is not finite.

    Args:
        predict: ``predict(start, frames)`` gives the ``(frames, N, 3)`` positions (m) of the states that follow
            frame ``start`` of ``truth``, the DEM's trajectory.
        starts: frames, each at least max(horizons) before the end; else a `ValueError`.
        horizons: frames ahead, each ≥ 1; else a `ValueError`.
        period: of y, m.
    """
    check_arguments(truth=(truth, Trajectory))
    if not horizons or min(horizons) < 1:
        raise ValueError(f"horizons={tuple(horizons)} look nowhere; give frames ahead, each ≥ 1")
    longest = max(horizons)
    late = [start for start in starts if not 0 <= start < truth.frame_count - longest]
    if late or not len(starts):
        raise ValueError(
            f"starts={late[:5]} leave no {longest} frames in a trajectory of {truth.frame_count}; "
            f"choose frames from 0 to {truth.frame_count - longest - 1}"
        )
    ahead = (truth.position[start + 1 : start + 1 + longest] for start in starts)
    pairs = zip(starts, ahead, strict=True)
    error = np.array([separation(predict(int(start), longest), true, period) for start, true in pairs])
    return {horizon: _over_starts(error[:, horizon - 1], starts) for horizon in horizons}


def _over_starts(error: FloatArray, starts: Sequence[int]) -> Measured:
    broken = np.flatnonzero(~np.isfinite(error))
    if len(broken):
        reason = f"not finite from {len(broken)} of {len(starts)} starts, first from frame {starts[broken[0]]}"
        return Measured.undefined("m", reason)
    return Measured(float(error.mean()), "m", f"{len(starts)} starts")


def spread_starts(frame_count: int, starts: int, longest: int = max(HORIZONS)) -> list[int]:
    """``starts`` frames spread evenly over a trajectory, from the settled state to the last possible one."""
    starts = checked(JudgeConfig, "short_horizon_starts", starts)
    last = frame_count - longest - 1
    if last < 0:
        raise ValueError(f"{frame_count} frames are too few for a horizon of {longest}; store at least {longest + 1}")
    return sorted({math.floor(x + 0.5) for x in np.linspace(0, last, min(starts, last + 1))})
