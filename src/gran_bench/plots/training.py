"""Training: loss curves, and a swept choice against error and time."""

import math
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator

from gran_bench.plots import style
from gran_bench.plots.style import BASELINE, DEM, FURTHER, QUIET, SURROGATE, drawing, plain_numbers, say

PANELS = (
    ("headline/angle error floors", "angle error, noise floors"),
    ("headline/com angle error floors", "centre-of-mass angle, floors"),
    ("headline/speed W1 floors", "speed W1, noise floors"),
    ("headline/position error 10 frames mm", "position error after 10 frames, mm"),
    ("headline/rollout ms per frame", "time for a frame, ms"),
    ("training.steps", "updates in the time given"),
)
RUN_TIMES = ("headline/rollout ms per frame", "training.steps")  # of the panels; what else ran counts in them
COST_NOTHING = ("loss", "rollout", "optim", "trainer", "seed")  # sections of the recipe that a frame's time has not
VALIDATION = "validation_loss"
_SHOWN_ELSEWHERE = (
    *("step", "loss", "learning_rate", "frames_ahead", "gradient_norm", "seconds", "minutes", VALIDATION),
)
LOG_FROM = 15.0  # largest over smallest figure from which a panel is logarithmic
CROWDED = 4  # numbers below an axis from which on they would touch
COLOURS = (SURROGATE, BASELINE, *FURTHER, DEM)
MARKERS = "osD^v"  # for each round of the colours another
BREADTH = 0.7  # of all series over a name, where names are 1 apart
LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))


def sweep_axis(runs: pd.DataFrame, axis: str, others: Sequence[str], path: Path | str, title: str) -> Path:
    """Draw one axis of a sweep against errors and time: a point a seed, the means, failed runs at the upper edge.

    ``runs`` has a row a run: the swept keys as text, ``status``, and the figures of the panels, NaN where undefined.
    Values of ``axis`` that are numbers are spaced so, with a line through the means, but for seeds and run times: one
    seed leads to no other, and other work on the machine is no effect of a choice. Each combination of the ``others``
    has a colour.
    """
    values = list(dict.fromkeys(runs[axis]))
    numbers = pd.to_numeric(pd.Series(values, dtype=object), errors="coerce").tolist()
    as_numbers = all(math.isfinite(number) for number in numbers)
    as_numbers &= axis != "seed"
    place = dict(zip(values, numbers if as_numbers else range(len(values)), strict=True))
    turned = {} if as_numbers and len(values) <= CROWDED else {"rotation": 45, "ha": "right", "rotation_mode": "anchor"}
    series = list(runs.groupby(list(others), sort=False)) if others else [((), runs)]
    with drawing(path, 13.0, 7.2) as figure:
        figure.suptitle(title)
        panels = figure.subplots(2, 3).ravel()
        for axes, (name, label) in zip(panels, PANELS, strict=True):
            axes.set(ylabel=label, xlabel=axis)
            timed, unmoved = name in RUN_TIMES, axis == "seed" or axis.partition(".")[0].lstrip("+") in COST_NOTHING
            if timed and (axis == "seed" or (unmoved and name == RUN_TIMES[0])):
                say(axes, f"{axis} has no part in {label.partition(',')[0]}")
                axes.set_xticks([])
                continue
            if timed:
                axes.set_title("other work on the machine counts", fontsize=8.5, color=QUIET)
            _points(axes, series, axis, name, place, as_numbers, joined=as_numbers and not timed)
            axes.set_xticks([place[value] for value in values], values, **turned)
            if not as_numbers:
                axes.set_xlim(-0.5, len(values) - 0.5)
            if runs.loc[runs["status"] == "finished", name].isna().all():
                say(axes, "undefined in every run")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return Path(path)


def _points(
    axes: Axes, series: list, axis: str, name: str, place: dict[str, float], as_numbers: bool, joined: bool
) -> None:
    """Seeds, means and failures of one panel; series stand beside each other over a name, at a number in its place."""
    breadth, every = 0.0 if as_numbers else BREADTH / len(series), []
    for number, (values, runs) in enumerate(series):
        colour, style = COLOURS[number % len(COLOURS)], number // len(COLOURS) % len(MARKERS)
        label = ", ".join(values if isinstance(values, tuple) else (values,)) or "mean over seeds"
        beside = breadth * (number - 0.5 * (len(series) - 1))
        x, y = runs[axis].map(place) + beside, pd.to_numeric(runs[name], errors="coerce").astype(float)
        good = y.notna()
        every.append(y[good])
        axes.plot(x[good], y[good], MARKERS[style], color=colour, markersize=4.0, alpha=0.6)
        means = y[good].groupby(x[good]).mean().sort_index()
        if joined:
            axes.plot(means.index, means.to_numpy(), color=colour, linestyle=LINES[style], label=label)
        else:
            axes.hlines(means, means.index - 0.45 * breadth, means.index + 0.45 * breadth, color=colour, linewidth=2.0)
            # For the legend: a point of the seeds stands for them and their mean.
            axes.plot([], [], MARKERS[style], color=colour, label=label)
        if not good.all():
            # At the upper edge of the panel, wherever its scale ends: a failure has no figure and must still be seen.
            axes.plot(
                x[~good], [0.985] * int((~good).sum()), "x", color=colour, markersize=7.0, markeredgewidth=2.0,
                clip_on=False, transform=axes.get_xaxis_transform(),
            )  # fmt: skip
    axes.plot([], [], "x", color=QUIET, markersize=7.0, markeredgewidth=2.0, label="failed or undefined")
    found = pd.concat(every)
    if found.empty:
        return
    if found.min() > 0 and found.max() > LOG_FROM * found.min():
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        plain_numbers(axes.yaxis)
    else:
        axes.set_ylim(0.0, 1.08 * found.max() if found.max() > 0 else 1.0)


def loss_curves(losses: pd.DataFrame, path: Path | str) -> Path:
    """Draw the loss, its terms and the learning rate against the optimiser's steps.

    ``losses`` has a row each time that losses were logged: ``step``, ``loss``, ``learning_rate``, ``frames_ahead``, and
    any further column as a term of the loss, all dimensionless.
    """
    with drawing(path, 8.8, 4.6) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3.2, 1.0))
        upper.set(title="Loss", ylabel="loss, dimensionless")
        lower.set(ylabel="learning rate", xlabel="optimiser steps")
        if losses.empty:
            say(upper, "no losses were logged")
            return Path(path)
        step, window = losses["step"], max(1, len(losses) // 40)
        smooth = losses.rolling(window, min_periods=1, center=True).median()
        upper.plot(step, losses["loss"], color=SURROGATE, alpha=0.25, linewidth=0.9)
        label = "loss" if window == 1 else f"loss, running median of {window}"
        upper.plot(step, smooth["loss"], color=SURROGATE, label=label)
        if VALIDATION in losses:
            known = losses[VALIDATION].notna()
            upper.plot(step[known], smooth[VALIDATION][known], color=DEM, linestyle=LINES[1], label="loss, validation")
        terms = [name for name in losses.columns if name not in _SHOWN_ELSEWHERE]
        for name, colour in style.coloured(terms, (BASELINE,)):
            upper.plot(step, smooth[name], color=colour, linewidth=1.1, label=name.removeprefix("term/"))
        upper.set_yscale("log")
        if "frames_ahead" in losses:
            # The loss jumps where training began to look further ahead.
            frames = losses["frames_ahead"]
            for i in losses.index[1:][frames.diff().iloc[1:] != 0]:
                style.mark_place(upper, step[i], f"{int(frames[i])} frames ahead")
        upper.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
        if "learning_rate" in losses:
            lower.plot(step, losses["learning_rate"], color=DEM, linewidth=1.2)
            lower.set_ylim(bottom=0.0)
            lower.ticklabel_format(axis="y", style="sci", scilimits=(0, 0))
    return Path(path)
