"""Angle of repose against time, by both definitions (paper, Fig. 3a)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from gran_bench.metrics.measured import Series
from gran_bench.metrics.summary import STEADY_FROM, TrajectorySummary
from gran_bench.plots.style import BAND, DEM, coloured, drawing, mark_place, say

PANELS = (("surface_angle", "Surface angle of repose"), ("com_angle", "Angle of the centre of mass"))


def angle_of_repose(
    candidates: Mapping[str, TrajectorySummary], replicas: Sequence[TrajectorySummary], path: Path | str
) -> Path:
    """Draw both angles of some candidates over the band of the DEM's replicas.

    A state without a valid angle leaves a gap; a scene without an angle of repose says so.

    Args:
        candidates: by name; the first in the surrogate's colour.
        replicas: runs of the DEM; their range is the band.
        path: of the PNG.

    Returns:
        The path.
    """
    with drawing(path, 8.0, 5.6) as figure:
        panels = figure.subplots(2, 1, sharex=True)
        for axes, (name, title) in zip(panels, PANELS, strict=True):
            axes.set_title(title)
            axes.set_ylabel("angle, °")
            refusal = next(
                (run.series[name].undefined_because for run in replicas if run.series[name].undefined_because), ""
            )
            if refusal:
                say(axes, f"undefined: {refusal}")
                continue
            draw_band(axes, [run.series[name] for run in replicas])
            for (label, run), colour in coloured(candidates.items()):
                draw_series(axes, run.series[name], label, colour)
            mark_steady_part(axes, replicas[0])
        if panels[0].get_legend_handles_labels()[0]:
            panels[0].legend(loc="upper right", ncols=1)
        panels[-1].set_xlabel("time, s")
        panels[-1].set_xlim(replicas[0].time[0], replicas[0].time[-1])
    return Path(path)


def draw_band(axes: Axes, replicas: Sequence[Series], scale: float = 1.0) -> None:
    """The range of the replicas that have a valid value in a state, and their mean."""
    values = np.array([np.where(series.valid, series.value, np.nan) for series in replicas]) * scale
    known = np.isfinite(values).any(axis=0)
    low, middle, high = np.full((3, values.shape[1]), np.nan)
    low[known], high[known] = np.nanmin(values[:, known], axis=0), np.nanmax(values[:, known], axis=0)
    middle[known] = np.nanmean(values[:, known], axis=0)
    count = len(replicas)
    if count > 1:
        axes.fill_between(replicas[0].time, low, high, color=BAND, linewidth=0, label=f"DEM, range of {count} replicas")
    axes.plot(replicas[0].time, middle, color=DEM, linewidth=1.3, label="DEM, mean" if count > 1 else "DEM")


def draw_series(axes: Axes, series: Series, label: str, colour: str, scale: float = 1.0) -> None:
    """One run; its label counts the states that have no valid value."""
    bad = int((~series.valid).sum())
    note = f" ({bad} of {len(series.value)} states invalid)" if bad else ""
    axes.plot(series.time, scale * np.where(series.valid, series.value, np.nan), color=colour, label=label + note)


def mark_steady_part(axes: Axes, run: TrajectorySummary) -> None:
    """A line where steady means begin, where there are any."""
    if not run.steady_undefined_because:
        mark_place(axes, STEADY_FROM, "steady")
