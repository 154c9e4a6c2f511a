"""Walls as triangles, where they are at each instant and how fast their points move."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation as Turn

from gran_bench.dataset import Case
from gran_bench.dem.walls import ABSENT, KIND, surface_velocity, wall_poses
from gran_bench.scene import Plane, Rotation, Scene, Wall
from gran_bench.scene.walls import any_normal_to
from gran_bench.state import FloatArray

AROUND = 72  # points on a circle


@dataclass(frozen=True)
class WallMesh:
    """The surface of all walls."""

    scene: Scene  # whose walls they are, and how they move
    point: FloatArray  # (M, 3) m, where the walls are drawn
    wall: np.ndarray  # (M,) index of the wall that a point belongs to
    triangle: np.ndarray  # (T, 3) indices of points

    def at(self, time: float) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """Points, ``(M, 3)`` m, their velocities, m/s, and which triangles are there, ``(T,)``: not an open wall's."""
        place, velocity = self.point.copy(), np.zeros_like(self.point)
        poses = wall_poses(self.scene, time, 1.0, 0)[0]
        for index, wall in enumerate(self.scene.walls):
            mine, motion = self.wall == index, self.scene.motion_of(wall)
            if isinstance(motion, Rotation):
                angle = float(motion.angles(np.array([time]))[0])
                turn, axis = Turn.from_rotvec(angle * np.array(motion.axis)), np.array(motion.point)
                place[mine] = turn.apply(place[mine] - axis) + axis
            elif motion is not None:
                place[mine] += motion.displacement(np.array([time]))[0]
            velocity[mine] = surface_velocity(poses[index], place[mine])
        return place, velocity, (poses[:, KIND] != ABSENT)[self.wall[self.triangle[:, 0]]]


def wall_mesh(case: Case) -> WallMesh:
    """The walls of a case as triangles; one without an end is drawn as far as the container."""
    corner, scene = np.array(np.meshgrid(*zip(*container(case), strict=True))).reshape(3, -1).T, case.scene
    points, walls, triangles = [np.zeros((0, 3))], [np.zeros(0, np.int64)], [np.zeros((0, 3), np.int64)]
    for index, wall in enumerate(scene.walls):
        point, triangle = _surface(wall, scene, corner)
        triangles.append(triangle + sum(map(len, points)))
        points.append(point)
        walls.append(np.full(len(point), index))
    return WallMesh(scene, np.concatenate(points), np.concatenate(walls), np.concatenate(triangles))


def container(case: Case) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corner of the container, ``(3,)`` m each; of the spheres where it has none."""
    scene, trajectory = case.scene, case.trajectory
    if scene.drum_radius is not None and scene.length is not None:
        reach = np.array([scene.drum_radius, 0.5 * scene.length, scene.drum_radius])
        return -reach, reach
    if scene.room is not None:
        return np.array(scene.room.lower, float), np.array(scene.room.upper, float)
    centre = trajectory.position.reshape(-1, 3).astype(np.float64)
    centre, edge = centre[np.isfinite(centre).all(axis=1)], float(trajectory.radius.max(initial=0.0))
    return centre.min(axis=0, initial=np.inf) - edge, centre.max(axis=0, initial=-np.inf) + edge


def _surface(wall: Wall, scene: Scene, corner: FloatArray) -> tuple[FloatArray, np.ndarray]:
    if isinstance(wall, Plane) and scene.drum_radius is not None:
        return _revolved(wall.point, wall.direction, (0.0, 0.0), (scene.drum_radius, 0.0))
    offset = corner - np.array(wall.point)
    if isinstance(wall, Plane):  # the part before the box
        first = any_normal_to(np.array(wall.normal))
        second = np.cross(wall.normal, first)
        a, b = offset @ first, offset @ second
        ends = [(a.min(), b.min()), (a.max(), b.min()), (a.max(), b.max()), (a.min(), b.max())]
        return np.array([wall.point + s * first + t * second for s, t in ends]), np.array([[0, 1, 2], [0, 2, 3]])
    along = offset @ np.array(wall.direction)
    return _revolved(
        wall.point, wall.direction, *(wall.meridian or ((wall.radius, along.min()), (wall.radius, along.max())))
    )


def _revolved(point, axis, start: tuple[float, float], end: tuple[float, float]) -> tuple[FloatArray, np.ndarray]:
    """The surface that a segment from (ρ₀, s₀) to (ρ₁, s₁) sweeps about an axis."""
    axis = np.array(axis, float)
    first = any_normal_to(axis)
    second, angle = np.cross(axis, first), 2.0 * np.pi * np.arange(AROUND) / AROUND
    out = np.outer(np.cos(angle), first) + np.outer(np.sin(angle), second)
    rings = [np.array(point) + rho * out + s * axis for rho, s in (start, end)]
    here, following = np.arange(AROUND), np.roll(np.arange(AROUND), -1)
    sides = [np.stack([here, following, here + AROUND], axis=1)] if start[0] > 0 else []
    if end[0] > 0:
        sides.append(np.stack([following, following + AROUND, here + AROUND], axis=1))
    return np.concatenate(rings), np.concatenate(sides)
