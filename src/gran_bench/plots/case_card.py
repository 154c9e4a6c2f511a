"""One figure that shows a case of the data set: flow patterns, angle of repose, speeds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize

from gran_bench.metrics.angle_of_repose import com_angle, surface_angle
from gran_bench.metrics.measured import frame_at
from gran_bench.metrics.summary import PATTERN_TIME
from gran_bench.plots.flow import draw_pattern, fastest, finish_patterns
from gran_bench.plots.style import BASELINE, DEM, QUIET, SURROGATE, drawing, say
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, Trajectory

SHARES = ((5, 95, "#dbe7f1", "5–95 %"), (25, 75, "#a9c8e0", "25–75 %"))  # of the spheres, per cent


def case_card(trajectory: Trajectory, scene: Scene, path: Path | str, title: str = "") -> Path:
    """Draw a case of the DEM: three flow patterns above, angle and speeds against time below.

    Args:
        trajectory: of the DEM.
        scene: that it was made for.
        path: of the PNG.
        title: over the figure; the scene and its speed where empty.
    """
    speed = np.linalg.norm(trajectory.velocity, axis=2)
    norm, instants = Normalize(0.0, fastest([speed])), _instants(scene)
    with drawing(path, 10.0, 7.0) as figure:
        upper, lower = figure.subfigures(2, 1, height_ratios=(1.25, 1.0))
        figure.suptitle(title or default_title(scene), x=0.01, ha="left", fontsize=12)
        panels = upper.subplots(1, len(instants), sharey=True, squeeze=False)[0]
        for axes, time in zip(panels, instants, strict=True):
            frame = frame_at(trajectory.time, time)
            axes.set_title(f"{time:g} s")
            if frame is None:
                say(axes, f"no state at {time:g} s")
                continue
            draw_pattern(axes, trajectory.position[frame], speed[frame], trajectory.radius, scene, norm)
        finish_patterns(upper, panels, norm, "speed, m/s", shrink=0.8)
        left, right = lower.subplots(1, 2)
        _draw_angles(left, trajectory, scene)
        _draw_speeds(right, trajectory.time, speed)
    return Path(path)


def default_title(scene: Scene) -> str:
    """The scene's name, its speed or speeds, how many spheres it has, and their diameter or its ends."""
    speeds = " → ".join(f"{speed:g}" for speed in dict.fromkeys(scene.rotation.speeds_rpm))
    ends = dict.fromkeys((scene.filling.smallest_radius, scene.filling.largest_radius))
    sizes = "–".join(f"{2e3 * radius:.3g}" for radius in ends)
    return f"{scene.name}, {speeds} rpm, {scene.filling.count} spheres of {sizes} mm"


def _instants(scene: Scene) -> list[float]:
    """An early state, that of the paper's figure, and the last; evenly spread where the scene ends before."""
    if scene.end_time > PATTERN_TIME + 0.5:
        return [scene.start_time + 0.35, PATTERN_TIME, scene.end_time]
    span = scene.end_time - scene.start_time
    steps = [round(share * span / scene.frame_interval) for share in (1 / 3, 2 / 3, 1.0)]
    return [scene.start_time + step * scene.frame_interval for step in steps]


def _draw_angles(axes: Axes, trajectory: Trajectory, scene: Scene) -> None:
    axes.set(title="Angle of repose", xlabel="time, s", ylabel="angle, °")
    axes.set_xlim(trajectory.time[0], trajectory.time[-1])
    found = ((surface_angle, "surface", SURROGATE), (com_angle, "centre of mass", BASELINE))
    for measure, label, colour in found:
        series = measure(trajectory, scene)
        if series.undefined_because:
            say(axes, f"undefined:\n{series.undefined_because}")
            return
        axes.plot(series.time, np.where(series.valid, series.value, np.nan), color=colour, label=label)
    axes.legend(loc="upper right")


def _draw_speeds(axes: Axes, time: FloatArray, speed: FloatArray) -> None:
    axes.set_title("Speeds of the spheres")
    if not speed.shape[1]:
        say(axes, "no spheres")
        return
    finite = np.where(np.isfinite(speed).all(axis=1)[:, None], speed, np.nan)
    for low, high, colour, label in SHARES:
        band = np.percentile(finite, (low, high), axis=1)
        axes.fill_between(time, *band, color=colour, linewidth=0, label=f"{label} of the spheres")
    axes.plot(time, np.median(finite, axis=1), color=BASELINE, label="median")
    axes.plot(time, finite.mean(axis=1), color=DEM, linewidth=1.1, linestyle=(0, (5, 2)), label="mean")
    axes.set(xlabel="time, s", ylabel="speed, m/s", xlim=(time[0], time[-1]))
    axes.set_ylim(bottom=0.0)
    axes.tick_params(color=QUIET)
    axes.legend(loc="upper right", ncols=2)
