"""Which spheres a wall is near, and how far it is (jitted). Walls are rows of a pose table (walls.py)."""

import math

import numpy as np

from gran_bench.dem.walls import ABSENT, CYLINDER, PLANE
from gran_bench.neighbors.kernel import entry, kernel


@kernel
def shape_of(walls, w):
    """Kind, point, direction and sizes of wall w of ``(W, 22)`` poses, as a tuple that stays in registers."""
    return (
        walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3], walls[w, 4], walls[w, 5], walls[w, 6],
        walls[w, 7], walls[w, 8], walls[w, 9], walls[w, 10],
    )  # fmt: skip


@kernel
def toward_wall(shape, x, y, z):
    """Distance of a point from a wall's :func:`shape_of`, m, and the unit vector to it, as of `walls.wall_contact`."""
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


@entry
def list_wall_contacts(
    sphere, bounds, chunk, stop, walls, paths, margin, known_first, known_wall, wall_i, wall_w, memory, start, touched
):
    """Particles of ``chunk … stop − 1`` and walls that may touch in the rest of a stretch: ``wall_i …`` of `Lists`.

    Walls go ``paths``, ``(W,)`` m, in the rest of the stretch, and no particle further than ``margin``, ``(N,)`` m. The
    known particles and walls touch; their rows of history are 1 … C, and ``touched`` gets the place of each. The spare
    body N is at place 0, at the first wall. Returns the number of places.
    """
    begin, end, count = bounds[chunk], bounds[stop], len(walls)
    known = np.zeros((end - begin, count), np.uint32)
    for c in range(len(known_first)):
        if begin <= known_first[c] < end and known_wall[c] < count:
            known[known_first[c] - begin, known_wall[c]] = c + 1
    wall_i[0], wall_w[0], memory[0] = len(sphere) - 2, 0, 0
    start[0] = found = 1
    for c in range(chunk, stop):
        for w in range(count):
            shape = shape_of(walls, w)
            for i in range(bounds[c], bounds[c + 1]):
                wall_i[found], wall_w[found], memory[found] = i, w, known[i - begin, w]
                distance = toward_wall(shape, sphere[i, 0], sphere[i, 1], sphere[i, 2])[0]
                touched[memory[found]] = found
                found += distance - sphere[i, 3] < margin[i] + paths[w]
            start[(c - chunk) * count + w + 1] = found
    return found
