"""Run time against error, and against what makes it dear: which method gives the answer in the least time."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import LogLocator
from matplotlib.transforms import Bbox

from gran_bench.plots.style import BASELINE, DEM, FURTHER, QUIET, ROUND, SURROGATE, drawing, plain_numbers

KINDS = {
    "dem": ("DEM", DEM, "o"),
    "surrogate": ("surrogate", SURROGATE, "D"),
    "baseline": ("baseline", BASELINE, "^"),
}
LARGEST_IN_FULL = 1e6  # numbers up to which the measured places are the ticks
# Where a name may stand, from its mark, points: the first that is free. From farther than FAR a line leads to the mark.
PLACES = (
    (9, 0), (-9, 0), (9, 11), (9, -11), (-9, 11), (-9, -11), (0, 18), (0, -18), (9, 24), (9, -24), (-9, 24), (-9, -24),
    *((side * right, -up) for up, right in ((38, 9), (38, 40), (52, 9), (52, 60)) for side in (1, -1)),
    *((side * right, up) for up, right in ((38, 40), (52, 60)) for side in (1, -1)),
)  # fmt: skip
FAR = 20


@dataclass(frozen=True)
class Contender:
    """One method in the picture.

    Attributes:
        name: that stands beside its mark.
        kind: ``dem``, ``surrogate`` or ``baseline``.
        seconds: wall time of a simulated second, s.
        floors: error in noise floors; None for a run that failed.
        low, high: range of the error, in floors.
        fast, slow: range of the time, s.
    """

    name: str
    kind: str
    seconds: float
    floors: float | None
    low: float | None = None
    high: float | None = None
    fast: float | None = None
    slow: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind={self.kind!r} of {self.name!r}; choose one of {', '.join(KINDS)}")


def time_against_error(
    contenders: Sequence[Contender],
    quantity: str,
    path: Path | str,
    accuracy: float | None = 1.0,
    untimed: Sequence[str] = (),
) -> Path:
    """Draw wall time of a simulated second against error in noise floors, with the front that nothing beats in both.

    A failed run stands above all others as a cross, or under the axes by its name where it has no time; it is never
    left out.

    Args:
        contenders: the methods; there may be none.
        quantity: what the error is of, for the axis.
        path: of the PNG.
        accuracy: the DEM's own, in floors; shaded. None where it is not known.
        untimed: names of those that failed before their first frame, and have no place on the axis of time.
    """
    sound = [c for c in contenders if c.floors is not None]
    highest = max([2.0, *(c.floors for c in sound)])
    lowest = min([0.8, *(c.floors for c in sound)])
    height = {c.name: 2.0 * highest if c.floors is None else c.floors for c in contenders}
    times = [c.seconds for c in contenders] or [1.0]
    with drawing(path, 9.6, 6.4) as figure:
        axes = figure.subplots()
        axes.set(xscale="log", yscale="log", xlim=(0.5 * min(times), 4.0 * max(times)))
        axes.set_yticks([tick for tick in ROUND if lowest / 2 < tick < 3 * highest])
        axes.set_ylim(0.6 * lowest, 2.8 * highest)
        plain_numbers(axes.yaxis)
        axes.xaxis.set_major_formatter("{x:g}")
        lost = f"failed before the first frame: {'; '.join(untimed)}" if untimed else ""
        axes.set_xlabel("\n".join(["wall time of a simulated second, s", *textwrap.wrap(lost, 110)]))
        axes.set_ylabel(f"{quantity}\nthe worse, noise floors" if " and " in quantity else f"{quantity}, noise floors")
        if accuracy is not None:
            axes.axhspan(0.0, accuracy, color="#f0f0f0", zorder=0)
            axes.text(0.99, 0.015, "the DEM's own accuracy", transform=axes.transAxes, ha="right", fontsize=8.5,
                      color="#666666")  # fmt: skip
        ahead = front(sound)
        if len(ahead) > 1:
            axes.plot([c.seconds for c in ahead], [c.floors for c in ahead], color=QUIET, linewidth=1.0,
                      drawstyle="steps-post", linestyle=(0, (5, 3)), label="nothing is faster and better")  # fmt: skip
        for kind, (label, colour, mark) in KINDS.items():
            for i, c in enumerate([c for c in contenders if c.kind == kind]):
                y, thin = height[c.name], {"color": colour, "linewidth": 1.0, "alpha": 0.6}
                if c.low is not None and c.high is not None:
                    axes.plot([c.seconds] * 2, [c.low, c.high], **thin)
                if c.fast is not None and c.slow is not None:
                    axes.plot([c.fast, c.slow], [y] * 2, **thin)
                axes.plot(c.seconds, y, mark if c.floors is not None else "x", color=colour, markersize=6.5,
                          linestyle="none", label=label if i == 0 else None)  # fmt: skip
        if not contenders:
            axes.text(0.5, 0.5, "no method was timed and judged", transform=axes.transAxes, ha="center")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=5)
        _name_marks(figure, axes, [(c, height[c.name]) for c in contenders])
    return Path(path)


def _name_marks(figure: Figure, axes: Axes, marks: Sequence[tuple[Contender, float]]) -> None:
    """Write each name beside its mark, where it covers no other name and no mark."""
    figure.draw_without_rendering()
    points = axes.transData.transform([(c.seconds, y) for c, y in marks])
    taken = [Bbox.from_extents(x - 6, y - 6, x + 6, y + 6) for x, y in points]
    for contender, y in marks:
        text = contender.name if contender.floors is not None else f"{contender.name} (failed)"
        for right, up in PLACES:
            leader = {"arrowstyle": "-", "color": QUIET, "linewidth": 0.6, "shrinkA": 0.0, "shrinkB": 3.0}
            label = axes.annotate(
                text, (contender.seconds, y), xytext=(right, up), textcoords="offset points", fontsize=9,
                ha=("center", "left", "right")[(right > 0) - (right < 0)], va="center", color=KINDS[contender.kind][1],
                bbox={"facecolor": "white", "alpha": 0.75, "linewidth": 0, "pad": 0.6},
                arrowprops=leader if abs(up) > FAR else None,
            )  # fmt: skip
            label.get_window_extent()  # puts the text in its place; its own box leaves out the line
            box = Text.get_window_extent(label)
            inside = axes.bbox.containsx(box.x0) and axes.bbox.containsx(box.x1)
            if inside and not any(box.overlaps(other) for other in taken):
                break
            label.remove()
        else:
            axes.add_artist(label)
        taken.append(box)


def front(contenders: Sequence[Contender]) -> list[Contender]:
    """Those that no other beats in time and error at once, from fast to slow."""
    found: list[Contender] = []
    for contender in sorted(contenders, key=lambda c: (c.seconds, c.floors)):
        if not found or contender.floors < found[-1].floors:
            found.append(contender)
    return found


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
        axes.set(xscale="log", yscale="log", xlabel=quantity, ylabel="wall time of a simulated second, s")
        learned = [(SURROGATE, "D", "-"), *((colour, "v", "-") for colour in FURTHER[1:])]
        styles = {"dem": iter(((DEM, "o", "-"), (DEM, "s", "--"))), "surrogate": iter(learned)}
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
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return Path(path)
