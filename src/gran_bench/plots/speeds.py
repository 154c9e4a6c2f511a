"""Distribution of the particles' speeds at one instant (paper, Fig. 3b)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gran_bench.metrics.measured import frame_at
from gran_bench.metrics.speeds import speed_histogram
from gran_bench.metrics.summary import PATTERN_TIME, TrajectorySummary
from gran_bench.plots.style import BAND, DEM, coloured, drawing, speed_label

CLASS = 0.1  # m/s
WIDEST = 10.0  # times the speeds of the DEM: a wild model would leave no room for it


def speed_distribution(
    candidates: Mapping[str, TrajectorySummary],
    replicas: Sequence[TrajectorySummary],
    path: Path | str,
    time: float = PATTERN_TIME,
) -> Path:
    """Draw the share of spheres in classes of 0.1 m/s, candidates over the range of the DEM's replicas.

    Args:
        candidates: by name; the first in the surrogate's colour.
        replicas: runs of the DEM, of the same definition of velocity.
        path: of the PNG.
        time: s.

    Returns:
        The path.
    """
    truth = [speed for run in replicas if (speed := _speeds(run, time)) is not None]
    found = {name: _speeds(run, time) for name, run in candidates.items()}
    known = [speed for speed in found.values() if speed is not None]
    own, top = (max((float(np.quantile(speed, 0.999)) for speed in runs), default=1.0) for runs in (truth, known))
    top = max(own, min(top, WIDEST * max(own, CLASS)))  # what is faster is told in the legend
    edges = CLASS * np.arange(int(np.ceil(top / CLASS)) + 2)
    with drawing(path, 7.0, 4.0) as figure:
        axes = figure.subplots()
        if truth:
            shares = 100.0 * np.array([speed_histogram(speed, edges) for speed in truth])
            if len(truth) > 1:
                axes.stairs(
                    shares.max(axis=0),
                    edges,
                    baseline=shares.min(axis=0),
                    fill=True,
                    color=BAND,
                    label=f"DEM, range of {len(truth)} replicas",
                )
            axes.stairs(shares.mean(axis=0), edges, color=DEM, linewidth=1.4, label="DEM, mean")
        for (name, speed), colour in coloured(found.items()):
            if speed is None:
                axes.plot([], [], color=colour, label=f"{name}: not finite at {time:g} s")
                continue
            beyond = 100.0 * float((speed > edges[-1]).mean())
            note = f" ({beyond:.2g} % faster than shown)" if beyond > 0 else ""
            axes.stairs(100.0 * speed_histogram(speed, edges), edges, color=colour, linewidth=1.8, label=name + note)
        axes.set_title(f"Speeds at {time:g} s")
        axes.set_xlabel(speed_label(replicas[0].velocity_kind))
        axes.set_ylabel(f"share of spheres in {CLASS:g} m/s, %")
        axes.set_xlim(0.0, edges[-1])
        axes.set_ylim(bottom=0.0)
        axes.legend(loc="upper right")
    return Path(path)


def _speeds(run: TrajectorySummary, time: float) -> np.ndarray | None:
    frame = frame_at(run.time, time)
    if frame is None or not np.isfinite(run.sorted_speed[frame]).all():
        return None
    return run.sorted_speed[frame]
