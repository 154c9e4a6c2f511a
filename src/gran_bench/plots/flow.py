"""Flows seen along the drum's axis, coloured by speed: the pattern of one instant (paper, Fig. 2), and a film."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Circle
from PIL import Image

from gran_bench.files import whole_file
from gran_bench.metrics.angle_of_repose import cross_section_axes
from gran_bench.metrics.measured import frame_at
from gran_bench.metrics.speeds import velocities
from gran_bench.plots.style import LOOK, QUIET, SPEED_MAP, drawing, heading, run_name, say, speed_label
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, Trajectory

MARGIN = 1.06  # of the drum's radius, half the picture's width
FRAMES_A_SECOND = 20.0  # of the film, which runs in the time of the flow
LARGEST_FILE = 5_000_000  # bytes; a larger film is made again with fewer frames


def default_title(scene: Scene) -> str:
    """Name of the scene, speed or speeds of a drum, how many spheres there are, and their diameter or its ends."""
    speeds = " → ".join(f"{speed:g}" for speed in dict.fromkeys(scene.rotation.speeds_rpm))
    ends = dict.fromkeys((scene.filling.smallest_radius, scene.filling.largest_radius))
    sizes = "–".join(f"{2e3 * radius:.3g}" for radius in ends)
    turning = "" if scene.drum_radius is None else f", {speeds} rpm"
    return f"{scene.name}{turning}, {scene.filling.count} spheres of {sizes} mm"


def flow_pattern(runs: Mapping[str, Trajectory], scene: Scene, path: Path | str, time: float) -> Path:
    """Draw the flow patterns of several runs of a scene, by their names, side by side at ``time`` (s).

    Where there is no drum, all show the room that the first run takes up in all its states. There is one scale of
    speed: of the definition of the runs' own velocities, or of means where they differ.
    """
    kind, speeds = _speeds(runs, scene)
    states = {name: frame_at(run.time, time) for name, run in runs.items()}
    speeds = {name: speed[states[name]] for name, speed in speeds.items() if states[name] is not None}
    norm = Normalize(0.0, fastest(list(speeds.values())))
    view = pattern_view(next(iter(runs.values())).position, scene)
    with drawing(path, 4.1 * len(runs) + 0.9, 4.35) as figure:
        panels = figure.subplots(1, len(runs), squeeze=False, sharey=True)[0]
        for axes, (name, run) in zip(panels, runs.items(), strict=True):
            axes.set_title(name)
            if states[name] is None:
                say(axes, f"no state at {time:g} s")
                continue
            draw_pattern(axes, run.position[states[name]], speeds[name], run.radius, scene, norm, view)
        finish_patterns(figure, panels, norm, speed_label(kind), shrink=0.82)
        figure.suptitle(f"flow at {time:g} s, seen along the axis")
    return Path(path)


def _speeds(runs: Mapping[str, Trajectory], scene: Scene) -> tuple[str, dict[str, FloatArray]]:
    """Definition of velocity that all runs have, and the speeds of their spheres, ``(F, N)`` m/s."""
    kinds = {run.velocity_kind for run in runs.values()}
    kind = kinds.pop() if len(kinds) == 1 else "mean"
    return kind, {name: np.linalg.norm(velocities(run, kind, scene.period), axis=2) for name, run in runs.items()}


def finish_patterns(
    figure: Figure | SubFigure, panels: Sequence[Axes], norm: Normalize, label: str, shrink: float
) -> None:
    """The height beside the first panel, and the scale of speed beside the last."""
    panels[0].set_ylabel("height z, m")
    for axes in panels[1:]:
        axes.tick_params(left=False)
    bar = ScalarMappable(norm, SPEED_MAP)
    figure.colorbar(bar, ax=panels, label=label, shrink=shrink, pad=0.015, aspect=28, extend="max")


def draw_pattern(
    axes: Axes, position: FloatArray, speed: FloatArray, radius: FloatArray, scene: Scene, norm: Normalize,
    view: tuple[FloatArray, FloatArray] | None = None,
) -> None:  # fmt: skip
    """Draw one bed into a panel: spheres to scale, the drum's circle, and how many spheres cannot be shown.

    ``view`` is of :func:`pattern_view`; None: of this bed alone.
    """
    low, high = pattern_view(position, scene) if view is None else view
    across, away = view_along_axis(position.astype(np.float64), scene)
    inside = ((across > low - radius[:, None]) & (across < high + radius[:, None])).all(axis=1)
    seen = np.flatnonzero(inside & np.isfinite(away))
    seen = seen[np.argsort(-away[seen], kind="stable")]  # the nearest last: it hides what lies behind it
    size = 2.0 * radius[seen]
    spheres = EllipseCollection(
        size, size, np.zeros(len(seen)), units="xy", offsets=across[seen], offset_transform=axes.transData, norm=norm,
        cmap=SPEED_MAP, edgecolors="#00000080", linewidths=0.4,
    )  # fmt: skip
    spheres.set_array(np.nan_to_num(speed[seen]))
    axes.add_collection(spheres)
    if scene.drum_radius is not None:
        axes.add_patch(Circle((0, 0), scene.drum_radius, fill=False, edgecolor="#444444", linewidth=1.6))
    if unseen := len(radius) - len(seen):
        words = f"{unseen} spheres not finite or out of sight"
        axes.text(0.5 * (low[0] + high[0]), 0.985 * high[1] + 0.015 * low[1], words, ha="center", va="top", fontsize=9)
    axes.set(aspect="equal", xlabel="x, m", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.grid(False)
    axes.spines[["left", "bottom"]].set_visible(False)
    axes.tick_params(length=2, color=QUIET)


def view_along_axis(position: FloatArray, scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Right and up, ``(N, 2)``, and the distance ``(N,)`` from a viewer in front of the drum's near cap, m.

    Up is against gravity, or along z where there is none. In the shipped scenes x points to the right and z up, so a
    bed climbs to the left where the drum turns forwards.
    """
    if not scene.needs.gravity:
        scene = replace(scene, gravity=(0.0, 0.0, -1.0))
    climbing, up = cross_section_axes(scene.at_rest())  # the picture does not flip with the rotation
    # The viewer looks along right-handed depth: up × right, which is +y where x points right and z up.
    return position @ np.stack((-climbing, up), axis=1), position @ np.cross(up, -climbing)


def pattern_view(position: FloatArray, scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Lower left and upper right corner, ``(2,)`` m, of a picture of the drum, or of all finite spheres without one.

    Positions are of one state or of several, ``(..., N, 3)`` m, so that several pictures have one scale.
    """
    if scene.drum_radius is not None:
        half = np.full(2, MARGIN * scene.drum_radius)
        return -half, half
    finite = position[np.isfinite(position).all(axis=-1)].reshape(-1, 3).astype(np.float64)
    across = view_along_axis(finite if len(finite) else np.zeros((1, 3)), scene)[0]
    margin = 2.0 * scene.filling.largest_radius
    return across.min(axis=0) - margin, across.max(axis=0) + margin


def fastest(speeds: list[FloatArray]) -> float:
    """Upper end of a scale of speed: the 99.5 % quantile of the finite speeds, in steps of 0.1 m/s, at least 0.1."""
    together = np.concatenate([speed.ravel() for speed in speeds]) if speeds else np.zeros(1)
    together = together[np.isfinite(together)]
    return max(0.1, 0.1 * float(np.ceil(10.0 * np.quantile(together, 0.995)))) if len(together) else 1.0


def flow_animation(runs: Mapping[str, Trajectory], scene: Scene, path: Path | str) -> Path:
    """Draw runs of a scene, by their names, side by side into a GIF of less than 5 MB, in real time."""
    comment = f"gran-bench run {run_name.get()}" if run_name.get() else ""
    stride = max(1, round(1.0 / (FRAMES_A_SECOND * scene.frame_interval)))
    while True:
        first, *rest = _frames(runs, scene, stride)
        duration = round(1e3 * stride * scene.frame_interval)
        with whole_file(path) as temporary:
            first.save(temporary, "GIF", save_all=True, append_images=rest, duration=duration, loop=0, optimize=False,
                       comment=comment, disposal=1)  # fmt: skip
            size = temporary.stat().st_size
        if size <= LARGEST_FILE or len(rest) < 9:
            return Path(path)
        stride = int(np.ceil(stride * 1.05 * size / LARGEST_FILE))


def _frames(runs: Mapping[str, Trajectory], scene: Scene, stride: int) -> Iterator[Image.Image]:
    """The film's pictures, in one palette, so that nothing is dithered."""
    kind, speeds = _speeds(runs, scene)
    norm, ends = Normalize(0.0, fastest(list(speeds.values()))), max(run.frame_count for run in runs.values())
    colours = np.vstack([matplotlib.colormaps[SPEED_MAP](np.linspace(0, 1, 160)), np.linspace([0] * 4, [1] * 4, 32)])
    palette, view = Image.new("P", (1, 1)), pattern_view(next(iter(runs.values())).position, scene)
    palette.putpalette(np.round(255 * np.vstack([colours, colours[:64] * 0.5])[:, :3]).astype(int).ravel().tolist())
    with matplotlib.rc_context(LOOK):
        figure = Figure(figsize=(3.0 * len(runs), 3.9), dpi=100)
        canvas, place = FigureCanvasAgg(figure), {"left": 0.01, "right": 0.99, "bottom": 0.15, "top": 0.87}
        panels = figure.subplots(1, len(runs), squeeze=False, gridspec_kw=place | {"wspace": 0.02})[0]
        scale = figure.add_axes((0.25, 0.13, 0.5, 0.02))
        figure.colorbar(ScalarMappable(norm, SPEED_MAP), cax=scale, orientation="horizontal", label=speed_label(kind))
        words = heading.get() or default_title(scene)
        figure.text(0.01, 0.95, words, fontsize=min(10.0, 375.0 * len(runs) / len(words)))
        clock = figure.text(0.99, 0.89, "", ha="right")
        for frame in range(0, ends, stride):
            clock.set_text(f"{scene.start_time + frame * scene.frame_interval:.2f} s")
            for axes, (name, run) in zip(panels, runs.items(), strict=True):
                axes.clear()
                if frame < run.frame_count and np.isfinite(run.position[frame]).any():
                    draw_pattern(axes, run.position[frame], speeds[name][frame], run.radius, scene, norm, view)
                else:
                    say(axes, "not finite" if frame < run.frame_count else "ended")
                axes.set_title(name)
                axes.set_axis_off()
            canvas.draw()
            picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
            yield picture.quantize(palette=palette, dither=Image.Dither.NONE)
