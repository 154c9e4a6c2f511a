"""Loss curves of a training."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from gran_bench.plots.style import BASELINE, DEM, SURROGATE, coloured, drawing, mark_place, say

_SHOWN_ELSEWHERE = ("step", "loss", "learning_rate", "frames_ahead", "gradient_norm", "seconds", "minutes")


def loss_curves(losses: pd.DataFrame, path: Path | str) -> Path:
    """Draw the loss, its terms and the learning rate against the optimiser's steps.

    Args:
        losses: a row each time that losses were logged: ``step``, ``loss``, ``learning_rate``, ``frames_ahead``,
            and any further column as a term of the loss, all dimensionless.
        path: of the PNG.
    """
    with drawing(path, 8.8, 4.6) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3.2, 1.0))
        upper.set(title="Training loss", ylabel="loss, dimensionless")
        lower.set(ylabel="learning rate", xlabel="optimiser steps")
        if losses.empty:
            say(upper, "no losses were logged")
            return Path(path)
        step, window = losses["step"], max(1, len(losses) // 40)
        smooth = losses.rolling(window, min_periods=1, center=True).median()
        upper.plot(step, losses["loss"], color=SURROGATE, alpha=0.25, linewidth=0.9)
        label = "loss" if window == 1 else f"loss, running median of {window}"
        upper.plot(step, smooth["loss"], color=SURROGATE, label=label)
        terms = [name for name in losses.columns if name not in _SHOWN_ELSEWHERE]
        for name, colour in coloured(terms, (BASELINE,)):
            upper.plot(step, smooth[name], color=colour, linewidth=1.1, label=name.removeprefix("term/"))
        upper.set_yscale("log")
        if "frames_ahead" in losses:
            # The loss jumps where training began to look further ahead.
            frames = losses["frames_ahead"]
            for i in losses.index[1:][frames.diff().iloc[1:] != 0]:
                mark_place(upper, step[i], f"{int(frames[i])} frames ahead")
        upper.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
        if "learning_rate" in losses:
            lower.plot(step, losses["learning_rate"], color=DEM, linewidth=1.2)
            lower.set_ylim(bottom=0.0)
            lower.ticklabel_format(axis="y", style="sci", scilimits=(0, 0))
    return Path(path)
