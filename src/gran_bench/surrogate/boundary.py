"""How a convolutional surrogate sees the walls: as spheres on their surface, or as analytic closest points."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from gran_bench.neighbors import cell_neighbors
from gran_bench.scene import Cylinder, Plane, Scene, Wall
from gran_bench.state import FloatArray

KINDS = ("none", "spheres", "analytic")


@dataclass(frozen=True)
class WallPairs:
    """The wall as the particles near it see it in one frame.

    P particles are near: their centre is closer than R to a wall's surface. They see S sources through M pairs.

    Attributes:
        near: ``(P,)`` int64, indices of the near particles, increasing.
        query: ``(M,)`` int64 into ``near``, sorted.
        source: ``(M,)`` int64 into the sources.
        relative: ``(M, 3)`` source − particle, m.
        normal: ``(S, 3)`` unit normals into the container.
        velocity: ``(S, 3)`` velocity of the wall's material, mean over the frame, m/s.
        moves: whether any wall of the scene ever moves; where none does, the velocities are zero.
        gap: ``(S,)`` distance from the wall to the particle's surface, in diameters; analytic sources only.
        slip: ``(S, 3)`` velocity of the wall less that of the particle, m/s; analytic sources only.
    """

    near: Tensor
    query: Tensor
    source: Tensor
    relative: Tensor
    normal: Tensor
    velocity: Tensor
    moves: bool
    gap: Tensor | None = None
    slip: Tensor | None = None

    @property
    def source_count(self) -> int:
        """S."""
        return len(self.normal)


@dataclass(frozen=True)
class WallSpheres:
    """Points that cover the walls of a scene; a smooth drum is the same at every angle, so they rest.

    Attributes:
        position: ``(W, 3)`` on the surface, m.
        normal: ``(W, 3)`` into the container.
        wall: ``(W,)`` index of the wall each lies on.
    """

    position: FloatArray
    normal: FloatArray
    wall: np.ndarray


def wall_spheres(scene: Scene, spacing: float, beyond: float = 0.0) -> WallSpheres:
    """Cover the walls of a scene with points about ``spacing`` (m) apart.

    A cylinder is covered between the caps, or over one period, whose length a whole number of rows divides; an end
    cap is a disc of the drum's radius.

    Args:
        beyond: how far the cover goes on beyond the ends of a period, m; for particles that see across its seam.

    Raises:
        ValueError: a spacing that is not positive, or walls without an end (a scene without drum radius or length).
    """
    if not spacing > 0:
        raise ValueError(f"boundary.spacing gives {spacing:g} m between wall spheres; choose a value > 0")
    return _cover(scene.walls, scene.drum_radius, scene.length, scene.period, spacing, beyond)


@lru_cache(maxsize=16)
def _cover(
    walls: tuple[Wall, ...],
    drum_radius: float | None,
    length: float | None,
    period: float,
    spacing: float,
    beyond: float,
) -> WallSpheres:
    if walls and (drum_radius is None or length is None):
        raise ValueError("walls without a drum's radius and length have no end to cover; use boundary.kind=analytic")
    pieces = []
    for wall in walls:
        if isinstance(wall, Cylinder):
            pieces.append(_cover_cylinder(wall, length, spacing, beyond if period > 0.0 else 0.0))
        else:
            pieces.append(_cover_disc(wall, drum_radius, spacing))
    if not pieces:
        return WallSpheres(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64))
    return WallSpheres(
        position=np.concatenate([p for p, _ in pieces]),
        normal=np.concatenate([n for _, n in pieces]),
        wall=np.repeat(np.arange(len(pieces)), [len(p) for p, _ in pieces]),
    )


def _frame(axis: tuple[float, float, float]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The unit axis and two unit vectors across it."""
    along = np.asarray(axis, float)
    along = along / np.linalg.norm(along)
    first = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    first /= np.linalg.norm(first)
    return along, first, np.cross(along, first)


def _cover_cylinder(wall: Cylinder, length: float, spacing: float, beyond: float) -> tuple[FloatArray, FloatArray]:
    """Rows of points around a cylinder, every other row turned by half a spacing."""
    along, first, second = _frame(wall.axis)
    around = max(3, round(2.0 * math.pi * wall.radius / spacing))
    rows = max(1, round(length / spacing))
    if beyond > 0.0:
        rows += rows % 2  # turned rows alternate across the seam too
    more = math.ceil(beyond * rows / length)
    row = np.arange(-more, rows + more)
    height = ((row + 0.5) / rows - 0.5) * length
    angle = (np.arange(around)[None, :] + 0.5 * (row[:, None] % 2)) * (2.0 * math.pi / around)
    outward = np.cos(angle)[..., None] * first + np.sin(angle)[..., None] * second
    position = np.asarray(wall.point) + wall.radius * outward + height[:, None, None] * along
    return position.reshape(-1, 3), -outward.reshape(-1, 3)


def _cover_disc(wall: Plane, radius: float, spacing: float) -> tuple[FloatArray, FloatArray]:
    """Rings of points on a disc about ``wall.point``."""
    normal, first, second = _frame(wall.normal)
    rings = max(1, round(radius / spacing))
    points = []
    for ring in range(rings):
        distance = (ring + 0.5) / rings * radius
        count = max(3, round(2.0 * math.pi * distance / spacing))
        angle = (np.arange(count) + 0.5 * (ring % 2)) * (2.0 * math.pi / count)
        points.append(distance * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second))
    position = np.asarray(wall.point) + np.concatenate(points)
    return position, np.broadcast_to(normal, position.shape).copy()


def closest_point(wall: Wall, position: Tensor) -> tuple[Tensor, Tensor]:
    """Distance of centres from a wall's surface and the normal there; differentiable.

    Args:
        position: ``(N, 3)`` m.

    Returns:
        distance ``(N,)`` m (negative outside the container), normal ``(N, 3)`` into the container. On the axis of a
        cylinder, where every wall point is the closest, the normal is zero.
    """
    offset = position - position.new_tensor(wall.point)
    if isinstance(wall, Plane):
        normal = position.new_tensor(wall.normal)
        return offset @ normal, normal.expand_as(offset)
    axis = position.new_tensor(wall.axis)
    radial = offset - (offset @ axis)[:, None] * axis
    squared = (radial * radial).sum(-1)
    off_axis = squared > 0
    length = torch.sqrt(torch.where(off_axis, squared, torch.ones_like(squared)))
    return wall.radius - length * off_axis, -radial / length[:, None]


def wall_velocity(wall: Wall, point: Tensor, scene: Scene, time: float) -> Tensor:
    """Velocity of a wall's material at points of it, mean over the frame from ``time``: ω̄ axis × x, ``(S, 3)`` m/s.

    ω̄ is the angle turned in the frame over its length, so that a change of speed inside a frame counts in full.
    """
    if not wall.turns or scene.rotation.is_still:
        return torch.zeros_like(point)
    speed = scene.rotation.angle(time, time + scene.frame_interval) / scene.frame_interval
    axis = point.new_tensor(scene.rotation.axis)
    return speed * torch.linalg.cross(axis.expand_as(point), point)


def _near(position: Tensor, scene: Scene, radius: float) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
    """Which particles are closer than R to a wall, ``(P,)``, and distance and normal for each wall."""
    found = [closest_point(wall, position) for wall in scene.walls]
    distance = torch.stack([d.detach() for d, _ in found]).amin(dim=0)
    return torch.nonzero(distance < radius)[:, 0], found


def see_spheres(position: Tensor, scene: Scene, time: float, radius: float, spacing: float) -> WallPairs:
    """The walls as boundary spheres; only those within R of a particle are kept.

    Args:
        position: ``(N, 3)`` m.
        time: start of the frame, s.
        radius: R, m.
        spacing: of the spheres, m.
    """
    near, _ = _near(position, scene, radius)
    cover = wall_spheres(scene, spacing, beyond=radius)
    centres = position.detach()[near].double().cpu().numpy()
    query_index, sphere = cell_neighbors(centres, cover.position, radius)
    seen = np.zeros(len(cover.position), bool)
    seen[sphere] = True
    kept, source_index = np.flatnonzero(seen), (np.cumsum(seen) - 1)[sphere]

    device, like = position.device, position.detach()
    query = torch.from_numpy(query_index).to(device)
    source = torch.from_numpy(source_index).to(device)
    point = torch.as_tensor(cover.position[kept], dtype=like.dtype, device=device)
    velocity = torch.zeros_like(point)
    for index, wall in enumerate(scene.walls):
        mine = torch.from_numpy(np.flatnonzero(cover.wall[kept] == index)).to(device)
        velocity[mine] = wall_velocity(wall, point[mine], scene, time)
    return WallPairs(
        near=near,
        query=query,
        source=source,
        relative=point.index_select(0, source) - position[near].index_select(0, query),
        normal=torch.as_tensor(cover.normal[kept], dtype=like.dtype, device=device),
        velocity=velocity,
        moves=scene.needs.wall_motion,
    )


def see_contacts(position: Tensor, velocity: Tensor, scene: Scene, time: float, radius: float) -> WallPairs:
    """The walls as their closest points: one source for each particle and wall closer than R.

    Args:
        position: ``(N, 3)`` m.
        velocity: ``(N, 3)`` m/s, for the slip.
        time: start of the frame, s.
        radius: R, m.
    """
    near, found = _near(position, scene, radius)
    place = torch.full((len(position),), -1, dtype=torch.int64, device=position.device)
    place[near] = torch.arange(len(near), device=position.device)
    columns: list[tuple[Tensor, ...]] = []
    for wall, (distance, normal) in zip(scene.walls, found, strict=True):
        seen = torch.nonzero(distance.detach() < radius)[:, 0]
        relative = -distance[seen, None] * normal[seen]
        moving = wall_velocity(wall, position[seen] + relative, scene, time)
        gap = (distance[seen] - scene.filling.radius) / scene.filling.diameter
        columns.append((place[seen], relative, normal[seen], moving, gap, moving - velocity[seen]))
    query, relative, normal, moving, gap, slip = (torch.cat(parts) for parts in zip(*columns, strict=True))
    order = torch.argsort(query, stable=True)
    return WallPairs(
        near=near,
        query=query[order],
        source=torch.arange(len(query), device=position.device),
        relative=relative[order],
        normal=normal[order],
        velocity=moving[order],
        moves=scene.needs.wall_motion,
        gap=gap[order],
        slip=slip[order],
    )
