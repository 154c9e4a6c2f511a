"""Power, its balance and the spectra of impacts, of a run that counted its energy."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from gran_bench.dem.energy import KINDS, LOSSES, spectrum_edges
from gran_bench.dem.energy_balance import EnergyBalance
from gran_bench.plots.style import BASELINE, DEM, FURTHER, QUIET, SURROGATE, drawing
from gran_bench.state import FloatArray, Trajectory

SMOOTH = 0.1  # s, of the moving means: a frame of few spheres is noise
_SHOWN = {
    "impact": "Impacts, by ½ m* v²",
    "normal": "Ended contacts, by normal loss",
    "shear": "Ended contacts, by shear loss",
}


def energy_balance(trajectory: Trajectory, path: Path | str, steady_from: float | None = None) -> Path:
    """Draw power against time, where it goes, and the spectra of the frames after ``steady_from``, s, or of all.

    A `ValueError` for a run that did not count its energy.
    """
    balance = EnergyBalance.of(trajectory)
    with drawing(path, 12.5, 6.8) as figure:
        panels = figure.subplots(2, 3)
        _draw_power(panels[0, 0], balance)
        _draw_losses(panels[0, 1], balance)
        _draw_remainder(panels[0, 2], balance)
        steady = trajectory.time > (-np.inf if steady_from is None else steady_from)
        steady[0] = False  # it has no frame before it
        for axes, (name, title) in zip(panels[1], _SHOWN.items(), strict=True):
            _draw_spectrum(axes, trajectory, name, steady)
            axes.set(title=title, xlabel="energy, J", ylabel="rate a bin, 1/s")
    return Path(path)


def _draw_power(axes: Axes, balance: EnergyBalance) -> None:
    for values, colour, label in (
        (balance.power, DEM, "given by the walls"), (balance.loss, SURROGATE, "lost in contacts"),
        (balance.storing, BASELINE, "stored"), (balance.outflow, FURTHER[0], "leaves with spheres"),
    ):  # fmt: skip
        if values.any():
            axes.plot(balance.time, _smooth(balance.time, values), color=colour, label=label)
    axes.set(title=f"Power, means over {SMOOTH:g} s", xlabel="time, s", ylabel="power, W")
    axes.legend()


def _draw_losses(axes: Axes, balance: EnergyBalance) -> None:
    """Losses of pairs and walls together, one above the other."""
    names = [name for name in LOSSES if any(balance.losses[f"{kind}loss_{name}"].any() for kind in KINDS)]
    heights = [_smooth(balance.time, sum(balance.losses[f"{kind}loss_{name}"] for kind in KINDS)) for name in names]
    if names:
        labels, colours = [name.replace("_", " ") for name in names], (SURROGATE, BASELINE, *FURTHER)
        axes.stackplot(balance.time, heights, labels=labels, colors=colours[: len(names)])
        axes.legend()
    axes.set(title=f"Where it is lost, means over {SMOOTH:g} s", xlabel="time, s", ylabel="power, W")


def _draw_remainder(axes: Axes, balance: EnergyBalance) -> None:
    interval = np.diff(balance.time, prepend=2.0 * balance.time[0] - balance.time[min(1, len(balance.time) - 1)])
    given, left = np.cumsum(balance.power * interval), np.cumsum(balance.unaccounted * interval)
    axes.plot(balance.time, left, color=DEM)
    axes.axhline(0.0, color=QUIET, linewidth=0.8)
    share = f": {100.0 * left[-1] / given[-1]:.2g} % of the work of the walls" if given[-1] else ""
    axes.set(title=f"Unaccounted{share}", xlabel="time, s", ylabel="energy since the start, J")


def _draw_spectrum(axes: Axes, trajectory: Trajectory, name: str, chosen: np.ndarray) -> None:
    edges = spectrum_edges()
    for kind, label, colour in zip(KINDS, ("pairs", "walls"), (DEM, SURROGATE), strict=True):
        rate = trajectory.energy[f"{kind}spectrum_{name}"][chosen].mean(axis=0)
        axes.stairs(np.where(rate > 0.0, rate, np.nan), edges, color=colour, label=label)
    axes.set(xscale="log", yscale="log")
    axes.legend()


def _smooth(time: FloatArray, values: FloatArray) -> FloatArray:
    """Moving means; at the ends of the frames that there are."""
    frames = max(1, round(SMOOTH / float(np.diff(time).min()))) if len(time) > 1 else 1
    window = np.ones(min(frames, len(values)))
    return np.convolve(values, window, "same") / np.convolve(np.ones_like(values), window, "same")
