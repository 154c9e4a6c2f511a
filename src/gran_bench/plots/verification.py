"""Figures of verification: oblique impacts, what the time step does, the drum beside another code, a hopper's flow."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter
from scipy.stats import ttest_1samp

from gran_bench.plots.style import BAND, BASELINE, DEM, FURTHER, QUIET, ROUND, SURROGATE, drawing, say
from gran_bench.state import FloatArray
from gran_bench.verification import Outcome
from gran_bench.verification.convergence import DRIFT_BOUND

GRAVITY = 9.81  # m/s²
# (curves of the case, label, colour, marker)
IMPACTS = (
    ("aluminium oxide", "alumina on a rigid plane, e 0.98, μ 0.092 (Chung & Ooi, test 4)", BASELINE, "o"),
    ("wall E 7e+10 e 1 mu 0.3", "stiff sphere on a wall (70 GPa), e 1, μ 0.3", FURTHER[0], "s"),
    ("wall E 1e+07 e 0.5 mu 0.3", "soft sphere on a wall (10 MPa), e 0.5, μ 0.3", SURROGATE, "D"),
)
PANELS = (
    ("tangential_restitution", "tangential restitution  $v_t' / v_t$", (0.5, 1.02)),
    ("spin", "spin after the impact  $R\\,\\omega' / v$", (0.0, None)),
    ("rebound_angle_deg", "rebound angle of the contact point, °", (-30.0, 90.0)),
)


def draw_verification(outcomes: Sequence[Outcome], folder: Path) -> list[str]:
    """Draw to the page's folder what the cases that were run allow; the names of the files."""
    curves = {name: values for outcome in outcomes for name, values in outcome.curves.items()}
    names = []
    if any(name.startswith(tuple(f"{key}|" for key, *_ in IMPACTS)) for name in curves):
        _oblique_impact(curves, folder / "oblique_impact.png")
        names.append("oblique_impact.png")
    if any(name.endswith(("|error", "|change")) for name in curves):
        _step(curves, folder / "step.png")
        names.append("step.png")
    return names


def _oblique_impact(curves: dict[str, FloatArray], path: Path) -> None:
    with drawing(path, 11.0, 4.6) as figure:
        panels = figure.subplots(1, 3)
        for axes, (quantity, title, (low, high)) in zip(panels, PANELS, strict=True):
            for key, label, colour, marker in IMPACTS:
                if f"{key}|found_angle_deg" not in curves:
                    continue
                angle = curves[f"{key}|expected_angle_deg"]
                axes.plot(angle, curves[f"{key}|expected_{quantity}"], color=colour, zorder=2)
                sliding = curves.get(f"{key}|sliding_{quantity}")
                if sliding is not None:
                    axes.plot(angle, sliding, color=DEM, linewidth=1.0, linestyle=(0, (2, 2)), zorder=3)
                axes.plot(curves[f"{key}|found_angle_deg"], curves[f"{key}|found_{quantity}"], marker, color=colour,
                          markersize=4.8, markerfacecolor="white", markeredgewidth=1.2, label=label)  # fmt: skip
            axes.set(title=title, xlim=(0.0, 90.0), ylim=(low, high), xlabel="impact angle from the normal, °")
            axes.set_xticks(range(0, 91, 15))
        panels[2].axhline(0.0, color=QUIET, linewidth=0.8, zorder=1)
        panels[2].set_yticks(range(-30, 91, 30))
        panels[0].plot([], [], color=QUIET, label="lines: Hertz–Mindlin in continuous time")
        dashes = {"color": DEM, "linewidth": 1.0, "linestyle": (0, (2, 2))}
        panels[0].plot([], [], label="dashes: rigid bodies that slide all through", **dashes)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)


def _step(curves: dict[str, FloatArray], path: Path) -> None:
    def pairs(across: str, up: str) -> dict[str, tuple[FloatArray, FloatArray]]:
        names = [key.removesuffix(f"|{up}") for key in curves if key.endswith(f"|{up}")]
        return {name: (curves[f"{name}|{across}"], curves[f"{name}|{up}"]) for name in names}

    with drawing(path, 11.0, 4.4) as figure:
        left, right = figure.subplots(1, 2)
        _order(left, pairs("step", "error"))
        _drift(right, pairs("time", "change"))


def _order(axes: Axes, series: dict[str, tuple[FloatArray, FloatArray]]) -> None:
    axes.set_title("error against the step")
    if not series:
        say(axes, "the case 'order' was not run")
        return
    looks = ((BASELINE, "o"), (FURTHER[3], "x"), (FURTHER[0], "s"), (SURROGATE, "D"))
    for (name, (step, error)), (colour, marker) in zip(series.items(), looks, strict=False):
        axes.loglog(step, error, marker, color=colour, linestyle="-", linewidth=1.2, markersize=5, label=_named(name))
    step = np.array([min(s.min() for s, _ in series.values()), max(s.max() for s, _ in series.values())])
    lowest, highest = min(e.min() for _, e in series.values()), max(e.max() for _, e in series.values())
    for power, anchor in ((1, 1.8 * highest / step[1]), (2, 3.0 * lowest / step[0] ** 2)):
        axes.loglog(step, anchor * step**power, color=QUIET, linewidth=1.0, linestyle=(0, (2, 2)), zorder=1)
        axes.annotate(f"order {power}", (step[0], anchor * step[0] ** power), xytext=(0, 5 + 6 * power),
                      textcoords="offset points", color="#555555", fontsize=9, va="bottom")  # fmt: skip
    axes.set(xlabel="step, of the contact time", ylabel="relative error")
    axes.set_xticks([1 / 800, 1 / 400, 1 / 200, 1 / 100, 1 / 50, 1 / 25])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"1/{round(1 / value)}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.legend(loc="lower right")


def _drift(axes: Axes, series: dict[str, tuple[FloatArray, FloatArray]]) -> None:
    axes.set_title("energy of an elastic gas of 27 spheres")
    if not series:
        say(axes, "the case 'energy-drift' was not run")
        return
    for (name, (time, change)), colour in zip(series.items(), (SURROGATE, BASELINE, FURTHER[0]), strict=False):
        share = time / time[-1]
        axes.plot(100 * share, 1e3 * change, color=colour, linewidth=1.0, label=f"{_named(name)}, {time[-1]:.3g} s")
        bound = 1e3 * DRIFT_BOUND / float(name.split("t_c/")[1]) ** 2
        if colour != FURTHER[0]:
            for sign in (-1.0, 1.0):
                axes.axhline(sign * bound, color=colour, linewidth=1.0, linestyle=(0, (4, 2)))
    axes.set(xlabel="share of the run, %", ylabel="change of energy, ‰", xlim=(0.0, 100.0))
    axes.plot([], [], color=QUIET, linewidth=1.0, linestyle=(0, (4, 2)), label=r"bounds $3\,(\Delta t/t_c)^2$")
    axes.legend(loc="center right", bbox_to_anchor=(1.0, 0.75))


def _named(name: str) -> str:
    """A curve's name with the stiffness as people say it."""
    return name.replace("E 1e+07 Pa", "10 MPa").replace("E 7e+10 Pa", "70 GPa").replace("t_c", "$t_c$")


def draw_drum_flow(
    path: Path | str,
    samples: Mapping[tuple[str, float], Sequence[FloatArray]],
    bounds: Mapping[float, Sequence[tuple[float, float]]],
    labels: Sequence[str],
) -> None:
    """A panel for each quantity and speed: a dot a packing, the mean with its 95 % interval, the bound as a band.

    Samples are ``(n,)`` values for each quantity, by code and speed in rpm; bounds a middle and a half width.
    """
    codes = list(dict.fromkeys(code for code, _ in samples))
    speeds = sorted({rpm for _, rpm in samples})
    with drawing(path, max(3.6, 1.45 * len(codes)) * len(speeds), 2.5 * len(labels)) as figure:
        grid = figure.subplots(len(labels), len(speeds), squeeze=False)
        for column, rpm in enumerate(speeds):
            for row, label in enumerate(labels):
                axes = grid[row, column]
                if rpm in bounds:
                    middle, half = bounds[rpm][row]
                    axes.axhspan(middle - half, middle + half, color=BAND, alpha=0.5, linewidth=0)
                for place, code in enumerate(codes):
                    if (code, rpm) not in samples:
                        continue
                    values = samples[code, rpm][row]
                    spread = np.linspace(-0.15, 0.15, len(values))
                    colour = DEM if code.startswith(codes[0]) else BASELINE  # the first, or it with something changed
                    axes.plot(place + spread, values, "o", color=colour, markersize=3.5, alpha=0.7)
                    low, high = ttest_1samp(values, 0.0).confidence_interval(0.95)
                    middle, half = 0.5 * (low + high), 0.5 * (high - low)
                    axes.errorbar(place + 0.3, middle, half, fmt="_", color=colour, capsize=3)
                axes.set_xticks(range(len(codes)), [code.replace(", ", ",\n") for code in codes])
                title = "" if row else f"drum, {rpm:g} rpm; a dot is a packing"
                axes.set(xlim=(-0.5, len(codes) - 0.3), ylabel=label, title=title)


@dataclass(frozen=True)
class HopperDischarge:
    """Flows out of hoppers that differ in their orifice alone."""

    orifice: FloatArray  # ``(K,)`` D, m
    flow: FloatArray  # ``(K,)`` W, kg/s
    flow_error: FloatArray  # ``(K,)`` standard error of W from the scatter of blocks of time, kg/s
    exponent: float  # of D − k d, by least squares of the logarithms
    exponent_error: float  # its standard error: of the straight line or of the flows, whichever is larger
    factor: float  # C of the law with exponent 5/2, −, with the bulk density of the settled bed
    diameter: float  # d, m
    bulk_density: float  # ρ_b, kg/m³
    rim: float  # k, −

    @property
    def opening(self) -> FloatArray:
        """D − k d, ``(K,)`` m."""
        return self.orifice - self.rim * self.diameter


def draw_discharge(path: Path | str, result: HopperDischarge) -> None:
    """The flows against D − k d, both axes logarithmic, with Beverloo's law and the fitted one."""
    line = np.geomspace(0.9 * result.opening.min(), 1.1 * result.opening.max(), 50)
    law = result.factor * result.bulk_density * math.sqrt(GRAVITY) * line**2.5
    middle = np.exp(np.log(result.opening).mean()), np.exp(np.log(result.flow).mean())
    with drawing(path, 5.2, 4.0) as figure:
        axes = figure.add_subplot()
        axes.loglog(line, law, color=BASELINE, label=f"Beverloo, exponent 2.5, C = {result.factor:.3f}")
        fitted = middle[1] * (line / middle[0]) ** result.exponent
        label = f"fit, exponent {result.exponent:.3f} ± {result.exponent_error:.3f}"
        axes.loglog(line, fitted, "--", color=DEM, linewidth=1.0, label=label)
        axes.errorbar(result.opening, result.flow, 2.0 * result.flow_error, fmt="o", color=DEM, markersize=4)
        for x, y, orifice in zip(result.opening, result.flow, result.orifice, strict=True):
            axes.annotate(f"{orifice / result.diameter:.3g} d", (x, y), (6, -10), textcoords="offset points")
        axes.set(xlabel=f"D − {result.rim:g} d, m", ylabel="mass flow, kg/s", title="Discharge of a conical hopper")
        ticks = np.round(result.opening, 3)
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        levels = [tick for tick in ROUND if 0.8 * result.flow.min() < tick < 1.4 * result.flow.max()]
        axes.set_yticks(levels, [f"{level:g}" for level in levels])
        axes.minorticks_off()
        axes.legend(loc="upper left")
