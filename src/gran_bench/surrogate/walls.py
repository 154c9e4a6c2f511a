"""The walls over one frame as surrogates see them: the DEM's own shapes, closest points and motions, differentiable.

The rules of a closest point are those of :func:`gran_bench.dem.walls.wall_contact`; ``closest_point`` is its form for
tensors, which a test holds to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gran_bench.dem import walls as dem_walls
from gran_bench.dem.walls import ABSENT, CYLINDER, DIRECTION, KIND, PLANE, POINT, SIZES
from gran_bench.scene import Motion, Rotation, Scene, Wall
from gran_bench.state import FloatArray

SHAPE = 11  # first columns of a pose: what a wall is, and where


@dataclass(frozen=True)
class FrameWalls:
    """The W walls of a scene over one frame; what is at c when it ends moved by ``turn`` c + ``shift`` in it."""

    before: FloatArray  # (W, 11) shapes at the frame's start, the first columns of a pose, m
    after: FloatArray  # (W, 11) at its end
    turn: FloatArray  # (W, 3, 3)
    shift: FloatArray  # (W, 3) m

    def in_unit(self, unit: float) -> FrameWalls:
        """The same with lengths in another unit, m."""
        before, after = self.before.copy(), self.after.copy()
        for shapes in (before, after):
            shapes[:, POINT] /= unit
            shapes[:, SIZES] /= unit
        return FrameWalls(before, after, self.turn, self.shift / unit)


def frame_walls(scene: Scene, time: float) -> FrameWalls:
    """The walls over the frame that starts at ``time``, s; their motion is exact."""
    before, after = dem_walls.wall_poses(scene, time, scene.frame_interval, 1)[..., :SHAPE]
    turn, shift = np.zeros((len(scene.walls), 3, 3)), np.zeros((len(scene.walls), 3))
    found: dict[Motion | Rotation | None, tuple[FloatArray, FloatArray]] = {}  # most walls move as one
    for index, motion in enumerate(map(scene.motion_of, scene.walls)):
        if motion not in found:
            found[motion] = _displacement(scene, motion, time)
        turn[index], shift[index] = found[motion]
    return FrameWalls(before, after, turn, shift)


def _displacement(scene: Scene, motion: Rotation | Motion | None, time: float) -> tuple[FloatArray, FloatArray]:
    """M and t with M c + t = how far the wall's material, now at c, moved in the frame that ends there.

    A rotation about an axis through p by θ = ∫ω dt has M = I − Q(−θ) and t = −M p.
    """
    end = time + scene.frame_interval
    if motion is None:
        return np.zeros((3, 3)), np.zeros(3)
    if not isinstance(motion, Rotation):
        start, stop = motion.displacement(np.array([time, end]))
        return np.zeros((3, 3)), stop - start
    theta = motion.angle(time, end)
    x, y, z = motion.axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn = math.sin(theta) * cross - (1.0 - math.cos(theta)) * cross @ cross
    return turn, -turn @ np.asarray(motion.point)


def wall_velocity(wall: Wall, point: Tensor, scene: Scene, time: float) -> Tensor:
    """Velocity of a wall's material at points of it, mean over the frame from ``time``, ``(S, 3)`` m/s.

    A rotation has ω̄ axis × (x − p), where ω̄ is the angle turned in the frame over its length, so that a change of
    speed inside a frame counts in full.
    """
    motion, interval = scene.motion_of(wall), scene.frame_interval
    if motion is None:
        return torch.zeros_like(point)
    if not isinstance(motion, Rotation):
        _, shift = _displacement(scene, motion, time)
        return (point.new_tensor(shift) / interval).expand_as(point)
    speed = motion.angle(time, time + interval) / interval
    axis = point.new_tensor(motion.axis).expand_as(point)
    return speed * torch.linalg.cross(axis, point - point.new_tensor(motion.point))


def closest_point(shape: FloatArray, position: Tensor) -> tuple[Tensor, Tensor]:
    """Closest point of a wall: distance of each centre, and the unit vector from it to the wall; differentiable.

    Args:
        shape: ``(11,)`` of the wall, lengths in the unit of ``position``.
        position: ``(N, 3)``.

    Returns:
        ``(N,)`` and ``(N, 3)``, as :func:`gran_bench.dem.walls.wall_contact` gives them.
    """
    kind, direction = shape[KIND], position.new_tensor(shape[DIRECTION])
    offset = position - position.new_tensor(shape[POINT])
    if kind == ABSENT:
        return torch.full_like(offset[:, 0], torch.inf), torch.zeros_like(offset)
    along = offset @ direction
    if kind == PLANE:
        return along, -direction.expand_as(offset)
    reach, outward = _length_and_direction(offset - along[:, None] * direction)
    r0, s0, r1, s1 = (float(size) for size in shape[SIZES])
    if kind == CYLINDER:
        return r0 - reach, outward
    dr, ds = r1 - r0, s1 - s0
    share = (((reach - r0) * dr + (along - s0) * ds) / (dr * dr + ds * ds)).clamp(0.0, 1.0)
    distance, across_up = _length_and_direction(torch.stack((r0 + share * dr - reach, s0 + share * ds - along), 1))
    outward = torch.where((reach > 0)[:, None], outward, position.new_tensor(dem_walls.any_normal_to(shape[DIRECTION])))
    return distance, across_up[:, :1] * outward + across_up[:, 1:] * direction


def _length_and_direction(vector: Tensor) -> tuple[Tensor, Tensor]:
    """Lengths ``(N,)`` and unit vectors, zero where the length is; with a finite gradient there."""
    squared = (vector * vector).sum(1)
    known = squared > 0
    length = torch.sqrt(torch.where(known, squared, torch.ones_like(squared)))
    return length * known, vector / length[:, None]
