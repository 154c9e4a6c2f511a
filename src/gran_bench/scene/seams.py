"""Which walls are pieces of one surface: where they meet, a sphere has one contact and not two."""

from __future__ import annotations

import numpy as np

from gran_bench.scene.motion import Motion, Rotation
from gran_bench.scene.walls import Plane, Wall, turns_into_itself
from gran_bench.state import FloatArray

# Sphere radii within which two points of walls are one. The contact patch has a radius of √(δ/r) sphere radii: at an
# overlap of a millionth of the radius it is as wide.
SAME_POINT = 1e-3
RIM_POINTS = 256


def surfaces(
    walls: tuple[Wall, ...], motions: tuple[Rotation | Motion | None, ...], tolerance: float
) -> tuple[int, ...]:
    """Number of the surface that each wall is a piece of, from 1; 0 for a wall that meets no other.

    Two walls meet where a rim of one comes within ``tolerance``, m, of the other, and where two walls without an end
    are the same. Of walls that travel relative to each other nobody knows in advance: they may meet.
    """
    number = list(range(len(walls)))
    moving = [travels(wall, motion) for wall, motion in zip(walls, motions, strict=True)]
    for a, one in enumerate(walls):
        for b in range(a):
            together = motions[a] == motions[b] or not (moving[a] or moving[b])
            if number[a] != number[b] and _meet(one, walls[b], tolerance, together):
                number = [number[b] if n == number[a] else n for n in number]
    shared = [n for n in dict.fromkeys(number) if number.count(n) > 1]
    return tuple(shared.index(n) + 1 if n in shared else 0 for n in number)


def travels(wall: Wall, motion: Rotation | Motion | None) -> bool:
    """Whether a wall's shape goes elsewhere, and not only its surface along it."""
    turning = isinstance(motion, Rotation) and turns_into_itself(wall, motion.axis, motion.point)
    return motion is not None and not turning


def _meet(one: Wall, other: Wall, tolerance: float, together: bool) -> bool:
    """Whether two walls share an edge, or may come to share one."""
    if one.contains and other.contains:
        if type(one) is not type(other) or not np.allclose(np.cross(one.direction, other.direction), 0.0):
            return False
        if isinstance(one, Plane):
            facing = np.dot(one.normal, other.normal) > 0.0
            return facing and (not together or _distance(other, np.array([one.point]))[0] <= tolerance)
        apart = np.cross(np.subtract(one.point, other.point), other.axis)
        return abs(one.radius - other.radius) <= tolerance and (not together or np.linalg.norm(apart) <= tolerance)
    return not together or any(
        _distance(second, points).min() <= tolerance + gap
        for first, second in ((one, other), (other, one))
        for points, gap in _rims(first)
    )


def _rims(wall: Wall) -> list[tuple[FloatArray, float]]:
    """Points of each rim, ``(256, 3)`` m, and half the arc from one to the next."""
    axis, angle = np.asarray(wall.direction), 2.0 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    around = np.outer(np.cos(angle), across) + np.outer(np.sin(angle), np.cross(axis, across))
    return [(wall.point + rho * around + s * axis, np.pi * rho / RIM_POINTS) for rho, s in wall.meridian or ()]


def _distance(wall: Wall, points: FloatArray) -> FloatArray:
    """Of points from a wall where it is drawn, ``(P,)`` m."""
    offset, direction = points - wall.point, np.asarray(wall.direction)
    along = offset @ direction
    if isinstance(wall, Plane):
        return np.abs(along)
    reach = np.linalg.norm(offset - np.outer(along, direction), axis=1)
    if wall.meridian is None:
        return np.abs(reach - wall.radius)
    (r0, s0), (r1, s1) = wall.meridian
    dr, ds = r1 - r0, s1 - s0
    share = np.clip(((reach - r0) * dr + (along - s0) * ds) / (dr * dr + ds * ds), 0.0, 1.0)
    return np.hypot(r0 + share * dr - reach, s0 + share * ds - along)
