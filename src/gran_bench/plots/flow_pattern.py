"""The flow pattern of one instant, seen along the drum's axis, coloured by speed (paper, Fig. 2)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.patches import Circle

from gran_bench.metrics.measured import frame_at
from gran_bench.metrics.speeds import velocities
from gran_bench.metrics.summary import PATTERN_TIME
from gran_bench.plots.spheres import draw_spheres, halved, shaded, view_along_axis
from gran_bench.plots.style import QUIET, SPEED_MAP, drawing, say, speed_label
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, Trajectory

MARGIN = 1.06  # of the drum's radius, half the picture's width


def flow_pattern(runs: Mapping[str, Trajectory], scene: Scene, path: Path | str, time: float = PATTERN_TIME) -> Path:
    """Draw the flow patterns of several runs side by side, on one scale of speed.

    Args:
        runs: by the name that stands over the panel; speeds are of the definition of the run's own velocities,
            unless they differ, then all are means over the frame.
        scene: that all were made for.
        path: of the PNG.
        time: s.

    Returns:
        The path.
    """
    kinds = {run.velocity_kind for run in runs.values()}
    kind = kinds.pop() if len(kinds) == 1 else "mean"
    frames = {name: frame_at(run.time, time) for name, run in runs.items()}
    speeds = {
        name: np.linalg.norm(velocities(run, kind, scene.period)[frames[name]], axis=1)
        for name, run in runs.items()
        if frames[name] is not None
    }
    norm = Normalize(0.0, fastest(list(speeds.values())))
    with drawing(path, 4.1 * len(runs) + 0.9, 4.35) as figure:
        panels = figure.subplots(1, len(runs), squeeze=False, sharey=True)[0]
        for axes, (name, run) in zip(panels, runs.items(), strict=True):
            axes.set_title(name)
            if frames[name] is None:
                say(axes, f"no state at {time:g} s")
                continue
            draw_pattern(axes, run.position[frames[name]], speeds[name], run.radius, scene, norm)
        panels[0].set_ylabel("height z, m")
        for axes in panels[1:]:
            axes.tick_params(left=False)
        figure.colorbar(
            ScalarMappable(norm, SPEED_MAP),
            ax=panels,
            label=speed_label(kind),
            shrink=0.82,
            pad=0.015,
            aspect=28,
            extend="max",
        )
        figure.suptitle(f"Flow pattern at {time:g} s, seen along the axis", x=0.01, ha="left", fontsize=12)
    return Path(path)


def draw_pattern(
    axes: Axes,
    position: FloatArray,
    speed: FloatArray,
    radius: FloatArray,
    scene: Scene,
    norm: Normalize,
    pixels: int = 640,
) -> None:
    """Draw one bed into a panel: spheres to scale, the drum's circle, and how many spheres cannot be shown.

    Args:
        axes: to draw in.
        position: ``(N, 3)`` m.
        speed: ``(N,)`` m/s.
        radius: ``(N,)`` m.
        scene: its drum.
        norm: the scale of speed.
        pixels: of the picture's edge.
    """
    half = view_half_width(position, scene)
    across, away = view_along_axis(position.astype(np.float64), scene)
    image = draw_spheres(across, away, radius.astype(np.float64), half, 2 * pixels)
    colours = matplotlib.colormaps[SPEED_MAP](norm(np.nan_to_num(speed)))[:, :3]
    axes.imshow(halved(shaded(image, colours)), extent=(-half, half, -half, half), interpolation="antialiased")
    if scene.drum_radius is not None:
        axes.add_patch(Circle((0, 0), scene.drum_radius, fill=False, edgecolor="#444444", linewidth=1.6))
    if image.unseen:
        axes.text(
            0, 0.97 * half, f"{image.unseen} spheres not finite or out of sight", ha="center", va="top", fontsize=9
        )
    axes.set_aspect("equal")
    axes.set_xlabel("x, m")
    axes.grid(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_visible(False)
    axes.tick_params(length=2, color=QUIET)


def view_half_width(position: FloatArray, scene: Scene) -> float:
    """Half the width of a picture that holds the drum, or the finite spheres where there is none, m."""
    if scene.drum_radius is not None:
        return MARGIN * scene.drum_radius
    finite = position[np.isfinite(position).all(axis=-1)]
    return MARGIN * float(np.abs(finite).max(initial=0.0) + scene.filling.diameter)


def fastest(speeds: list[FloatArray]) -> float:
    """Upper end of a scale of speed: the 99.5 % quantile of the finite speeds, in steps of 0.1 m/s, at least 0.1."""
    together = np.concatenate([speed.ravel() for speed in speeds]) if speeds else np.zeros(1)
    together = together[np.isfinite(together)]
    return max(0.1, 0.1 * float(np.ceil(10.0 * np.quantile(together, 0.995)))) if len(together) else 1.0
