"""How a convolutional surrogate sees the walls: as spheres on their surface, or as analytic closest points."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from gran_bench.dem.seams import one_contact_each
from gran_bench.dem.walls import ABSENT, CYLINDER, DIRECTION, KIND, PLANE, POINT, REVOLUTION, SIZES, wall_contact
from gran_bench.neighbors import cell_neighbors
from gran_bench.scene import Scene
from gran_bench.state import FloatArray
from gran_bench.surrogate.walls import closest_point, frame_walls, wall_velocity

KINDS = ("none", "spheres", "analytic")


@dataclass(frozen=True)
class WallPairs:
    """The wall as the particles near it see it in one frame.

    P particles are near: their centre is closer than R to a wall's surface. They see S sources through M pairs.
    """

    near: Tensor  # (P,) int64, indices of the near particles, increasing
    distance: Tensor  # (P,) m, of their centres from the nearest wall
    query: Tensor  # (M,) int64 into near, sorted
    source: Tensor  # (M,) int64 into the sources
    relative: Tensor  # (M, 3) m, source − particle
    normal: Tensor  # (S, 3) unit normals into the container, or to the particle's side of a wall with two sides
    velocity: Tensor  # (S, 3) m/s, of the wall's material, mean over the frame
    moves: bool  # whether any wall of the scene ever moves; where none does, the velocities are zero
    gap: Tensor | None = None  # (S,) from the wall to the particle's surface, in diameters; analytic sources only
    slip: Tensor | None = None  # (S, 3) m/s, of the wall less that of the particle; analytic sources only


@dataclass(frozen=True)
class WallSpheres:
    """W points that cover the walls of a scene; a smooth drum is the same at every angle, so they rest on it.

    A wall with two sides has each point twice, once with either normal.
    """

    position: FloatArray  # (W, 3) m, on the surface
    normal: FloatArray  # (W, 3) into the container, or to one side
    wall: np.ndarray  # (W,) index of the wall each lies on
    two_sided: np.ndarray  # (W,) bool; such a point is seen from the side that its normal points to


def wall_spheres(
    scene: Scene, shapes: FloatArray, spacing: float, low: FloatArray, high: FloatArray, beyond: float = 0.0
) -> WallSpheres:
    """Cover the walls of a scene with points about ``spacing`` (m) apart.

    A drum is covered between its caps, or over one period, whose length a whole number of rows divides; its end cap is
    a disc of the drum's radius. Other walls without an end are covered within a box.

    Args:
        shapes: ``(W, 11)`` of the walls, as :class:`~gran_bench.surrogate.walls.FrameWalls` has them.
        low, high: ``(3,)`` corners of that box, m.
        beyond: how far the cover goes on beyond the ends of a period, m; for particles that see across its seam.

    Raises:
        ValueError: a spacing that is not positive.
    """
    if not spacing > 0:
        raise ValueError(f"boundary.spacing gives {spacing:g} m between wall spheres; choose a value > 0")
    pieces = [(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, bool))]
    is_drum = scene.drum_radius is not None and scene.length is not None
    for index, shape in enumerate(shapes):
        kind = shape[KIND]
        if kind == ABSENT:
            continue
        if kind == REVOLUTION:
            position, normal = _cover_revolution(tuple(shape), spacing)
        elif is_drum and kind == CYLINDER:
            position, normal = _cover_drum(tuple(shape), scene.length, spacing, beyond if scene.period > 0.0 else 0.0)
        elif is_drum:
            position, normal = _cover_cap(tuple(shape), scene.drum_radius, spacing)
        elif kind == PLANE:
            position, normal = _cover_plane(shape, spacing, low, high)
        else:  # a cylinder without an end, as far as the box goes along it
            row = _multiples(shape[POINT], shape[DIRECTION], spacing, low, high)
            position, normal = _on_cylinder(shape, row * spacing, spacing, row)
        pieces.append((position, normal, np.full(len(position), index), np.full(len(position), kind == REVOLUTION)))
    return WallSpheres(*(np.concatenate(parts) for parts in zip(*pieces, strict=True)))


def _frame(axis: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The unit axis and two unit vectors across it."""
    along = np.asarray(axis, float)
    along = along / np.linalg.norm(along)
    first = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    first /= np.linalg.norm(first)
    return along, first, np.cross(along, first)


def _on_cylinder(shape: FloatArray, height: FloatArray, spacing: float, row: FloatArray) -> tuple[FloatArray, ...]:
    """Rows of points around a cylinder at heights along it, every other row turned by half a spacing."""
    along, first, second = _frame(shape[DIRECTION])
    radius = shape[SIZES][0]
    around = max(3, round(2.0 * math.pi * radius / spacing))
    angle = (np.arange(around)[None, :] + 0.5 * (row[:, None] % 2)) * (2.0 * math.pi / around)
    outward = np.cos(angle)[..., None] * first + np.sin(angle)[..., None] * second
    position = shape[POINT] + radius * outward + height[:, None, None] * along
    return position.reshape(-1, 3), -outward.reshape(-1, 3)


@lru_cache(maxsize=16)
def _cover_drum(shape: tuple[float, ...], length: float, spacing: float, beyond: float) -> tuple[FloatArray, ...]:
    rows = max(1, round(length / spacing))
    if beyond > 0.0:
        rows += rows % 2  # turned rows alternate across the seam too
    more = math.ceil(beyond * rows / length)
    row = np.arange(-more, rows + more)
    return _on_cylinder(np.array(shape), ((row + 0.5) / rows - 0.5) * length, spacing, row)


@lru_cache(maxsize=16)
def _cover_cap(shape: tuple[float, ...], radius: float, spacing: float) -> tuple[FloatArray, ...]:
    """Rings of points on a disc about a plane's point."""
    normal = np.array(shape)[DIRECTION]
    position = np.array(shape)[POINT] + _rings((0.0, 0.0), (radius, 0.0), normal, spacing)
    return position, np.broadcast_to(normal, position.shape).copy()


@lru_cache(maxsize=64)
def _cover_revolution(shape: tuple[float, ...], spacing: float) -> tuple[FloatArray, ...]:
    """Rings of points on a surface of revolution, each with the normals of both sides."""
    drawn = np.array(shape)
    axis, (r0, s0, r1, s1) = drawn[DIRECTION], drawn[SIZES]
    offset = _rings((r0, s0), (r1, s1), axis, spacing)
    radial = offset - np.outer(offset @ axis, axis)
    outward = radial / np.linalg.norm(radial, axis=1)[:, None]
    normal = ((s1 - s0) * outward - (r1 - r0) * axis) / math.hypot(r1 - r0, s1 - s0)
    return np.tile(drawn[POINT] + offset, (2, 1)), np.concatenate((normal, -normal))


def _rings(start: tuple[float, float], end: tuple[float, float], axis: FloatArray, spacing: float) -> FloatArray:
    """Rings of points on what the segment between two (distance from the axis, height along it) sweeps."""
    along, first, second = _frame(axis)
    rings = max(1, round(math.dist(start, end) / spacing))
    points = []
    for ring in range(rings):
        share = (ring + 0.5) / rings
        distance, height = ((1.0 - share) * a + share * b for a, b in zip(start, end, strict=True))
        count = max(3, round(2.0 * math.pi * distance / spacing))
        angle = (np.arange(count) + 0.5 * (ring % 2)) * (2.0 * math.pi / count)
        points.append(distance * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second) + height * along)
    return np.concatenate(points)


def _cover_plane(shape: FloatArray, spacing: float, low: FloatArray, high: FloatArray) -> tuple[FloatArray, ...]:
    """Rows of points on a plane, where a box lies before it, every other row moved by half a spacing."""
    normal, first, second = _frame(shape[DIRECTION])
    column, row = (_multiples(shape[POINT], axis, spacing, low, high) for axis in (first, second))
    across = (column[None, :] + 0.5 * (row[:, None] % 2)) * spacing
    up = np.broadcast_to(row[:, None] * spacing, across.shape)
    position = shape[POINT] + across.reshape(-1, 1) * first + up.reshape(-1, 1) * second
    return position, np.broadcast_to(normal, position.shape).copy()


def _multiples(point: FloatArray, axis: FloatArray, spacing: float, low: FloatArray, high: FloatArray) -> FloatArray:
    """Numbers of the multiples of a spacing along an axis from a point that span a box."""
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
    along = (corners - point) @ axis / spacing
    return np.arange(math.floor(along.min()), math.ceil(along.max()) + 1)


def _near(position: Tensor, shapes: FloatArray, radius: float) -> tuple[Tensor, Tensor, list[tuple[Tensor, Tensor]]]:
    """Particles closer than R to a wall, how far each is, and distance and direction of each wall for all."""
    found = [closest_point(shape, position) for shape in shapes]
    distance = torch.stack([d for d, _ in found]).amin(dim=0)
    near = torch.nonzero(distance.detach() < radius)[:, 0]
    return near, distance[near], found


def see_spheres(position: Tensor, scene: Scene, time: float, radius: float, spacing: float) -> WallPairs:
    """The walls as spheres ``spacing`` m apart in the frame from ``time``, s; only those within R of a particle."""
    shapes = frame_walls(scene, time).after
    near, distance, _ = _near(position, shapes, radius)
    centres = position.detach()[near].double().cpu().numpy()
    low, high = (centres.min(axis=0), centres.max(axis=0)) if len(centres) else (np.zeros(3), np.zeros(3))
    cover = wall_spheres(scene, shapes, spacing, low - radius, high + radius, beyond=radius)
    query_index, sphere = cell_neighbors(centres, cover.position, radius)
    away = ((centres[query_index] - cover.position[sphere]) * cover.normal[sphere]).sum(axis=1)
    facing = ~cover.two_sided[sphere] | (away >= 0.0)
    query_index, sphere = query_index[facing], sphere[facing]
    seen = np.zeros(len(cover.position), bool)
    seen[sphere] = True
    kept, source_index = np.flatnonzero(seen), (np.cumsum(seen) - 1)[sphere]

    def tensor(values: np.ndarray) -> Tensor:
        return torch.from_numpy(values).to(position.device, None if values.dtype == np.int64 else position.dtype)

    query, source, point = tensor(query_index), tensor(source_index), tensor(cover.position[kept])
    velocity = torch.zeros_like(point)
    for index, wall in enumerate(scene.walls):
        mine = tensor(np.flatnonzero(cover.wall[kept] == index))
        velocity[mine] = wall_velocity(wall, point[mine], scene, time)
    relative = point.index_select(0, source) - position[near].index_select(0, query)
    seen = query, source, relative, tensor(cover.normal[kept]), velocity
    return WallPairs(near, distance, *seen, scene.needs.wall_motion)


def see_contacts(position: Tensor, velocity: Tensor, scene: Scene, time: float, radius: float) -> WallPairs:
    """The walls as their closest points: one source for each particle and wall closer than R.

    Pieces of one surface answer a particle once, as in the DEM (:mod:`gran_bench.dem.seams`).
    """
    shapes = frame_walls(scene, time).after
    near, distances, found = _near(position, shapes, radius)
    within = [distance.detach() < radius for distance, _ in found]
    if scene.needs.wall_seams:
        exact = position.detach().double().cpu().numpy()
        reached = [wall_contact(shape, exact) for shape in shapes]
        touches, size = [w.cpu().numpy() for w in within], np.full(len(exact), scene.filling.radius)
        answers, _ = one_contact_each(shapes, scene.surfaces, exact, size, reached, touches)
        within = [torch.from_numpy(answer).to(position.device) for answer in answers]
    place = torch.full((len(position),), -1, dtype=torch.int64, device=position.device)
    place[near] = torch.arange(len(near), device=position.device)
    columns: list[tuple[Tensor, ...]] = []
    for wall, near_it, (distance, toward) in zip(scene.walls, within, found, strict=True):
        seen = torch.nonzero(near_it)[:, 0]
        relative = distance[seen, None] * toward[seen]
        moving = wall_velocity(wall, position[seen] + relative, scene, time)
        gap = (distance[seen] - scene.filling.radius) / scene.filling.diameter
        columns.append((place[seen], relative, -toward[seen], moving, gap, moving - velocity[seen]))
    query, relative, normal, moving, gap, slip = (torch.cat(parts) for parts in zip(*columns, strict=True))
    order = torch.argsort(query, stable=True)
    source = torch.arange(len(query), device=position.device)
    seen = query[order], source, relative[order], normal[order], moving[order]
    return WallPairs(near, distances, *seen, scene.needs.wall_motion, gap[order], slip[order])
