"""Wall time of a simulated second against what makes it dear: stiffness, or the number of spheres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.ticker import LogLocator

from gran_bench.plots.style import DEM, FURTHER, QUIET, SURROGATE, drawing, plain_numbers

LARGEST_IN_FULL = 1e6  # numbers up to which the measured places are the ticks


@dataclass(frozen=True)
class CostLine:
    """The cost of one method.

    Attributes:
        name: in the legend.
        kind: ``dem`` or ``surrogate``.
        at: where it was measured; a single place, and no failure: the method costs the same everywhere.
        seconds: wall time of a simulated second there, s.
        failed_at: where the method failed.
    """

    name: str
    kind: str
    at: Sequence[float]
    seconds: Sequence[float]
    failed_at: Sequence[float] = ()


def cost_against(
    lines: Sequence[CostLine], quantity: str, path: Path | str, level: tuple[str, float] | None = None
) -> Path:
    """Draw costs, both axes logarithmic; a method with a single place becomes a level line.

    Args:
        lines: the methods.
        quantity: label of the abscissa.
        path: of the PNG.
        level: name and s of something that costs the same everywhere; None for nothing.
    """
    with drawing(path, 7.2, 4.6) as figure:
        axes = figure.subplots()
        axes.set_xscale("log")
        axes.set_yscale("log")
        styles = {"dem": iter(((DEM, "o", "-"), (DEM, "s", "--"))), "surrogate": iter(_surrogate_styles())}
        for line in lines:
            colour, mark, dash = next(styles[line.kind], (QUIET, "v", "-"))
            if len(line.at) == 1 and not line.failed_at:
                axes.axhline(line.seconds[0], color=colour, linestyle=dash, linewidth=1.2, label=line.name)
            else:
                axes.plot(line.at, line.seconds, color=colour, marker=mark, linestyle=dash, label=line.name)
            for place in line.failed_at:
                axes.plot(place, max(line.seconds, default=1.0), "x", color=colour, markersize=9)
        if level is not None:
            axes.axhline(level[1], color=FURTHER[0], linestyle=(0, (5, 3)), linewidth=1.4, label=level[0])
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        plain_numbers(axes.yaxis)
        places = sorted({place for line in lines for place in line.at})
        if places and places[-1] < LARGEST_IN_FULL:
            axes.set_xticks(places)
            plain_numbers(axes.xaxis)
        axes.set_xlabel(quantity)
        axes.set_ylabel("wall time of a simulated second, s")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return Path(path)


def _surrogate_styles() -> list[tuple[str, str, str]]:
    return [(SURROGATE, "D", "-"), *((colour, "v", "-") for colour in FURTHER[1:])]
