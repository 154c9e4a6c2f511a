"""Analytic walls: distances, normals and surface velocities, and the table that jitted code reads."""

from __future__ import annotations

import numpy as np

from gran_bench.scene import Cylinder, Plane, Rotation, Wall
from gran_bench.state import FloatArray

PLANE, CYLINDER = 0.0, 1.0


def wall_table(walls: tuple[Wall, ...]) -> FloatArray:
    """The walls as rows (kind, point, direction, radius, turns), ``(W, 9)``; direction is the normal or the axis."""
    table = np.zeros((len(walls), 9))
    for row, wall in zip(table, walls, strict=True):
        if isinstance(wall, Plane):
            row[:] = (PLANE, *wall.point, *wall.normal, 0.0, wall.turns)
        else:
            row[:] = (CYLINDER, *wall.point, *wall.axis, wall.radius, wall.turns)
    return table


def wall_contact(wall: Wall, position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Closest point of a wall: distance of each centre, and the unit vector from it to the wall.

    Args:
        wall: a plane, or the inside of a cylinder.
        position: ``(N, 3)`` m.

    Returns:
        ``(N,)`` m, negative beyond the wall, and ``(N, 3)``. On a cylinder's axis, where every direction is as
        close, the vector is zero: there is no contact to speak of.
    """
    offset = position - np.asarray(wall.point)
    if isinstance(wall, Plane):
        normal = np.asarray(wall.normal)
        return offset @ normal, np.broadcast_to(-normal, position.shape)
    axis = np.asarray(wall.axis)
    radial = offset - np.outer(offset @ axis, axis)
    reach = np.linalg.norm(radial, axis=1)
    outward = np.divide(radial, reach[:, None], out=np.zeros_like(radial), where=reach[:, None] > 0)
    return wall.radius - reach, outward


def largest_excess(walls: tuple[Wall, ...], position: FloatArray) -> FloatArray:
    """How far each centre lies beyond the wall that it passed furthest, ``(N,)`` m; negative inside."""
    excess = np.full(len(position), -np.inf)
    for wall in walls:
        np.maximum(excess, -wall_contact(wall, position)[0], out=excess)
    return excess


def surface_velocity(axis: FloatArray, angular_speed: float, point: FloatArray) -> FloatArray:
    """Velocity of a turning wall's material points, ω axis × x, ``(N, 3)`` m/s.

    Args:
        axis: ``(3,)`` unit vector; the axis runs through the origin.
        angular_speed: ω, rad/s.
        point: ``(N, 3)`` on the wall, m.
    """
    return np.cross(angular_speed * axis, point)


def check_walls(walls: tuple[Wall, ...], rotation: Rotation) -> None:
    """Refuses a turning wall whose shape would not turn into itself.

    Raises:
        ValueError: a turning plane or cylinder that is not symmetric about the axis of rotation.
    """
    axis = np.asarray(rotation.axis)
    for index, wall in enumerate(walls):
        if not wall.turns or rotation.is_still:
            continue
        direction = np.asarray(wall.normal if isinstance(wall, Plane) else wall.axis)
        tilted = np.linalg.norm(np.cross(axis, direction)) > 1e-9
        shifted = isinstance(wall, Cylinder) and np.linalg.norm(np.cross(wall.point, axis)) > 1e-9
        if tilted or shifted:
            raise ValueError(
                f"wall {index} turns about {rotation.axis} but is not symmetric about that axis through the origin; "
                "set its turns=False or align it"
            )
