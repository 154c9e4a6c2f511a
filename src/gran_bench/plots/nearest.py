"""Does a surrogate tell speeds apart: the distance of its rollouts from every case of the DEM."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.patches import Rectangle

from gran_bench.metrics.measured import Measured
from gran_bench.plots.style import SURROGATE, drawing


def nearest_cases(distances: Mapping[float, Mapping[float, Measured | float | None]], path: Path | str) -> Path:
    """Draw the speed distance of each rollout from each case; the nearest of a row is framed.

    Args:
        distances: speed W1 a frame (m/s) by the rollout's speed, then by the case's speed (rpm); None or an
            undefined figure for a rollout that failed.
        path: of the PNG.

    Returns:
        The path.
    """
    rows = sorted(distances)
    columns = sorted({rpm for row in distances.values() for rpm in row})
    table = np.array([[_number(distances[row].get(column)) for column in columns] for row in rows])
    with drawing(path, max(4.8, 1.6 + 0.85 * len(columns)), 1.7 + 0.6 * len(rows)) as figure:
        axes = figure.subplots()
        top = float(np.nanmax(table)) if np.isfinite(table).any() else 1.0
        axes.imshow(table, cmap="Blues", norm=Normalize(0.0, top), aspect="auto")
        for i, row in enumerate(rows):
            for j in range(len(columns)):
                value = table[i, j]
                shade = "white" if value > 0.55 * top else "black"
                axes.text(
                    j, i, f"{value:.3f}" if np.isfinite(value) else "failed", ha="center", va="center", color=shade
                )
            if np.isfinite(table[i]).all():
                nearest = int(np.argmin(table[i]))
                right = columns[nearest] == row
                edge, line = ("black", "-") if right else (SURROGATE, "--")
                corner = (nearest - 0.47, i - 0.45)
                axes.add_patch(Rectangle(corner, 0.94, 0.9, fill=False, linewidth=2.2, edgecolor=edge, linestyle=line))
        axes.set_xticks(range(len(columns)), [f"{rpm:g}" for rpm in columns])
        axes.set_yticks(range(len(rows)), [f"{rpm:g}" for rpm in rows])
        axes.set_xlabel("case of the DEM, rpm")
        axes.set_ylabel("rollout, rpm")
        axes.set_title("Speed W1 a frame, m/s (framed: the nearest)")
        axes.grid(False)
        axes.tick_params(length=0)
        for spine in axes.spines.values():
            spine.set_visible(False)
    return Path(path)


def _number(figure: Measured | float | None) -> float:
    value = figure.value if isinstance(figure, Measured) else figure
    return np.nan if value is None else float(value)
