"""Energy, overlap and mixing against time: what a flow that looks right may still get wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from gran_bench.metrics.summary import TrajectorySummary
from gran_bench.plots.angle import draw_band, draw_series
from gran_bench.plots.style import coloured, drawing, say

# Name of the series, title, label of the axis, and the axis' unit over the series' one.
PANELS = (
    ("translational_energy", "Translational energy", "energy, J", 1.0),
    ("rotational_energy", "Rotational energy", "energy, J", 1.0),
    ("mixing", "Mixing of the two halves", "entropy, 1 is mixed", 1.0),
    ("overlap_mean", "Mean overlap of touching pairs", "overlap, mm", 1e3),
    ("overlap_max", "Largest overlap of a pair", "overlap, mm", 1e3),
    ("wall_overlap_max", "Largest overlap with a wall", "overlap, mm", 1e3),
)


def diagnostics(
    candidates: Mapping[str, TrajectorySummary], replicas: Sequence[TrajectorySummary], path: Path | str
) -> Path:
    """Draw energies, overlaps and mixing of some candidates over the range of the DEM's replicas.

    Args:
        candidates: by name; the first in the surrogate's colour.
        replicas: runs of the DEM, of the same definition of velocity.
        path: of the PNG.

    Returns:
        The path.
    """
    with drawing(path, 11.0, 5.8) as figure:
        panels = figure.subplots(2, 3, sharex=True)
        for axes, (name, title, label, scale) in zip(panels.ravel(), PANELS, strict=True):
            axes.set_title(title)
            axes.set_ylabel(label)
            if refusal := replicas[0].series[name].undefined_because:
                say(axes, f"undefined:\n{refusal}")
                continue
            draw_band(axes, [run.series[name] for run in replicas], scale)
            for (who, run), colour in coloured(candidates.items()):
                series = run.series[name]
                draw_series(axes, series, series.undefined_because or who, colour, scale)
            axes.set_ylim(bottom=0.0)
        for axes in panels[-1]:
            axes.set_xlabel("time, s")
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=4)
    return Path(path)
