"""Mean speed by depth under the surface, in layers of one diameter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gran_bench.metrics.summary import TrajectorySummary
from gran_bench.plots.style import BAND, DEM, coloured, drawing, say


def speed_by_depth(
    candidates: Mapping[str, TrajectorySummary], replicas: Sequence[TrajectorySummary], path: Path | str
) -> Path:
    """Draw the steady flow's mean velocity along the surface in layers under it, over the range of the replicas.

    Args:
        candidates: by name; the first in the surrogate's colour.
        replicas: runs of the DEM, of the same definition of velocity.
        path: of the PNG.

    Returns:
        The path.
    """
    refusal = replicas[0].steady_undefined_because
    truth = [run.layer_velocity for run in replicas if np.isfinite(run.layer_velocity).any()]
    with drawing(path, 5.2, 4.8) as figure:
        axes = figure.subplots()
        axes.set_title("Steady flow under the surface")
        axes.set_xlabel("velocity along the surface, uphill, m/s")
        axes.set_ylabel("depth under the surface, d")
        if refusal or not truth:
            say(axes, f"undefined:\n{refusal or 'no valid surface'}")
            return Path(path)
        # Layers that hold spheres in every replica; deeper ones are the drum's wall.
        layers = np.flatnonzero(np.isfinite(np.array(truth)).all(axis=0))
        depth = layers + 0.5
        values = np.array(truth)[:, layers]
        if len(truth) > 1:
            label = f"DEM, range of {len(truth)} replicas"
            axes.fill_betweenx(depth, values.min(axis=0), values.max(axis=0), color=BAND, linewidth=0, label=label)
        axes.plot(values.mean(axis=0), depth, color=DEM, linewidth=1.3, marker="o", markersize=3, label="DEM, mean")
        for (name, run), colour in coloured(candidates.items()):
            found = np.full(len(layers), np.nan)
            known = layers < len(run.layer_velocity)
            found[known] = run.layer_velocity[layers[known]]
            note = "" if np.isfinite(found).any() else ": no valid surface"
            axes.plot(found, depth, color=colour, marker="o", markersize=3.5, label=name + note)
        axes.axvline(0.0, color="#999999", linewidth=0.8)
        axes.set_ylim(layers[-1] + 1.0, 0.0)
        axes.legend(loc="lower left")
    return Path(path)
