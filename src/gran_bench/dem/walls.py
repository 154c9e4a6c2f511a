"""Analytic walls as the engines see them: the pose of each at each force evaluation, distances, surface velocities.

A row of a pose table is one wall at one instant, in SI and world coordinates:

    0        kind: PLANE, CYLINDER (the inside of an infinite one), REVOLUTION, or ABSENT
    1 … 3    a point of the plane or of the axis
    4 … 6    unit normal into the container, or unit vector along the axis
    7 … 10   radius of the cylinder; (ρ₀, s₀, ρ₁, s₁) of the segment that sweeps a surface of revolution
    11 … 13  v, velocity of the reference point
    14 … 16  ω, angular velocity
    17 … 19  c, reference point: the surface moves with v + ω × (x − c)
    20       path that its geometry travels in the step that ends here, m; 0 where only the surface moves
    21       number of the surface that it is a piece of; 0 for a wall that meets no other
"""

import numpy as np

from gran_bench.dem.vectors import cross, dot
from gran_bench.scene import Motion, Plane, Rotation, Scene, Wall
from gran_bench.scene.walls import any_normal_to, toward_segment, turns_into_itself
from gran_bench.state import FloatArray

PLANE, CYLINDER, REVOLUTION, ABSENT = 0.0, 1.0, 2.0, -1.0
KIND, POINT, DIRECTION, SIZES = 0, slice(1, 4), slice(4, 7), slice(7, 11)
VELOCITY, SPIN, REFERENCE, PATH = slice(11, 14), slice(14, 17), slice(17, 20), 20
SURFACE = 21
COLUMNS = 22


def wall_poses(scene: Scene, start: float, time_step: float, steps: int, first: int = 0) -> FloatArray:
    """Every wall at every force evaluation of a stretch, ``(steps + 1, W, 22)``.

    Row 0 is where the stretch starts, ``first`` steps after ``start``, s; row k has the shapes at the end of its step k
    and the velocities at that step's middle. Where nothing changes the rows are one row, broadcast.
    """
    table = np.array([_drawn(wall) for wall in scene.walls]).reshape(1, -1, COLUMNS)
    table[..., SURFACE] = scene.surfaces
    end = middle = None
    for index, wall in enumerate(scene.walls):
        motion = scene.motion_of(wall)
        if motion is None and wall.opens is None:
            continue
        if end is None:
            end = start + time_step * np.arange(first, first + steps + 1)
            middle = end - 0.5 * time_step
            middle[0] = end[0]
        rows = _moved(wall, table[0, index].copy(), motion, end, middle, time_step)
        if len(rows) > len(table):
            table = np.repeat(table, steps + 1, axis=0)
        table[:, index] = rows
    return np.broadcast_to(table, (steps + 1, *table.shape[1:]))


def _drawn(wall: Wall) -> FloatArray:
    """The row of a wall at rest, where it is drawn."""
    row = np.zeros(COLUMNS)
    row[POINT], row[DIRECTION] = wall.point, wall.direction
    if isinstance(wall, Plane):
        row[KIND] = PLANE
    elif wall.meridian is None:
        row[KIND], row[7] = CYLINDER, wall.radius
    else:
        row[KIND], row[SIZES] = REVOLUTION, np.ravel(wall.meridian)
    return row


def _moved(
    wall: Wall, drawn: FloatArray, motion: Motion | None, end: FloatArray, middle: FloatArray, time_step: float
) -> FloatArray:
    """Rows of one wall, ``(1, 22)`` where all are equal, else ``(steps + 1, 22)``."""
    rows = np.tile(drawn, (len(end), 1))
    if isinstance(motion, Rotation):
        axis, point = np.asarray(motion.axis), np.asarray(motion.point)
        rows[:, SPIN], rows[:, REFERENCE] = np.outer(motion.angular_speed(middle), axis), point
        if not turns_into_itself(wall, motion.axis, motion.point):
            angle, center = motion.angles(end), np.asarray(wall.point) - point
            rows[:, POINT] = point + _rotated(center, axis, angle)
            rows[:, DIRECTION] = _rotated(drawn[DIRECTION], axis, angle)
            # No point of the shape is farther from the axis than this, and nothing turns faster.
            reach = np.linalg.norm(np.cross(center, axis)) + max(np.hypot(r, s) for r, s in wall.meridian)
            rows[1:, PATH] = motion.largest_angular_speed * np.diff(end) * reach
        elif end[0] >= motion.times[-1]:
            rows = rows[:1]
    elif motion is not None:
        rows[:, POINT] += motion.displacement(end)
        rows[:, VELOCITY], velocity = motion.velocity(middle), motion.extreme_velocities
        if wall.contains:  # without an end: what moves along itself travels nothing
            along = np.outer(velocity @ np.asarray(wall.direction), wall.direction)
            velocity = along if isinstance(wall, Plane) else velocity - along
        rows[1:, PATH] = np.linalg.norm(velocity, axis=1).max() * time_step
    else:
        rows = rows[:1]
    if wall.opens is not None:
        # A clock that was added up may be a rounding error short of the opening.
        gone = end >= wall.opens - 1e-9 * max(time_step, abs(wall.opens))
        if gone.any():
            rows = np.array(np.broadcast_to(rows, (len(end), COLUMNS)))
            rows[gone, KIND] = ABSENT
    return rows


def _rotated(vector: FloatArray, axis: FloatArray, angle: FloatArray) -> FloatArray:
    """A vector turned about a unit axis by each angle, ``(T, 3)`` (Rodrigues' formula)."""
    along = (vector @ axis) * axis
    return along + np.outer(np.cos(angle), vector - along) + np.outer(np.sin(angle), np.cross(axis, vector))


def wall_contact(pose: FloatArray, position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Closest point of a wall: distance of each centre, and the unit vector from it to the wall.

    Of a ``(22,)`` row of the table and ``(N, 3)`` positions, m: ``(N,)`` m, negative beyond a plane or a cylinder and
    infinite for an absent wall; and ``(N, 3)``. On the axis of a cylinder without an end, and right on a surface that
    has two sides, no direction is closer than another: there the vector is zero, and no force acts.
    """
    kind, direction = pose[KIND], pose[DIRECTION]
    offset = position - pose[POINT]
    if kind == ABSENT:
        return np.full(len(position), np.inf), np.zeros_like(position)
    along = offset @ direction
    if kind == PLANE:
        return along, np.broadcast_to(-direction, position.shape)
    radial = offset - along[:, None] * direction
    reach = np.sqrt(dot(radial, radial))
    outward = np.divide(1.0, reach, out=np.zeros_like(reach), where=reach > 0)[:, None] * radial
    if kind == CYLINDER:
        return pose[7] - reach, outward
    across, up = toward_segment(pose[SIZES], reach, along)
    distance = np.hypot(across, up)
    outward[reach == 0.0] = any_normal_to(direction)
    vector = across[:, None] * outward + np.outer(up, direction)
    return distance, np.divide(vector, distance[:, None], out=np.zeros_like(vector), where=distance[:, None] > 0)


def surface_velocity(pose: FloatArray, point: FloatArray) -> FloatArray:
    """Velocity of walls' material at points of them, v + ω × (x − c), ``(N, 3)`` m/s; of a row for all, or for each."""
    arm = point - pose[..., REFERENCE]
    return pose[..., VELOCITY] + cross(np.broadcast_to(pose[..., SPIN], arm.shape), arm)


def largest_excess(scene: Scene, poses: FloatArray, position: FloatArray) -> FloatArray:
    """How far each centre lies beyond the wall with one side that it passed furthest, ``(N,)`` m; negative inside."""
    excess = np.full(len(position), -np.inf)
    for wall, pose in zip(scene.walls, poses, strict=True):
        if wall.contains:
            np.maximum(excess, -wall_contact(pose, position)[0], out=excess)
    return excess


def check_walls(scene: Scene) -> None:
    """Refuses a turning wall without an end whose shape would not turn into itself.

    Raises:
        ValueError: a turning plane or cylinder that is not symmetric about its axis of rotation.
    """
    for index, wall in enumerate(scene.walls):
        turn = scene.motion_of(wall)
        if isinstance(turn, Rotation) and wall.contains and not turns_into_itself(wall, turn.axis, turn.point):
            raise ValueError(
                f"wall {index} turns about {turn.axis} through {turn.point} m but is not symmetric about that axis, "
                "and it has no end; set its turns=False, align it, or give it an end (Disc, Cylinder with a length)"
            )
