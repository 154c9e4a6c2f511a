"""The figures of the stress test: time to failure by model and speed, and what the DEM's step does."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.ticker import NullFormatter

from gran_bench.plots.style import BAND, BASELINE, DEM, FURTHER, QUIET, ROUND, SURROGATE, drawing, plain_numbers, say

TRAINED = (20.0, 60.0)  # rpm, the range of the training speeds of the shipped model
MARKS = ("o", "s", "D", "v", "P", "X")  # of failures; a hollow triangle points up from where none was


def draw_time_to_failure(runs: Mapping[str, Sequence[tuple[float, float, bool]]], path: Path | str) -> Path:
    """How long each model's rollout lasts, against the speed of the drum.

    A run is its speed in rpm, the time to failure or of its end in s, and whether it survived.
    """
    speeds = sorted({speed for rows in runs.values() for speed, _, _ in rows})
    with drawing(path, 8.4, 4.2) as figure:
        axes = figure.subplots()
        axes.set_title("rollouts: simulated time until the first failure")
        if not any(runs.values()):
            say(axes, "no rollout was run")
            return Path(path)
        places = {speed: speed if speed <= 120.0 else 120.0 + 15.0 * math.log2(speed / 120.0) for speed in speeds}
        axes.axvspan(*TRAINED, color="#f0f0f0", zorder=0, label="speeds of training, shipped model")
        colours = (SURROGATE, BASELINE, *FURTHER)
        for k, (model, rows) in enumerate(runs.items()):
            # Side by side where two models share a speed.
            shift, colour, mark = 2.5 * k, colours[k % len(colours)], MARKS[k % len(MARKS)]
            axes.plot([], [], mark, color=colour, markersize=7, label=model)
            for speed, seconds, survived in rows:
                x, face = places[speed] + shift, "white" if survived else colour
                axes.plot([x, x], [1e-2, seconds], color=colour, linewidth=1.0, alpha=0.5)
                axes.plot(x, seconds, "^" if survived else mark, color=colour, markersize=7.5, markerfacecolor=face)
        axes.plot([], [], "^", color=QUIET, markerfacecolor="white", markersize=8, label="did not fail until there")
        axes.set(yscale="log", ylim=(1e-2, 100.0), ylabel="time to failure, s")
        axes.set_xlabel("speed of the drum, rpm; to scale up to 120")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_xticks(list(places.values()), [f"{speed:g}" for speed in speeds])
        figure.legend(loc="outside lower center", ncols=3)
    return Path(path)


def draw_dem_step(curves: Mapping[str, Sequence[float]], path: Path | str) -> Path:
    """Error and cost of the DEM against its step.

    Curves are lists: ``step`` (s), ``error`` (degrees; inf where the run ended with an error), ``cost`` (ms a frame),
    ``floor`` (degrees), ``contact_time`` and ``production`` (s).
    """
    step, error, cost = (np.array(curves[name], float) for name in ("step", "error", "cost"))
    floor, contact = curves["floor"][0], curves["contact_time"][0]
    alive, shown = np.isfinite(error), np.isfinite(error) & (error > 0)
    lowest, highest = 0.2 * min([*error[shown], floor]), 3.0 * max([*error[shown], floor])
    with drawing(path, 9.6, 4.2) as figure:
        left, right = figure.subplots(1, 2)
        left.axhspan(1e-3, floor, color="#f0f0f0", zorder=0)
        left.axhline(floor, color=BAND, linewidth=1.0)
        left.text(1.05e3 * step[0], floor * 0.9, "floor: nudged by 1e-9 m", fontsize=8.5, color="#666666", va="top")
        left.loglog(1e3 * step[shown], error[shown], "o-", color=DEM)
        left.loglog(1e3 * step[~alive], np.full((~alive).sum(), highest / 1.5), "x", color=SURROGATE, markersize=9,
                    label="ends with an error")  # fmt: skip
        left.set(ylim=(lowest, highest), yticks=[tick for tick in ROUND if lowest < tick < highest])
        left.set(ylabel="error of the angle of the centre of mass, °", title="error against step")
        right.loglog(1e3 * step[alive], cost[alive], "o-", color=DEM)
        right.set(ylabel="run time of a frame of 10 ms, ms", title="cost against step")
        right.set_yticks([tick for tick in ROUND if cost[alive].min() / 2 < tick < 2 * cost[alive].max()])
        for axes in (left, right):
            plain_numbers(axes.yaxis)
            for share, word, style in ((0.1, "warned", (0, (2, 2))), (0.2, "refused", (0, (5, 2)))):
                axes.axvline(1e3 * share * contact, color=QUIET, linewidth=1.0, linestyle=style,
                             label=f"{word} from {share:g} of the contact time")  # fmt: skip
            axes.axvline(1e3 * curves["production"][0], color=BASELINE, linewidth=1.0, label="step of the data")
            axes.set_xlabel("step, ms")
            axes.set_xticks(1e3 * step, [f"{1e3 * s:g}" for s in step], rotation=45)
            axes.xaxis.set_minor_formatter(NullFormatter())
        left.legend(loc="lower right", facecolor="white", frameon=True, edgecolor="none")
    return Path(path)


def draw_energy_drift(curves: Mapping[str, Sequence[float]], path: Path | str) -> Path:
    """Largest change of an elastic gas's energy against the step.

    Curves are lists: ``steps_per_contact`` (t_c over the step), ``change`` (of the energy; inf where it diverged) and
    ``bound`` (of (Δt/t_c)²).
    """
    share = 1.0 / np.array(curves["steps_per_contact"], float)
    change, bound = np.array(curves["change"], float), curves["bound"][0]
    alive = np.isfinite(change)
    with drawing(path, 6.4, 4.2) as figure:
        axes = figure.subplots()
        axes.set_title("energy of an elastic gas of 27 spheres")
        axes.loglog(share[alive], change[alive], "o-", color=DEM, label="largest change of the energy")
        axes.loglog(share, bound * share**2, color=QUIET, linestyle=(0, (5, 2)), linewidth=1.0,
                    label=rf"{bound:g} $(\Delta t/t_c)^2$")  # fmt: skip
        if (~alive).any():
            axes.loglog(share[~alive], np.full((~alive).sum(), 2.0 * change[alive].max()), "x", color=SURROGATE,
                        markersize=9, label="ends with an error")  # fmt: skip
        axes.axvline(0.2, color=BASELINE, linewidth=1.0, label="a larger step is refused")
        axes.set_xticks(share, [f"1/{1 / s:.3g}" for s in share], rotation=45)
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set(xlabel="step, of the contact time", ylabel="change, of the energy")
        axes.legend()
    return Path(path)
