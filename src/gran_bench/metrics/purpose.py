"""What a scene without an angle is for: the discharge rate of a hopper, the packing fraction of a box."""

import math

import numpy as np

from gran_bench.config.registry import register_metric
from gran_bench.config.rules import check_arguments
from gran_bench.metrics.bed import center_height, sphere_masses
from gran_bench.metrics.measured import Series
from gran_bench.scene import Plane, Scene
from gran_bench.state import FloatArray, Trajectory

RATE_OVER = 2.5  # √(d/g), to each side of a state
FLOOR_LAYER = 1.0  # diameters above the floor that its order disturbs


@register_metric("discharge rate", "kg/s")
def discharge_rate(trajectory: Trajectory, scene: Scene) -> Series:
    """Mass that leaves through the outlet per time, (M(t + w) − M(t − w)) / 2w, kg/s, w = 2.5 √(d/g) in whole states.

    M is the mass of the spheres whose centres are beyond the outlet. At the ends the span is cut.
    """
    check_arguments(trajectory=(trajectory, Trajectory), scene=(scene, Scene))
    if scene.outlet is None or not scene.needs.gravity:
        nothing = np.full(trajectory.frame_count, math.nan)
        return Series(trajectory.time, nothing, "kg/s", undefined_because="the scene has no outlet")
    mass = sphere_masses(trajectory.radius, scene.material.density)
    offset = trajectory.position.astype(np.float64) - np.asarray(scene.outlet.point)
    along = offset @ np.asarray(scene.outlet.normal)
    gone = np.where(np.isfinite(along).all(axis=1), (along < 0.0) @ mass, math.nan)
    half, state = max(1, round(RATE_OVER * scene.fall_time / scene.frame_interval)), np.arange(len(gone))
    before, after = np.maximum(state - half, 0), np.minimum(state + half, len(gone) - 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        rate = (gone[after] - gone[before]) / ((after - before) * scene.frame_interval)
    return Series(trajectory.time, rate, "kg/s", invalid_because="position is not finite")


@register_metric("packing fraction", "-")
def packing_fraction(trajectory: Trajectory, scene: Scene) -> Series:
    """Volume of the spheres over the room between one diameter above a box's floor and the bed's centre of mass, −.

    Spheres that reach into this slab count with the exact volume of their part in it. That is the lower half of the
    bed, which the free surface does not disturb; the side walls are included.
    """
    check_arguments(trajectory=(trajectory, Trajectory), scene=(scene, Scene))
    value, box = np.full(trajectory.frame_count, math.nan), _box(scene)
    if box is None or not len(trajectory.radius):
        return Series(trajectory.time, value, "-", undefined_because="the scene has no box with spheres")
    floor, area = box
    lower, upper = floor + FLOOR_LAYER * scene.filling.diameter, center_height(trajectory, scene).value
    radius = trajectory.radius.astype(np.float64)
    for frame, (centers, top) in enumerate(zip(trajectory.position[..., 2].astype(np.float64), upper, strict=True)):
        if math.isfinite(top) and top > lower:
            volume = _below(top - centers + radius, radius) - _below(lower - centers + radius, radius)
            value[frame] = volume.sum() / (area * (top - lower))
    return Series(trajectory.time, value, "-", invalid_because="not finite, or a bed of less than two layers")


def _below(height: FloatArray, radius: FloatArray) -> FloatArray:
    """Volume of spheres under planes at heights over their lowest points, m³: π/3 h² (3 r − h)."""
    height = np.clip(height, 0.0, 2.0 * radius)
    return math.pi / 3.0 * height**2 * (3.0 * radius - height)


def _box(scene: Scene) -> tuple[float, float] | None:
    """Height of the floor (m) and cross-section (m²) of an upright box along x and y; None where there is no such."""
    ends: dict[tuple[int, int], float] = {}
    for wall in scene.walls:
        axis = int(np.argmax(np.abs(wall.normal))) if isinstance(wall, Plane) and wall.contains else None
        if axis is not None and abs(wall.normal[axis]) == 1.0:
            ends[axis, int(wall.normal[axis])] = wall.point[axis]
    sides = [(axis, sign) for axis in (0, 1) for sign in (1, -1)]
    if (2, 1) not in ends or not all(side in ends for side in sides) or not scene.needs.gravity:
        return None
    return ends[2, 1], math.prod(ends[axis, -1] - ends[axis, 1] for axis in (0, 1))
