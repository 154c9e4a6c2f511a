"""Which spheres a wall is near, and how far it is (jitted).

Walls are rows of a pose table (walls.py).
"""

from __future__ import annotations

import math

import numpy as np

from gran_bench.dem.walls import ABSENT, CYLINDER, PATH, PLANE
from gran_bench.neighbors import IndexArray
from gran_bench.neighbors.kernel import entry, kernel
from gran_bench.state import FloatArray


@kernel
def shape_of(walls, w):
    """Kind, point, direction and sizes of wall w of ``(W, 22)`` poses, as a tuple that stays in registers."""
    return (
        walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3], walls[w, 4], walls[w, 5], walls[w, 6],
        walls[w, 7], walls[w, 8], walls[w, 9], walls[w, 10],
    )  # fmt: skip


@kernel
def toward_wall(shape, x, y, z):
    """Distance of a point from a wall, and the unit vector to it; the rules of :func:`walls.wall_contact`.

    Args:
        shape: of :func:`shape_of`.
        x, y, z: m.
    """
    kind, px, py, pz, ax, ay, az, r0, s0, r1, s1 = shape
    ox, oy, oz = x - px, y - py, z - pz
    along = ox * ax + oy * ay + oz * az
    if kind == PLANE:
        return along, -ax, -ay, -az
    if kind == ABSENT:
        return np.inf, 0.0, 0.0, 0.0
    ox, oy, oz = ox - along * ax, oy - along * ay, oz - along * az
    reach = math.sqrt(ox * ox + oy * oy + oz * oz)
    inverse = 1.0 / reach if reach > 0.0 else 0.0
    ox, oy, oz = ox * inverse, oy * inverse, oz * inverse
    if kind == CYLINDER:
        return r0 - reach, ox, oy, oz
    dr, ds = r1 - r0, s1 - s0
    share = ((reach - r0) * dr + (along - s0) * ds) / (dr * dr + ds * ds)
    share = min(1.0, max(0.0, share))
    across, up = r0 + share * dr - reach, s0 + share * ds - along
    distance = math.sqrt(across * across + up * up)
    if reach == 0.0:
        ox, oy, oz = _any_normal_to(ax, ay, az)
    inverse = 1.0 / distance if distance > 0.0 else 0.0
    across, up = across * inverse, up * inverse
    return distance, across * ox + up * ax, across * oy + up * ay, across * oz + up * az


@kernel
def _any_normal_to(ax, ay, az):
    """A unit vector across a unit vector; the one of :func:`walls.any_normal_to`."""
    if abs(ax) <= abs(ay) and abs(ax) <= abs(az):
        x, y, z = 0.0, az, -ay
    elif abs(ay) <= abs(az):
        x, y, z = -az, 0.0, ax
    else:
        x, y, z = ay, -ax, 0.0
    inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
    return inverse * x, inverse * y, inverse * z


def list_wall_contacts(
    sphere: FloatArray,
    bounds: IndexArray,
    chunk: int,
    stop: int,
    walls: FloatArray,
    row: int,
    margin: FloatArray,
    known_first: IndexArray,
    known_wall: IndexArray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, IndexArray]:
    """Particles of ``chunk … stop − 1`` and walls that may touch in the rest of a stretch, and whose history is whose.

    Args:
        sphere: ``(N + 2, 4)`` x, y, z, r, m.
        bounds: ``(C + 1,)`` first particle of each chunk.
        chunk, stop: range of chunks.
        walls: ``(steps + 1, W, 22)`` poses.
        row: of the poses that belong to these positions.
        margin: ``(N,)`` m that no particle moves further than while the list lives.
        known_first, known_wall: ``(C,)`` particle and wall that touch; their rows of history are 1 … C.

    Returns:
        ``(≥ M + 1,)`` particle and wall, chunk by chunk, wall by wall; ``(M + 1,)`` row of history; ``(chunks W + 1,)``
        place of the first contact of each chunk and wall. Place 0 is spare: the spare body N at the first wall.
    """
    begin, end, count = int(bounds[chunk]), int(bounds[stop]), walls.shape[1]
    # Rows of history by particle and wall.
    known = np.zeros((end - begin, count), np.uint32)
    here = np.flatnonzero((begin <= known_first) & (known_first < end) & (known_wall < count))
    known[known_first[here] - begin, known_wall[here]] = here + 1
    paths = walls[row + 1 :, :, PATH].sum(axis=0)
    wall_i, wall_w, memory = (np.empty((end - begin) * count + 2, np.uint32) for _ in range(3))
    wall_i[0], wall_w[0], memory[0] = len(sphere) - 2, 0, 0
    start = np.empty((stop - chunk) * count + 1, np.int64)
    list_near(sphere, bounds, chunk, stop, walls[row], paths, margin, known, wall_i, wall_w, memory, start)
    return wall_i, wall_w, memory[: start[-1]], start


@entry
def list_near(sphere, bounds, chunk, stop, walls, paths, margin, known, wall_i, wall_w, memory, start):
    """Fills ``wall_i``, ``wall_w``, ``memory`` and ``start`` of :func:`list_wall_contacts`, which allocates them.

    Args:
        walls: ``(W, 22)`` poses that belong to these positions.
        paths: ``(W,)`` how far each wall goes in the rest of the stretch, m.
        known: ``(n, W)`` row of history of each of the n particles with each wall, 0 for none.
        The others: of :func:`list_wall_contacts`.
    """
    begin, place, found = bounds[chunk], 0, 1
    start[0] = found
    for c in range(chunk, stop):
        for w in range(len(walls)):
            shape = shape_of(walls, w)
            for i in range(bounds[c], bounds[c + 1]):
                wall_i[found], wall_w[found], memory[found] = i, w, known[i - begin, w]
                distance = toward_wall(shape, sphere[i, 0], sphere[i, 1], sphere[i, 2])[0]
                found += distance - sphere[i, 3] < margin[i] + paths[w]
            place += 1
            start[place] = found
