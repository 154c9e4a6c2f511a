"""One contact where pieces of one surface meet.

A piece does not answer a sphere where its closest point lies on another piece of the surface that is nearer, or as near
and earlier among the walls. What its contact remembers goes over to the piece that answers in its place.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gran_bench.dem.fast.wall_list import shape_of, toward_wall
from gran_bench.dem.walls import SURFACE, wall_contact
from gran_bench.neighbors.kernel import kernel
from gran_bench.scene.walls import SAME_POINT
from gran_bench.state import ContactHistory, FloatArray

# Sphere radii within which two distances are equal: well above rounding, and too little to tilt a contact.
EQUAL = 1e-10


def wall_touching(
    poses: FloatArray, position: FloatArray, radius: FloatArray, history: ContactHistory
) -> tuple[list[tuple[np.ndarray, FloatArray, FloatArray]], ContactHistory]:
    """What each of the walls answers, and the last history with what goes over between pieces of a surface.

    Of each wall ``(M,)`` indices of spheres, ``(M,)`` distances of their centres, m, ``(M, 3)`` unit vectors to it.
    """
    reached = [wall_contact(pose, position) for pose in poses]
    touches = [distance < radius for distance, _ in reached]
    answers, merged = one_contact_each(poses, poses[:, SURFACE], position, radius, reached, touches)
    for w, v, i in merged:
        own = history.first[history.second == -1 - v]
        leaving = (history.second == -1 - w) & np.isin(history.first, np.setdiff1d(i[answers[v][i]], own))
        history = replace(history, second=np.where(leaving, -1 - v, history.second))
    found = map(np.flatnonzero, answers)
    return [(i, d[i], n[i]) for i, (d, n) in zip(found, reached, strict=True)], history


def one_contact_each(
    shapes: FloatArray, surfaces: Sequence[float], position: FloatArray, radius: FloatArray,
    reached: Sequence[tuple[FloatArray, FloatArray]], touches: Sequence[np.ndarray],
) -> tuple[list[np.ndarray], list[tuple[int, int, np.ndarray]]]:  # fmt: skip
    """``(N,)`` bool of each wall, whom it answers, and triples (w, v, i): wall v answers spheres i in the place of w.

    Args:
        shapes, surfaces: ``(W, ≥ 11)`` first columns of their poses, ``(W,)`` number of the surface of each, or 0.
        position, radius: ``(N, 3)`` and ``(N,)`` m.
        reached, touches: of each wall, as of :func:`wall_contact`, and ``(N,)`` bool whether it would answer alone.
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


@kernel
def another_answers(walls, w, x, y, z, radius, distance, nx, ny, nz):
    """Whether another piece of wall w's surface answers a sphere at x, y, z that w is this far from, in this way."""
    for v in range(len(walls)):
        if v != w and walls[v, 21] == walls[w, 21]:
            other = shape_of(walls, v)
            away = toward_wall(other, x, y, z)[0]
            if away < radius and _goes_before(other, v, away, w, x, y, z, radius, distance, nx, ny, nz):
                return True
    return False


@kernel
def hand_over(walls, w, p, x, y, z, radius, distance, wall_i, start, memory, touched, remembered):
    """Gives a new contact, at place p with wall w, what the contact that it takes the place of remembers."""
    i = wall_i[p]
    for v in range(len(walls)):
        if v == w or walls[v, 21] != walls[w, 21]:
            continue
        place, high = start[v], start[v + 1]
        while place < high:
            middle = (place + high) // 2
            if wall_i[middle] < i:
                place = middle + 1
            else:
                high = middle
        if place == start[v + 1] or wall_i[place] != i:
            continue
        row = memory[place]
        if 0 < row < remembered and touched[row] == place:
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
