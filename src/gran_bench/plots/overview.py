"""All scenes of the benchmark in one picture: run time against error, with the same mark for a family everywhere."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from gran_bench.plots.style import BASELINE, DEM, FURTHER, QUIET, ROUND, SURROGATE, drawing, plain_numbers
from gran_bench.plots.time_error import Contender, frontier

# By family: words, colour, mark, size.
SAMPLES = {
    "dem": ("DEM, steps", DEM, "o", 8.0),
    "float32": ("DEM, float32", FURTHER[3], "s", 8.0),
    "softened": ("DEM, softened", FURTHER[2], "v", 9.0),
    "coarse": ("DEM, coarse-grained × f", FURTHER[0], "P", 9.0),
    "surrogate": ("surrogate", SURROGATE, "D", 11.0),
}
STATISTICS = {"interpolation": ("interpolation", BASELINE, "^", 11.0), "emulator": ("emulator", FURTHER[1], "*", 15.0)}
COLUMNS, SHARES = 4, (1.0, 3.4)  # panels in a row; widths of a panel's two parts
FONT = 14.0
POWERS = tuple(10.0**power for power in range(-6, 7))  # numbers for ticks
THREES = tuple(digit * power for power in POWERS for digit in (1, 3))


@dataclass(frozen=True)
class Point:
    """A method: its family, wall time of a simulated second (s), error (a run of the DEM has 1), and factor f."""

    family: str  # of `SAMPLES` or `STATISTICS`
    seconds: float
    error: float
    factor: float | None = None  # of a coarse-grained DEM


@dataclass(frozen=True)
class Panel:
    """A scene: its methods, and the DEM's own accuracy in noise floors, None where it is not known."""

    title: str
    points: Sequence[Point]
    accuracy: float | None = None


def overview(panels: Sequence[Panel], path: Path | str) -> Path:
    """Draw a panel for each scene: samples by their error in noise floors, and beside them what gives statistics alone.

    Both axes are logarithmic and the error is that of one further run of the DEM at 1: one noise floor of a sample, one
    energy score of statistics. A dashed line joins those that nothing beats; a full one the coarse-grained DEMs.
    """
    columns = min(COLUMNS, -(-len(panels) // 2))
    rows = -(-len(panels) // columns)
    drawn = {point.family for panel in panels for point in panel.points}
    with drawing(path, 4.2 * columns, 3.7 * rows + 0.8) as figure:
        grid = figure.add_gridspec(rows, columns)
        for k, panel in enumerate(panels):
            place, apart = grid[k // columns, k % columns], None
            if any(point.family in STATISTICS for point in panel.points):
                apart, axes = place.subgridspec(1, 2, width_ratios=SHARES, wspace=0.04).subplots()
            else:
                axes = figure.add_subplot(place)
            _draw(panel, axes, apart)
            if k + columns >= len(panels):  # nothing is drawn below it
                axes.set_xlabel("time of a simulated second, s", fontsize=FONT)
        figure.supylabel("error (a run of the DEM: 1)", fontsize=FONT)
        marks = [
            Line2D([], [], color=colour, marker=mark, markersize=size, linestyle="none", label=words)
            for name, (words, colour, mark, size) in (SAMPLES | STATISTICS).items()
            if name in drawn
        ]
        marks.append(Line2D([], [], color=QUIET, linestyle=(0, (5, 3)), label="nothing is faster and better"))
        marks.append(Line2D([], [], color="#e0e0e0", linewidth=11.0, label="the DEM's own accuracy"))
        if len(panels) < rows * columns:
            vacant = figure.add_subplot(grid[-1, -1])
            vacant.set_axis_off()
            vacant.legend(handles=marks, loc="center", fontsize=FONT, frameon=False)
        else:
            figure.legend(handles=marks, loc="outside lower center", fontsize=FONT, ncols=min(columns + 1, len(marks)))
    return Path(path)


def _draw(panel: Panel, axes: Axes, apart: Axes | None) -> None:
    errors = [1.0, *(point.error for point in panel.points)]
    low, high = 0.8 * min(errors), 1.5 * max(errors)
    for one in filter(None, (axes, apart)):
        one.set(xscale="log", yscale="log", ylim=(low, high))
        one.set_yticks([tick for tick in _ticks(max(errors)) if low <= tick <= high], minor=False)
        plain_numbers(one.xaxis, one.yaxis)
        one.minorticks_off()
        one.tick_params(labelsize=FONT - 1.0)
        one.axhline(1.0, color="#666666", linewidth=1.0)
        if panel.accuracy is not None:
            one.axhspan(1e-9, panel.accuracy, color="#ebebeb", zorder=0)
    (apart or axes).set_title(panel.title, fontsize=FONT, loc="left")
    if apart is not None:
        axes.tick_params(labelleft=False)
        axes.spines["left"].set_visible(False)
        times = [point.seconds for point in panel.points if point.family in STATISTICS]
        apart.set_xlim(0.3 * min(times), 3.0 * max(times))
        apart.set_xticks([tick for tick in POWERS if 0.3 * min(times) < tick < 3.0 * max(times)])
        apart.tick_params(axis="x", labelsize=FONT - 4.0)
    samples = [point for point in panel.points if point.family in SAMPLES]
    ahead = frontier([Contender(str(k), "dem", p.seconds, p.error) for k, p in enumerate(samples)])
    axes.plot([c.seconds for c in ahead], [c.floors for c in ahead], color=QUIET, linewidth=1.4,
              linestyle=(0, (5, 3)), drawstyle="steps-post")  # fmt: skip
    ladder: dict[float, Point] = {}
    for point in samples:
        if point.factor is not None and point.seconds < getattr(ladder.get(point.factor), "seconds", float("inf")):
            ladder[point.factor] = point  # of each factor the faster step
    rungs = [ladder[factor] for factor in sorted(ladder)]
    axes.plot([p.seconds for p in rungs], [p.error for p in rungs], color=SAMPLES["coarse"][1], linewidth=1.6)
    for point in rungs:
        axes.annotate(f"{point.factor:g}", (point.seconds, point.error), xytext=(-6, 5), textcoords="offset points",
                      fontsize=FONT - 3.0, color=SAMPLES["coarse"][1], ha="right")  # fmt: skip
    for point in panel.points:
        of_samples = point.family in SAMPLES
        _, colour, mark, size = (SAMPLES if of_samples else STATISTICS)[point.family]
        (axes if of_samples else apart).plot(point.seconds, point.error, mark, color=colour, markersize=size, alpha=0.9)
    if samples:
        times = [point.seconds for point in samples]
        axes.set_xlim(0.55 * min(times), 1.6 * max(times))
        wide = max(times) > 8.0 * min(times)
        axes.set_xticks([tick for tick in (THREES if wide else ROUND) if 0.55 * min(times) < tick < 1.6 * max(times)])


def _ticks(largest: float) -> Sequence[float]:
    """Round numbers: powers of ten over many decades."""
    if largest < 4.0:
        return (1.0, 1.5, 2.0, 3.0)
    return ROUND if largest < 50.0 else POWERS
