"""How deep spheres lie in each other and in the walls."""

from __future__ import annotations

import numpy as np

from gran_bench.config.registry import register_metric
from gran_bench.config.rules import check_arguments
from gran_bench.metrics.measured import Series
from gran_bench.neighbors import nearest_image, tree_pairs
from gran_bench.scene import Plane, Scene, Wall
from gran_bench.state import FloatArray, Trajectory

OVERLAPS = {
    "overlap_mean": "overlap of pairs, mean",
    "overlap_max": "overlap of pairs, largest",
    "wall_overlap_mean": "overlap with walls, mean",
    "wall_overlap_max": "overlap with walls, largest",
}


def pair_overlaps(position: FloatArray, radius: FloatArray, period: float = 0.0) -> FloatArray:
    """Overlap r_i + r_j − ‖x_j − x_i‖ > 0 of every touching pair of N spheres, ``(M,)`` m; ``period`` is that of y."""
    pairs = tree_pairs(position, 2.0 * float(radius.max()), period)
    offset = nearest_image(position[pairs[:, 1]] - position[pairs[:, 0]], period)
    overlap = radius[pairs].sum(axis=1) - np.sqrt((offset**2).sum(axis=1))
    return overlap[overlap > 0]


def wall_overlap(position: FloatArray, radius: FloatArray, wall: Wall) -> FloatArray:
    """How far spheres at ``(..., N, 3)`` m reach into a plane or out of a cylinder, ``(..., N)`` m; negative is a gap.

    The overlap is also how far a sphere's centre lies beyond the last place it can have in the container.
    """
    offset = position - np.asarray(wall.point)
    if isinstance(wall, Plane):
        return radius - offset @ np.asarray(wall.normal)
    axis = np.asarray(wall.axis)
    across = offset - (offset @ axis)[..., None] * axis
    return radius - (wall.radius - np.sqrt((across**2).sum(axis=-1)))


def overlap_series(trajectory: Trajectory, scene: Scene) -> dict[str, Series]:
    """Mean over the touching contacts, and largest, of pairs and walls, in every state, m; 0 without a contact.

    The engine's own figures are taken where the trajectory carries them, because they were computed in float64;
    otherwise they come from the positions and the walls that contain.
    """
    check_arguments(trajectory=(trajectory, Trajectory), scene=(scene, Scene))
    if all(name in trajectory.diagnostics for name in OVERLAPS):
        values = [np.asarray(trajectory.diagnostics[name], np.float64) for name in OVERLAPS]
    else:
        radius = trajectory.radius.astype(np.float64)
        values = np.array([_figures(frame.astype(np.float64), radius, scene) for frame in trajectory.position]).T
    return {
        name: Series(trajectory.time, value, "m", invalid_because="position is not finite")
        for name, value in zip(OVERLAPS, values, strict=True)
    }


def _register(name: str, label: str) -> None:
    def measure(trajectory: Trajectory, scene: Scene) -> Series:
        return overlap_series(trajectory, scene)[name]

    measure.__name__ = name
    register_metric(label, "m")(measure)


for _name, _label in OVERLAPS.items():
    _register(_name, _label)


def _figures(position: FloatArray, radius: FloatArray, scene: Scene) -> list[float]:
    if not np.isfinite(position).all():
        return [np.nan] * 4
    walls = [wall_overlap(position, radius, wall) for wall in scene.walls if wall.contains]
    touching = np.concatenate([overlap[overlap > 0] for overlap in walls]) if walls else np.zeros(0)
    found = (pair_overlaps(position, radius, scene.period), touching)
    return [figure for overlap in found for figure in ((overlap.mean(), overlap.max()) if len(overlap) else (0.0, 0.0))]
