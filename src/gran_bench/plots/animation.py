"""A GIF of several flows side by side, coloured by speed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import font_manager
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from gran_bench.files import whole_file
from gran_bench.metrics.speeds import velocities
from gran_bench.plots.flow_pattern import fastest, view_half_width
from gran_bench.plots.spheres import draw_spheres, view_along_axis
from gran_bench.plots.style import SPEED_MAP, run_drawn_for
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, Trajectory

PIXELS = 300  # edge of one panel
HEADER = 26  # pixels, names and time
FOOTER = 34  # pixels, scale of speed
FRAMES_A_SECOND = 20.0  # of the film, which runs in the time of the flow
LIGHTS = np.array([0.62, 0.84, 1.0])  # from a sphere's rim to its middle
LEVELS = 40  # of speed
LARGEST_FILE = 5_000_000  # bytes; a larger film is made again with fewer frames

# Palette: white, black, grey, the drum's wall, then every level of speed in every light.
WHITE, BLACK, GREY, WALL, FIRST = 0, 1, 2, 3, 4


def flow_animation(runs: Mapping[str, Trajectory], scene: Scene, path: Path | str) -> Path:
    """Draw the runs side by side into a GIF of less than 5 MB, on one scale of speed and in real time.

    Args:
        runs: by the name that stands over the panel; of one scene and one frame interval.
        scene: that all were made for.
        path: of the GIF.

    Returns:
        The path.
    """
    kinds = {run.velocity_kind for run in runs.values()}
    kind = kinds.pop() if len(kinds) == 1 else "mean"
    speeds = [np.linalg.norm(velocities(run, kind, scene.period), axis=2) for run in runs.values()]
    top = fastest(speeds)
    stride = max(1, round(1.0 / (FRAMES_A_SECOND * scene.frame_interval)))
    while True:
        films = _frames(list(runs.items()), speeds, scene, top, stride)
        with whole_file(path) as temporary:
            films[0].save(
                temporary,
                format="GIF",
                save_all=True,
                append_images=films[1:],
                duration=round(1e3 * stride * scene.frame_interval),
                loop=0,
                optimize=False,
                comment=f"gran-bench run {run_drawn_for()}" if run_drawn_for() else "",
                disposal=1,
            )
            size = temporary.stat().st_size
        if size <= LARGEST_FILE or len(films) < 10:
            return Path(path)
        stride = int(np.ceil(stride * 1.05 * size / LARGEST_FILE))


def _frames(
    runs: list[tuple[str, Trajectory]], speeds: list[FloatArray], scene: Scene, top: float, stride: int
) -> list[Image.Image]:
    """The film's pictures, paletted, so that nothing is dithered."""
    states = max(run.frame_count for _, run in runs)
    backdrop, font, small = _backdrop([name for name, _ in runs], top), _font(13), _font(11)
    films = []
    for frame in range(0, states, stride):
        canvas = backdrop.copy()
        draw = ImageDraw.Draw(canvas)
        time = scene.start_time + frame * scene.frame_interval
        draw.text((canvas.width - 8, 5), f"{time:.2f} s", fill=BLACK, font=font, anchor="ra")
        for panel, (_, run) in enumerate(runs):
            corner = (panel * PIXELS, HEADER)
            if frame < run.frame_count and np.isfinite(run.position[frame]).any():
                bed, unseen = _panel(run.position[frame], speeds[panel][frame], run, scene, top)
                canvas.paste(Image.fromarray(bed), corner)
                if unseen:
                    # In the corner, which the drum leaves free.
                    place, note = (corner[0] + 3, corner[1] + PIXELS - 29), f"{unseen} not\nin sight"
                    draw.multiline_text(place, note, BLACK, small, spacing=2, stroke_width=2, stroke_fill=WHITE)
            else:
                middle = (corner[0] + PIXELS // 2, corner[1] + PIXELS // 2)
                draw.text(middle, "not finite" if frame < run.frame_count else "ended", BLACK, font, anchor="mm")
            _draw_wall(draw, corner, scene, run)
        canvas.putpalette(_palette())
        films.append(canvas)
    return films


def _panel(
    position: FloatArray, speed: FloatArray, run: Trajectory, scene: Scene, top: float
) -> tuple[NDArray[np.uint8], int]:
    """Palette index of each pixel of one bed, ``(PIXELS, PIXELS)``, and how many spheres it cannot show."""
    across, away = view_along_axis(position.astype(np.float64), scene)
    image = draw_spheres(across, away, run.radius.astype(np.float64), view_half_width(run.position[0], scene), PIXELS)
    level = np.clip(np.nan_to_num(speed, posinf=top) / top * LEVELS, 0, LEVELS - 1).astype(np.int64)
    light = np.digitize(image.facing, (0.45, 0.8))
    index = FIRST + len(LIGHTS) * level[np.maximum(image.owner, 0)] + light
    return np.where(image.owner >= 0, index, WHITE).astype(np.uint8), image.unseen


def _palette() -> list[int]:
    colours = matplotlib.colormaps[SPEED_MAP]((np.arange(LEVELS) + 0.5) / LEVELS)[:, None, :3] * LIGHTS[:, None]
    fixed = [(255, 255, 255), (0, 0, 0), (140, 140, 140), (60, 60, 60)]
    return [*np.array(fixed).ravel().tolist(), *np.round(255 * colours).astype(int).ravel().tolist()]


def _backdrop(names: list[str], top: float) -> Image.Image:
    """What stays the same in every picture: names and the scale of speed."""
    width = PIXELS * len(names)
    canvas = Image.new("P", (width, HEADER + PIXELS + FOOTER), WHITE)
    draw = ImageDraw.Draw(canvas)
    for panel, name in enumerate(names):
        draw.text((panel * PIXELS + 8, 5), name, fill=BLACK, font=_font(13))
    left, upper, lower = width // 2 - 110, HEADER + PIXELS + 6, HEADER + PIXELS + 16
    for level in range(LEVELS):
        start, end = (left + round(220 * k / LEVELS) for k in (level, level + 1))
        draw.rectangle((start, upper, end - 1, lower), fill=FIRST + len(LIGHTS) * level + len(LIGHTS) - 1)
    for share in (0.0, 0.5, 1.0):
        draw.text((left + 220 * share, lower + 3), f"{share * top:.2g}", fill=BLACK, font=_font(11), anchor="ma")
    draw.text((left + 240, upper - 1), "speed, m/s", fill=BLACK, font=_font(11))
    return canvas


def _draw_wall(draw: ImageDraw.ImageDraw, corner: tuple[int, int], scene: Scene, run: Trajectory) -> None:
    if scene.drum_radius is None:
        return
    radius = scene.drum_radius / view_half_width(run.position[0], scene) * PIXELS / 2
    x, y = corner[0] + PIXELS / 2, corner[1] + PIXELS / 2
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), outline=WALL, width=2)


def _font(size: int) -> ImageFont.FreeTypeFont:
    """The figures' own font, which matplotlib brings along."""
    return ImageFont.truetype(font_manager.findfont("DejaVu Sans"), size)
