"""Run time against error, and against what makes it dear: which method gives the answer in the least time."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from matplotlib.ticker import LogLocator

from gran_bench.plots.style import BASELINE, DEM, FURTHER, QUIET, ROUND, SURROGATE, drawing, plain_numbers

KINDS = {"dem": ("DEM", DEM, "o"), "surrogate": ("surrogate", SURROGATE, "D"), "baseline": ("baseline", BASELINE, "^"),
         "emulator": ("emulator", FURTHER[1], "*")}  # fmt: skip
LARGEST_IN_FULL = 1e6  # numbers up to which the measured places are the ticks


@dataclass(frozen=True)
class Contender:
    """One method in the picture: wall time of a simulated second, and error in noise floors, None of a failed run.

    ``low`` and ``high`` are the range of the error, ``fast`` and ``slow`` of the time.
    """

    name: str
    kind: str
    seconds: float
    floors: float | None
    low: float | None = None
    high: float | None = None
    fast: float | None = None
    slow: float | None = None
    each: tuple[float, ...] = ()  # floors of each seed, where the error is their mean

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind={self.kind!r} of {self.name!r}; choose one of {', '.join(KINDS)}")


Method = TypeVar("Method", bound=Contender)


def time_against_error(
    contenders: Sequence[Contender],
    quantity: str,
    path: Path | str,
    accuracy: float | None = 1.0,
    untimed: Sequence[str] = (),
    clock: str = "wall time of a simulated second, s",
) -> Path:
    """Draw a time against error in noise floors, with the front that nothing beats in both.

    A failed run stands above all others as a cross, or under the axes by its name where it has no time; it is never
    left out.

    ``clock`` says what the time is of: of a simulated second, unless all contenders have another.
    ``accuracy`` is the DEM's own in floors, if it is known; ``untimed`` are those that failed before their first frame,
    and have no place on the axis of time.
    """
    sound = [c for c in contenders if c.floors is not None]
    highest = max([2.0, *(floors for c in sound for floors in (c.floors, *c.each))])
    lowest = min([0.8, *(floors for c in sound for floors in (c.floors, *c.each))])

    def height_of(contender: Contender) -> float:
        return 2.0 * highest if contender.floors is None else contender.floors

    times = [c.seconds for c in contenders] or [1.0]
    with drawing(path, 9.6, 6.4) as figure:
        axes = figure.subplots()
        axes.set(xscale="log", yscale="log", xlim=(0.5 * min(times), 4.0 * max(times)))
        axes.set_yticks([tick for tick in ROUND if lowest / 2 < tick < 3 * highest])
        axes.set_ylim(0.6 * lowest, 2.8 * highest)
        plain_numbers(axes.yaxis)
        axes.xaxis.set_major_formatter("{x:g}")
        lost = f"failed before the first frame: {'; '.join(untimed)}" if untimed else ""
        axes.set_xlabel("\n".join([clock, *textwrap.wrap(lost, 110)]))
        axes.set_ylabel(f"{quantity}\nthe worse, noise floors" if " and " in quantity else f"{quantity}, noise floors")
        if accuracy is not None:
            axes.axhspan(0.0, accuracy, color="#f0f0f0", zorder=0)
            axes.text(0.99, 0.015, "the DEM's own accuracy", transform=axes.transAxes, ha="right", fontsize=8.5,
                      color="#666666")  # fmt: skip
        if len(ahead := frontier(sound)) > 1:
            axes.plot([c.seconds for c in ahead], [c.floors for c in ahead], color=QUIET, linewidth=1.0,
                      drawstyle="steps-post", linestyle=(0, (5, 3)), label="nothing is faster and better")  # fmt: skip
        for kind, (label, colour, mark) in KINDS.items():
            for i, c in enumerate([c for c in contenders if c.kind == kind]):
                y, thin = height_of(c), {"color": colour, "linewidth": 1.0, "alpha": 0.6}
                axes.plot([c.seconds] * len(c.each), c.each, "_", markersize=9.0, **thin)
                if c.low is not None and c.high is not None:
                    axes.plot([c.seconds] * 2, [c.low, c.high], **thin)
                if c.fast is not None and c.slow is not None:
                    axes.plot([c.fast, c.slow], [y] * 2, **thin)
                axes.plot(c.seconds, y, mark if c.floors is not None else "x", color=colour, markersize=6.5,
                          linestyle="none", label=label if i == 0 else None)  # fmt: skip
        if not contenders:
            axes.text(0.5, 0.5, "no method was timed and judged", transform=axes.transAxes, ha="center")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower left", ncols=5)
        # The names stand in a column, in the order of the errors, each with a line to its mark.
        for place, c in zip(np.linspace(0.03, 0.97, len(contenders)), sorted(contenders, key=height_of), strict=True):
            text = c.name if c.floors is not None else f"{c.name} (failed)"
            leader = {"arrowstyle": "-", "color": QUIET, "linewidth": 0.5, "shrinkA": 0.0, "shrinkB": 4.0}
            axes.annotate(text, (c.seconds, height_of(c)), xytext=(1.02, place), textcoords="axes fraction", fontsize=9,
                          va="center", color=KINDS[c.kind][1], arrowprops=leader, annotation_clip=False)  # fmt: skip
    return Path(path)


def frontier(contenders: Sequence[Method]) -> list[Method]:
    """Those that no other beats, from fast to slow: none is as fast and as exact, and better in one of both.

    Failed runs are beaten by definition.
    """
    sound = [c for c in contenders if c.floors is not None]

    def beats(other: Method, one: Method) -> bool:
        better = other.seconds < one.seconds or other.floors < one.floors
        return better and other.seconds <= one.seconds and other.floors <= one.floors

    ahead = (one for one in sound if not any(beats(other, one) for other in sound))
    return sorted(ahead, key=lambda one: (one.seconds, one.name))


@dataclass(frozen=True)
class CostLine:
    """The cost of one method (``dem`` or ``surrogate``): wall time of a simulated second where it was measured, s.

    A single place, and no failure: the method costs the same everywhere. ``failed_at`` is where the method failed.
    """

    name: str
    kind: str
    at: Sequence[float]
    seconds: Sequence[float]
    failed_at: Sequence[float] = ()


def cost_against(
    lines: Sequence[CostLine], quantity: str, path: Path | str, level: tuple[str, float] | None = None
) -> Path:
    """Draw costs against a quantity, both axes logarithmic; a method with a single place becomes a level line.

    ``level`` is the name and the cost in s of something that costs the same everywhere.
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
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower left", ncols=2)
    return Path(path)
