"""Walls as triangles, where they are at each instant and how fast their points move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation as Turn

from gran_bench.dem.walls import ABSENT, KIND, any_normal_to, surface_velocity, wall_poses
from gran_bench.scene import Plane, Rotation, Scene, Wall
from gran_bench.state import FloatArray

AROUND = 72  # points on a circle

Tell = Callable[[str], None]


def silent(line: str) -> None:
    """Tell nobody."""


@dataclass(frozen=True)
class WallMesh:
    """The surface of all walls.

    Attributes:
        scene: whose walls they are, and how they move.
        point: ``(M, 3)`` m, where the walls are drawn.
        wall: ``(M,)`` index of the wall that a point belongs to.
        triangle: ``(T, 3)`` indices of points.
    """

    scene: Scene
    point: FloatArray
    wall: np.ndarray
    triangle: np.ndarray

    def at(self, time: float) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """Where the points are at a time, how fast they move, and which triangles are there.

        Returns:
            ``(M, 3)`` m, ``(M, 3)`` m/s, and ``(T,)`` bool: false for those of a wall that has opened.
        """
        place, velocity = self.point.copy(), np.zeros_like(self.point)
        there = np.ones(len(self.scene.walls), bool)
        if self.scene.walls:
            poses = wall_poses(self.scene, time, 1.0, 0)[0]
            there = poses[:, KIND] != ABSENT
        for index, wall in enumerate(self.scene.walls):
            mine, motion = self.wall == index, self.scene.motion_of(wall)
            if isinstance(motion, Rotation):
                angle = float(motion.angles(np.array([time]))[0])
                turn, axis = Turn.from_rotvec(angle * np.array(motion.axis)), np.array(motion.point)
                place[mine] = turn.apply(place[mine] - axis) + axis
            elif motion is not None:
                place[mine] += motion.displacement(np.array([time]))[0]
            velocity[mine] = surface_velocity(poses[index], place[mine])
        return place, velocity, there[self.wall[self.triangle[:, 0]]]


def wall_mesh(scene: Scene, lower: FloatArray, upper: FloatArray, tell: Tell = silent) -> WallMesh:
    """Triangulate the walls of a scene.

    Args:
        scene: with its walls.
        lower, upper: ``(3,)`` m; a wall without an end is drawn as far as this box.
        tell: gets a line for each wall that cannot be drawn.
    """
    points, walls, triangles = [np.zeros((0, 3))], [np.zeros(0, np.int64)], [np.zeros((0, 3), np.int64)]
    for index, wall in enumerate(scene.walls):
        drawn = _surface(wall, scene, lower, upper)
        if drawn is None:
            tell(f"wall {index} is a {type(wall).__name__}, which is not drawn")
            continue
        triangles.append(drawn[1] + sum(map(len, points)))
        points.append(drawn[0])
        walls.append(np.full(len(drawn[0]), index))
    return WallMesh(scene, np.concatenate(points), np.concatenate(walls), np.concatenate(triangles))


def _surface(wall: Wall, scene: Scene, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, np.ndarray] | None:
    corner = np.array(np.meshgrid(*zip(lower, upper, strict=True))).reshape(3, -1).T
    if isinstance(wall, Plane):
        if scene.drum_radius is not None:
            return _revolved(wall.point, wall.normal, (0.0, 0.0), (scene.drum_radius, 0.0))
        return _rectangle(np.array(wall.point), np.array(wall.normal), corner)
    if not hasattr(wall, "meridian"):
        return None
    if wall.meridian is not None:
        return _revolved(wall.point, wall.axis, *wall.meridian)
    along = (corner - np.array(wall.point)) @ np.array(wall.axis)
    return _revolved(wall.point, wall.axis, (wall.radius, along.min()), (wall.radius, along.max()))


def _rectangle(point: FloatArray, normal: FloatArray, corner: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """The part of a plane that lies before a box."""
    first = any_normal_to(normal)
    second = np.cross(normal, first)
    a, b = (corner - point) @ first, (corner - point) @ second
    ends = [(a.min(), b.min()), (a.max(), b.min()), (a.max(), b.max()), (a.min(), b.max())]
    return np.array([point + s * first + t * second for s, t in ends]), np.array([[0, 1, 2], [0, 2, 3]])


def _revolved(point, axis, start: tuple[float, float], end: tuple[float, float]) -> tuple[FloatArray, np.ndarray]:
    """The surface that a segment from (ρ₀, s₀) to (ρ₁, s₁) sweeps about an axis."""
    axis = np.array(axis, float)
    first = any_normal_to(axis)
    second, angle = np.cross(axis, first), 2.0 * np.pi * np.arange(AROUND) / AROUND
    out = np.outer(np.cos(angle), first) + np.outer(np.sin(angle), second)
    rings = [np.array(point) + rho * out + s * axis for rho, s in (start, end)]
    here, following = np.arange(AROUND), np.roll(np.arange(AROUND), -1)
    sides = []
    if start[0] > 0:
        sides.append(np.stack([here, following, here + AROUND], axis=1))
    if end[0] > 0:
        sides.append(np.stack([following, following + AROUND, here + AROUND], axis=1))
    return np.concatenate(rings), np.concatenate(sides)
