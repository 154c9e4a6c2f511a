"""One contact where pieces of one surface meet.

A sphere over the edge of two pieces is near both, but touches their surface once: where the surface is closest. The
contact of a piece is left out when its closest point lies on another piece of the surface that is nearer, or as near
and earlier among the walls. Two real contacts, as in the corner of a tube and its lid, have closest points inside their
pieces and both stay. What a contact remembers goes over to the piece that answers in its place, so that a sphere rolls
over a seam as over one piece.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gran_bench.dem.fast.wall_list import shape_of, toward_wall
from gran_bench.dem.walls import REVOLUTION, SURFACE, wall_contact
from gran_bench.neighbors.kernel import kernel
from gran_bench.scene.seams import SAME_POINT
from gran_bench.state import ContactHistory, FloatArray

# Sphere radii within which two distances are equal: well above rounding, and too little to tilt a contact.
EQUAL = 1e-10


class Touching(NamedTuple):
    """Spheres that a wall answers."""

    sphere: np.ndarray  # (M,) their indices
    distance: FloatArray  # (M,) of their centres, m
    normal: FloatArray  # (M, 3) unit vectors from them to the wall


def wall_touching(
    poses: FloatArray, position: FloatArray, radius: FloatArray, history: ContactHistory
) -> tuple[list[Touching], ContactHistory]:
    """What each of the walls answers, and the last history with what goes over between pieces of a surface."""
    reached = [wall_contact(pose, position) for pose in poses]
    touches = [distance < radius for distance, _ in reached]
    answers, merged = one_contact_each(poses, poses[:, SURFACE], position, radius, reached, touches)
    for w, v, i in merged:
        history = _handed_over(history, w, v, i[answers[v][i]])
    found = map(np.flatnonzero, answers)
    return [Touching(i, d[i], n[i]) for i, (d, n) in zip(found, reached, strict=True)], history


def one_contact_each(
    shapes: FloatArray, surfaces: Sequence[float], position: FloatArray, radius: FloatArray,
    reached: Sequence[tuple[FloatArray, FloatArray]], touches: Sequence[np.ndarray],
) -> tuple[list[np.ndarray], list[tuple[int, int, np.ndarray]]]:  # fmt: skip
    """Which spheres each of W walls answers, where a surface answers a sphere once, and what goes over.

    Args:
        shapes, surfaces: ``(W, ≥ 11)`` first columns of their poses, ``(W,)`` number of the surface of each, or 0.
        position, radius: ``(N, 3)`` and ``(N,)`` m.
        reached, touches: of each wall, as of :func:`wall_contact`, and ``(N,)`` bool whether it would answer alone.

    Returns:
        ``(N,)`` bool of each wall, and triples (w, v, i): wall v answers the spheres i in the place of wall w.
    """
    surfaces = np.asarray(surfaces)
    answers, merged = [near.copy() for near in touches], []
    for w in np.flatnonzero(surfaces):
        distance, normal = reached[w]
        for v in np.flatnonzero(surfaces == surfaces[w]):
            i = np.flatnonzero(touches[v] & np.isfinite(distance))
            if v == w or not len(i):
                continue
            point = position[i] + distance[i, None] * normal[i]
            here = np.abs(wall_contact(shapes[v], point)[0]) <= SAME_POINT * radius[i]
            first, second = (np.floor(reached[k][0][i] / (EQUAL * radius[i])) for k in (v, w))
            i = i[here & ((first < second) | ((first == second) & (v < w)))]
            answers[w][i] = False
            merged.append((w, v, i))
    return answers, merged


def _handed_over(history: ContactHistory, source: int, target: int, spheres: np.ndarray) -> ContactHistory:
    """The history in which contacts of some spheres with one wall are with another, where they have none with it."""
    own = history.first[history.second == -1 - target]
    leaving = (history.second == -1 - source) & np.isin(history.first, np.setdiff1d(spheres, own))
    if not leaving.any():
        return history
    return replace(history, second=np.where(leaving, -1 - target, history.second))


@kernel
def another_answers(walls, w, x, y, z, radius, distance, nx, ny, nz):
    """Whether another piece of wall w's surface answers a sphere at x, y, z that w is this far from, in this way."""
    for v in range(len(walls)):
        if v != w and walls[v, 21] == walls[w, 21] and not _is_far(walls, v, x, y, z, radius):
            other = shape_of(walls, v)
            away = toward_wall(other, x, y, z)[0]
            if away < radius and _goes_before(other, v, away, w, x, y, z, radius, distance, nx, ny, nz):
                return True
    return False


@kernel
def _is_far(walls, v, x, y, z, radius):
    """Whether a sphere lies before or behind the whole of wall v: what is cheap to see, and true of most."""
    if walls[v, 0] != REVOLUTION:
        return False
    along = (x - walls[v, 1]) * walls[v, 4] + (y - walls[v, 2]) * walls[v, 5] + (z - walls[v, 3]) * walls[v, 6]
    s0, s1 = walls[v, 8], walls[v, 10]
    return along < min(s0, s1) - radius or along > max(s0, s1) + radius


@kernel
def hand_over(walls, w, p, x, y, z, radius, distance, wall_i, start, memory, touched, remembered):
    """Gives a new contact, at place p with wall w, what the contact that it takes the place of remembers.

    The lists are those of :func:`contact_forces.wall_forces`; ``memory[p]`` and ``touched`` change.
    """
    i = wall_i[p]
    for v in range(len(walls)):
        if v == w or walls[v, 21] != walls[w, 21]:
            continue
        low, high = start[v], start[v + 1]
        while low < high:
            middle = (low + high) // 2
            if wall_i[middle] < i:
                low = middle + 1
            else:
                high = middle
        if low == start[v + 1] or wall_i[low] != i:
            continue
        row = memory[low]
        if 0 < row < remembered and touched[row] == low:
            away, nx, ny, nz = toward_wall(shape_of(walls, v), x, y, z)
            shape = shape_of(walls, w)
            if away < np.inf and _goes_before(shape, w, distance, v, x, y, z, radius, away, nx, ny, nz):
                memory[p] = row
                touched[row] = p
                return


@kernel
def _goes_before(shape, v, away, w, x, y, z, radius, distance, nx, ny, nz):
    """Whether wall v, of a shape and this far away, answers in the place of wall w, whose closest point is given."""
    step = EQUAL * radius
    first, second = math.floor(away / step), math.floor(distance / step)
    if first > second or (first == second and v > w):
        return False
    gap = toward_wall(shape, x + distance * nx, y + distance * ny, z + distance * nz)[0]
    return abs(gap) <= SAME_POINT * radius
