"""Steady flow of the drum, packing by packing, of gran-bench's DEM beside an independent code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.stats import ttest_1samp

from gran_bench.plots.style import BAND, BASELINE, DEM, drawing
from gran_bench.state import FloatArray


def draw_drum_flow(
    path: Path | str,
    samples: Mapping[tuple[str, float], Sequence[FloatArray]],
    bounds: Mapping[float, Sequence[tuple[float, float]]],
    labels: Sequence[str],
) -> None:
    """A panel for each quantity and speed: a dot a packing, the mean with its 95 % interval, the bound as a band.

    Args:
        path: of the PNG.
        samples: by code and speed in rpm: for each quantity ``(n,)`` values, n ≥ 2.
        bounds: by speed in rpm: for each quantity the middle of the bound and its half width.
        labels: of the quantities, with units.
    """
    codes = list(dict.fromkeys(code for code, _ in samples))
    speeds = sorted({rpm for _, rpm in samples})
    with drawing(path, max(3.6, 1.45 * len(codes)) * len(speeds), 2.5 * len(labels)) as figure:
        grid = figure.subplots(len(labels), len(speeds), squeeze=False)
        for column, rpm in enumerate(speeds):
            for row, label in enumerate(labels):
                axes = grid[row, column]
                if rpm in bounds:
                    middle, half = bounds[rpm][row]
                    axes.axhspan(middle - half, middle + half, color=BAND, alpha=0.5, linewidth=0)
                for place, code in enumerate(codes):
                    values = samples.get((code, rpm))
                    if values is None:
                        continue
                    spread = np.linspace(-0.15, 0.15, len(values[row]))
                    colour = DEM if code.startswith(codes[0]) else BASELINE  # the first, or it with something changed
                    axes.plot(place + spread, values[row], "o", color=colour, markersize=3.5, alpha=0.7)
                    low, high = ttest_1samp(values[row], 0.0).confidence_interval(0.95)
                    middle, half = 0.5 * (low + high), 0.5 * (high - low)
                    axes.errorbar(place + 0.3, middle, half, fmt="_", color=colour, capsize=3)
                axes.set_xticks(range(len(codes)), [code.replace(", ", ",\n") for code in codes])
                axes.set_xlim(-0.5, len(codes) - 0.3)
                axes.set_ylabel(label)
                if row == 0:
                    axes.set_title(f"{rpm:g} rpm")
