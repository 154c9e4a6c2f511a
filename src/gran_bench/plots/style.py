"""How every figure looks, and how it reaches the disk: whole or not at all."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from gran_bench.files import whole_file

# Okabe & Ito's colours, told apart with every kind of colour vision.
DEM = "#000000"
SURROGATE = "#D55E00"
BASELINE = "#0072B2"
FURTHER = ("#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442")
QUIET = "#8a8a8a"
BAND = "#c4c4c4"
SPEED_MAP = "viridis"
ROUND = tuple(digit * 10.0**power for power in range(-3, 6) for digit in (1, 2, 5))  # numbers for ticks

LOOK = {
    **{"font.family": "DejaVu Sans", "font.size": 10.0, "lines.linewidth": 1.6},
    **{"axes.titlesize": 10.5, "axes.titlelocation": "left", "axes.spines.top": False, "axes.spines.right": False},
    **{"axes.linewidth": 0.8, "axes.grid": True, "axes.axisbelow": True, "grid.color": "#e6e6e6"},
    **{"grid.linewidth": 0.7, "legend.frameon": False, "legend.fontsize": 9.0, "figure.facecolor": "white"},
    "figure.dpi": 100.0,
}
run_name: ContextVar[str | None] = ContextVar("run_name", default=None)
heading: ContextVar[str] = ContextVar("heading", default="")


@contextmanager
def drawn_for(name: str) -> Iterator[None]:
    """Let every figure of the block carry the name of its run's folder: in small print, and in its metadata."""
    token = run_name.set(name)
    try:
        yield
    finally:
        run_name.reset(token)


@contextmanager
def titled(words: str) -> Iterator[None]:
    """Let every figure of the block say first what it is of: scene, speed and packing."""
    token = heading.set(words)
    try:
        yield
    finally:
        heading.reset(token)


@contextmanager
def drawing(path: Path | str, width: float, height: float) -> Iterator[Figure]:
    """A figure of ``width`` × ``height`` inches that is written to ``path`` (PNG) when the block ends well."""
    with matplotlib.rc_context(LOOK):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure
        if words := ": ".join(filter(None, (heading.get(), figure.get_suptitle()))):
            # Long words shrink to the figure's width.
            figure.suptitle(words, x=0.01, ha="left", fontsize=min(11.0, 125.0 * width / len(words)))
        name = run_name.get()
        if name is not None:
            # A caption of its own line, so that it covers nothing; long names shrink to the figure's width.
            size = min(6.5, 115.0 * width / max(len(name), 1))
            figure.supxlabel(name, x=0.995, ha="right", fontsize=size, color=QUIET)
        with whole_file(path) as temporary:
            description = None if name is None else {"Description": f"gran-bench run {name}"}
            figure.savefig(temporary, format="png", dpi=160, metadata=description)


def say(axes: Axes, text: str) -> None:
    """Write in the middle of an empty panel why it shows nothing."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color="#555555")
    axes.set_yticks([])
    axes.grid(False)


def coloured(things: Iterable[Any], first: Sequence[str] = (SURROGATE,)) -> Iterator[tuple[Any, str]]:
    """Each thing with a colour: of ``first``, then further ones, then all again, so that none is left out."""
    return zip(things, cycle((*first, *FURTHER)), strict=False)


def mark_place(axes: Axes, x: float, text: str, ha: str = "left") -> None:
    """Draw a dashed line at ``x``, with words at its foot, to its right or (``ha="right"``) to its left."""
    axes.axvline(x, color=QUIET, linewidth=0.9, linestyle=(0, (4, 3)))
    axes.annotate(text, (x, 0.03), xycoords=("data", "axes fraction"), xytext=(-5 if ha == "right" else 5, 0),
                  textcoords="offset points", ha=ha, fontsize=8.5, color="#555555", annotation_clip=True)  # fmt: skip


def plain_numbers(*logarithmic: Axis) -> None:
    """Let the ticks of logarithmic axes read 0.5 and 20 instead of powers of ten."""
    for axis in logarithmic:
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())


def speed_label(velocity_kind: str) -> str:
    """Label of an axis of speed that says which definition it uses."""
    return "speed, m/s" if velocity_kind == "instantaneous" else "speed (mean over a frame), m/s"
