"""How deep spheres lie in each other and in the walls."""

from __future__ import annotations

import numpy as np

from gran_bench.config.rules import check_arguments
from gran_bench.metrics.measured import Series
from gran_bench.neighbors import nearest_image, tree_pairs
from gran_bench.scene import Plane, Scene, Wall
from gran_bench.state import FloatArray, Trajectory

OVERLAP_SERIES = ("overlap_mean", "overlap_max", "wall_overlap_mean", "wall_overlap_max")


def pair_overlaps(position: FloatArray, radius: FloatArray, period: float = 0.0) -> FloatArray:
    """Overlap r_i + r_j − ‖x_j − x_i‖ of every touching pair, ``(M,)`` m, positive.

    Args:
        position: ``(N, 3)`` m, finite.
        radius: ``(N,)`` m.
        period: length of the periodic axis y, m.
    """
    pairs = tree_pairs(position, 2.0 * float(radius.max()), period)
    offset = nearest_image(position[pairs[:, 1]] - position[pairs[:, 0]], period)
    overlap = radius[pairs].sum(axis=1) - np.sqrt((offset**2).sum(axis=1))
    return overlap[overlap > 0]


def wall_overlap(position: FloatArray, radius: FloatArray, wall: Wall) -> FloatArray:
    """How far each sphere reaches into a wall, ``(..., N)`` m; negative is a gap.

    The overlap is also how far the sphere's centre lies beyond the last place it can have in the container.

    Args:
        position: ``(..., N, 3)`` m.
        radius: ``(N,)`` m.
        wall: a plane, or the inside of a cylinder.
    """
    offset = position - np.asarray(wall.point)
    if isinstance(wall, Plane):
        return radius - offset @ np.asarray(wall.normal)
    axis = np.asarray(wall.axis)
    across = offset - (offset @ axis)[..., None] * axis
    return radius - (wall.radius - np.sqrt((across**2).sum(axis=-1)))


def overlap_series(trajectory: Trajectory, scene: Scene) -> dict[str, Series]:
    """Mean over the touching contacts, and largest, of pairs and walls, in every state, m.

    The engine's own figures are taken where the trajectory carries them, because they were computed in float64;
    otherwise they come from the positions. A state without a contact has the mean and largest overlap 0.

    Args:
        trajectory: F states.
        scene: its walls (those that contain, where positions are all there is) and its period.
    """
    check_arguments(trajectory=(trajectory, Trajectory), scene=(scene, Scene))
    if all(name in trajectory.diagnostics for name in OVERLAP_SERIES):
        values = [np.asarray(trajectory.diagnostics[name], np.float64) for name in OVERLAP_SERIES]
    else:
        radius = trajectory.radius.astype(np.float64)
        values = np.array([_figures(frame.astype(np.float64), radius, scene) for frame in trajectory.position]).T
    return {
        name: Series(trajectory.time, value, "m", invalid_because="position is not finite")
        for name, value in zip(OVERLAP_SERIES, values, strict=True)
    }


def _figures(position: FloatArray, radius: FloatArray, scene: Scene) -> tuple[float, float, float, float]:
    if not np.isfinite(position).all():
        return (np.nan,) * 4
    pairs = pair_overlaps(position, radius, scene.period)
    walls = [wall_overlap(position, radius, wall) for wall in scene.walls if wall.contains]
    touching = np.concatenate([overlap[overlap > 0] for overlap in walls]) if walls else np.zeros(0)
    return (*_mean_and_max(pairs), *_mean_and_max(touching))


def _mean_and_max(overlap: FloatArray) -> tuple[float, float]:
    return (float(overlap.mean()), float(overlap.max())) if len(overlap) else (0.0, 0.0)
