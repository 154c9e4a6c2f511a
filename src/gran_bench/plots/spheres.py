"""Spheres to scale, seen along an axis, as pixels: the nearest hides what lies behind it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gran_bench.metrics.angle_of_repose import cross_section_axes
from gran_bench.scene import Scene
from gran_bench.state import FloatArray


@dataclass(frozen=True)
class SphereImage:
    """What each pixel shows; row 0 is the top.

    Attributes:
        owner: ``(H, W)`` index of the sphere, −1 for none.
        facing: ``(H, W)`` cosine between the sphere's normal and the viewer, 0 at its rim, 1 in its middle.
        unseen: spheres that cannot be drawn, because their position is not finite or lies outside the view.
    """

    owner: NDArray[np.int32]
    facing: NDArray[np.float32]
    unseen: int


def view_along_axis(position: FloatArray, scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Coordinates of a viewer in front of the drum's near cap, up against gravity, or along z where there is none.

    In the shipped scenes x points to the right and z up, so a bed climbs to the left where the drum turns forwards.

    Args:
        position: ``(N, 3)`` m.
        scene: gives axis and gravity.

    Returns:
        ``(N, 2)`` right and up, and ``(N,)`` distance away from the viewer, m.
    """
    if not scene.needs.gravity:
        scene = replace(scene, gravity=(0.0, 0.0, -1.0))
    climbing, up = cross_section_axes(scene.at_rest())  # the picture does not flip with the rotation
    plane = np.stack((-climbing, up), axis=1)
    # The viewer looks along right-handed depth: up × right, which is +y where x points right and z up.
    away = np.cross(up, -climbing)
    return position @ plane, position @ away


def draw_spheres(
    across: FloatArray, away: FloatArray, radius: FloatArray, half_width: float, pixels: int
) -> SphereImage:
    """Paint spheres from the farthest to the nearest.

    Args:
        across: ``(N, 2)`` right and up, m; the picture shows ±half_width of both.
        away: ``(N,)`` distance from the viewer, m.
        radius: ``(N,)`` m.
        half_width: m.
        pixels: H = W.
    """
    scale = pixels / (2.0 * half_width)
    finite = np.isfinite(across).all(axis=1) & np.isfinite(away)
    shown = np.flatnonzero(finite)
    shown = shown[(np.abs(across[shown]) < half_width + radius[shown, None]).all(axis=1)]
    order = shown[np.argsort(-away[shown], kind="stable")]
    owner = np.full((pixels, pixels), -1, np.int32)
    facing = np.zeros((pixels, pixels), np.float32)
    reach = int(np.ceil(scale * radius.max(initial=0.0))) + 1
    step = np.arange(-reach, reach + 1)
    # Pixel centres around each sphere's own middle; rows count downwards.
    column = (across[order, 0] + half_width) * scale
    row = (half_width - across[order, 1]) * scale
    columns = np.floor(column).astype(np.int64)[:, None] + step
    rows = np.floor(row).astype(np.int64)[:, None] + step
    off = ((columns + 0.5 - column[:, None])[:, None, :] ** 2 + (rows + 0.5 - row[:, None])[:, :, None] ** 2) / (
        scale * radius[order, None, None]
    ) ** 2
    seen = (off < 1.0) & ((columns >= 0) & (columns < pixels))[:, None, :] & ((rows >= 0) & (rows < pixels))[:, :, None]
    which, i, j = np.nonzero(seen)
    target = rows[which, i] * pixels + columns[which, j]
    # A later write to the same pixel wins, and the order is from far to near.
    owner.ravel()[target] = order[which]
    facing.ravel()[target] = np.sqrt(1.0 - off[seen])
    return SphereImage(owner, facing, len(radius) - len(shown))


def shaded(
    image: SphereImage, colour: FloatArray, background: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> FloatArray:
    """Colours of a picture, ``(H, W, 3)`` from 0 to 1: each sphere in its colour, darker towards its rim.

    Args:
        image: by `draw_spheres`.
        colour: ``(N, 3)`` of the spheres.
        background: where there is none.
    """
    if not len(colour):
        return np.broadcast_to(np.asarray(background, float), (*image.owner.shape, 3)).copy()
    light = 0.55 + 0.45 * image.facing[..., None]
    picture = colour[np.maximum(image.owner, 0)] * light
    return np.where(image.owner[..., None] >= 0, picture, np.asarray(background))


def halved(picture: FloatArray) -> FloatArray:
    """A picture of half the pixels, each the mean of four: smooth rims."""
    height, width = picture.shape[:2]
    return picture.reshape(height // 2, 2, width // 2, 2, -1).mean(axis=(1, 3))
