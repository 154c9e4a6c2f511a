"""How every figure looks, and how it reaches the disk: whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gran_bench.files import whole_file

# Okabe & Ito's colours, told apart with every kind of colour vision.
DEM = "#000000"
SURROGATE = "#D55E00"
BASELINE = "#0072B2"
FURTHER = ("#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442")
QUIET = "#8a8a8a"
BAND = "#c4c4c4"
SPEED_MAP = "viridis"

_LOOK = {
    "font.family": "DejaVu Sans",
    "font.size": 10.0,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.7,
    "lines.linewidth": 1.6,
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "figure.facecolor": "white",
    "figure.dpi": 100.0,
}


_run_name: ContextVar[str | None] = ContextVar("run_name", default=None)


@contextmanager
def drawn_for(run_name: str) -> Iterator[None]:
    """Let every figure of the block carry the name of its run: in small print, and in the file's metadata.

    Args:
        run_name: that finds the run: the name of its folder.
    """
    token = _run_name.set(run_name)
    try:
        yield
    finally:
        _run_name.reset(token)


def run_drawn_for() -> str | None:
    """Name of the run that figures are drawn for at present."""
    return _run_name.get()


@contextmanager
def drawing(path: Path | str, width: float, height: float) -> Iterator[Figure]:
    """A figure of ``width`` × ``height`` inches that is written to ``path`` (PNG) when the block ends well.

    No global state of matplotlib is touched, so that figures can be drawn in threads and in a user's notebook.
    """
    with matplotlib.rc_context(_LOOK):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure
        name = run_drawn_for()
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


def speed_label(velocity_kind: str) -> str:
    """Label of an axis of speed that says which definition it uses."""
    return "speed, m/s" if velocity_kind == "instantaneous" else "speed (mean over a frame), m/s"
