"""Headline errors of several runs in noise floors, in one picture."""

import textwrap
from collections.abc import Mapping
from pathlib import Path

from gran_bench.compare.runs import ABSENT, UNSEEN, Figure
from gran_bench.plots.style import BASELINE, DEM, QUIET, ROUND, SURROGATE, coloured, drawing

FAR = 1e3  # floors; beyond it a multiple says no more than that
_MARKS = "oDs^vPX"


def errors_in_floors(runs: Mapping[str, Mapping[str, Figure]], title: str, path: Path) -> bool:
    """Draw a group for each error, in it a point for each run; hollow ones start from a packing that no training saw.

    Errors beyond 1000 floors and undefined ones have lines of their own above the others: none is left out. ``runs``
    are the figures of each run by its name in the legend; drawn are those with a floor, but for positions, whose floor
    at the start is rounding. The answer is whether there was anything to draw.
    """
    floored = [name for figures in runs.values() for name, one in figures.items() if one.floor != ABSENT]
    groups = list(dict.fromkeys(name.removesuffix(UNSEEN) for name in floored if not name.startswith("position")))
    drawn = [rows[name] for rows in runs.values() for name in rows if name.removesuffix(UNSEEN) in groups]
    if not drawn:
        return False
    sound = [one.multiple for one in drawn if one.multiple is not None and one.multiple <= FAR]
    low, high = 0.7 * min([0.8, *sound]), 1.2 * max([2.0, *sound])
    step = (high / low) ** 0.1  # between lines above the others: as far apart for any span of errors
    lines = {"> 1000": high * step, "undefined": high * step**2}

    def height(multiple: float | None) -> float:
        return lines["undefined"] if multiple is None else multiple if multiple <= FAR else lines["> 1000"]

    names = [textwrap.fill(name, 105) for name in runs]
    with drawing(path, 9.6, 4.9 + 0.21 * sum(name.count("\n") + 1 for name in names)) as figure:
        axes, width = figure.subplots(), 0.74 / len(runs)
        for i, (rows, colour) in enumerate(coloured(runs.values(), (SURROGATE, BASELINE))):
            mark = _MARKS[(i + i // 7) % 7]  # with seven colours, a pair of its own for 49 runs
            for after, fill in (("", colour), (UNSEEN, "white")):
                shift = (i - (len(runs) - 1) / 2 + (0.14 if after else -0.14)) * width
                points = {x + shift: rows[g + after] for x, g in enumerate(groups) if g + after in rows}
                axes.plot([*points], [height(one.multiple) for one in points.values()], mark, color=colour,
                          markerfacecolor=fill, markersize=8.0, markeredgewidth=1.6,
                          label=None if after else names[i])  # fmt: skip
        axes.axhline(1.0, color=DEM, linewidth=1.4, zorder=1)
        for x in range(1, len(groups)):
            axes.axvline(x - 0.5, color=QUIET, linewidth=0.6)
        used = {text: y for text, y in lines.items() if y in [height(one.multiple) for one in drawn]}
        ticks = {"the DEM itself: 1" if y == 1 else f"{y:g}": y for y in ROUND if low <= y <= high} | used
        axes.set_yscale("log")
        axes.set_ylim(low, max([high, *(step**0.5 * y for y in used.values())]))
        axes.set_yticks([*ticks.values()], [*ticks])
        axes.minorticks_off()
        axes.set_xticks(range(len(groups)), [textwrap.fill(group, 24) for group in groups], fontsize=11)
        axes.set_xlim(-0.5, len(groups) - 0.5)
        axes.grid(axis="x", visible=False)
        axes.set_ylabel("error, noise floors", fontsize=11)
        hollow = any(name.endswith(UNSEEN) for name in floored)
        beds = "\nfilled: the bed of the training; hollow: a bed that no training saw" if hollow else ""
        axes.set_title(textwrap.fill(title, 100) + beds, fontsize=12)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower left", fontsize=10)
    return True
