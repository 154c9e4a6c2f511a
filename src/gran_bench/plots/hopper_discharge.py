"""The mass flow out of a hopper against Beverloo's law."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gran_bench.plots.style import BASELINE, DEM, drawing
from gran_bench.state import FloatArray

GRAVITY = 9.81  # m/s²


@dataclass(frozen=True)
class HopperDischarge:
    """Flows out of hoppers that differ in their orifice alone."""

    orifice: FloatArray  # ``(K,)`` D, m
    flow: FloatArray  # ``(K,)`` W, kg/s
    flow_error: FloatArray  # ``(K,)`` standard error of W from the scatter of blocks of time, kg/s
    exponent: float  # of D − k d, by least squares of the logarithms
    exponent_error: float  # its standard error: of the straight line or of the flows, whichever is larger
    factor: float  # C of the law with exponent 5/2, −, with the bulk density of the settled bed
    diameter: float  # d, m
    bulk_density: float  # ρ_b, kg/m³
    rim: float  # k, −

    @property
    def opening(self) -> FloatArray:
        """D − k d, ``(K,)`` m."""
        return self.orifice - self.rim * self.diameter


def draw_discharge(path: Path | str, result: HopperDischarge) -> None:
    """The flows against D − k d, both axes logarithmic, with Beverloo's law and the fitted one."""
    line = np.geomspace(0.9 * result.opening.min(), 1.1 * result.opening.max(), 50)
    law = result.factor * result.bulk_density * math.sqrt(GRAVITY) * line**2.5
    middle = np.exp(np.log(result.opening).mean()), np.exp(np.log(result.flow).mean())
    with drawing(path, 5.2, 4.0) as figure:
        axes = figure.add_subplot()
        axes.loglog(line, law, color=BASELINE, label=f"Beverloo, exponent 2.5, C = {result.factor:.3f}")
        fitted = middle[1] * (line / middle[0]) ** result.exponent
        label = f"fit, exponent {result.exponent:.3f} ± {result.exponent_error:.3f}"
        axes.loglog(line, fitted, "--", color=DEM, linewidth=1.0, label=label)
        axes.errorbar(result.opening, result.flow, 2.0 * result.flow_error, fmt="o", color=DEM, markersize=4)
        for x, y, orifice in zip(result.opening, result.flow, result.orifice, strict=True):
            axes.annotate(f"{orifice / result.diameter:.3g} d", (x, y), (6, -10), textcoords="offset points")
        axes.set(xlabel=f"D − {result.rim:g} d, m", ylabel="mass flow, kg/s")
        ticks = np.round(result.opening, 3)
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        levels = [level for level in (1, 2, 5, 10, 20, 50, 100, 200) if 0.8 * result.flow.min() < level]
        levels = [level for level in levels if level < 1.4 * result.flow.max()]
        axes.set_yticks(levels, [f"{level:g}" for level in levels])
        axes.minorticks_off()
        axes.legend(loc="upper left")
        axes.set_title("Discharge of a conical hopper")
