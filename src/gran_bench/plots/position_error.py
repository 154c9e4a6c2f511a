"""Position error against frame, with the horizon beyond which the DEM differs from itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gran_bench.metrics.position_error import DIVERGED, divergence_horizon, mean_spread, separation
from gran_bench.metrics.summary import TrajectorySummary
from gran_bench.plots.style import DEM, coloured, drawing, mark_place
from gran_bench.state import FloatArray

USUAL = (1e-4, 30.0)  # d; the axis of every run that stays within, so that figures can be compared


def position_error(
    candidates: Mapping[str, TrajectorySummary], replicas: Sequence[TrajectorySummary], path: Path | str
) -> Path:
    """Draw the mean distance to the DEM's spheres, in diameters and mm, beside the spread of its replicas.

    Args:
        candidates: by name, with positions; the first in the surrogate's colour.
        replicas: runs of the DEM, two or more for a spread.
        path: of the PNG.

    Returns:
        The path.
    """
    diameter, period, frames = replicas[0].diameter, replicas[0].period, len(replicas[0].time)
    with drawing(path, 7.6, 4.3) as figure:
        axes, drawn = figure.subplots(), []
        for (name, run), colour in coloured(candidates.items()):
            if run.position is None:
                continue
            shared = min(len(run.time), frames)
            error = np.mean(
                [separation(run.position[:shared], truth.position[:shared], period) for truth in replicas], axis=0
            )
            lost = int((~np.isfinite(error)).sum()) + frames - shared
            note = f" ({lost} frames not finite or missing)" if lost else ""
            axes.plot(np.arange(1, shared), error[1:] / diameter, color=colour, label=f"{name} to DEM{note}")
            drawn.append(error[1:] / diameter)
        if len(replicas) > 1:
            spread = mean_spread([run.position for run in replicas], period)
            axes.plot(
                np.arange(1, frames), spread[1:] / diameter, color=DEM, label="DEM replica to replica (1e-9 m apart)"
            )
            drawn.append(spread[1:] / diameter)
            horizon = divergence_horizon(spread, diameter)
            if horizon is not None:
                axes.axvspan(horizon, frames, color="#f2f2f2", zorder=0)
                late = horizon > frames**0.7  # on a logarithmic axis; there is no room to its right
                words = f"frame {horizon}:\nreplicas {DIVERGED:g} d apart,\nbeyond it only\nstatistics compare"
                mark_place(axes, horizon, words, ha="right" if late else "left")
        axes.set_yscale("log")
        axes.set_ylim(*_range(drawn))
        axes.set_xlim(1, frames - 1)
        axes.set_xscale("log")
        axes.set_xticks([tick for tick in (1, 3, 10, 30, 100, 300, 1000) if tick < frames], minor=False)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_major_formatter("{x:g}")
        interval = 1e3 * float(replicas[0].time[1] - replicas[0].time[0])
        axes.set_xlabel(f"frames after the settled state ({interval:g} ms each)")
        axes.set_ylabel("mean position error, d")
        right = axes.secondary_yaxis("right", functions=(lambda x: x * 1e3 * diameter, lambda x: x / (1e3 * diameter)))
        right.yaxis.set_major_formatter("{x:g}")
        right.set_ylabel("mm")
        axes.set_title("Position error of the rollout")
        axes.legend(loc="upper left")
    return Path(path)


def _range(errors: Sequence[FloatArray]) -> tuple[float, float]:
    """Ends of the axis, d: the usual ones, or as far beyond as a run goes."""
    known = np.concatenate([np.asarray(error, np.float64) for error in errors] or [np.zeros(0)])
    known = known[np.isfinite(known) & (known > 0)]
    low, high = known.min(initial=USUAL[0]), known.max(initial=USUAL[1])
    return (low if low == USUAL[0] else 0.5 * low), (high if high == USUAL[1] else 2.0 * high)
