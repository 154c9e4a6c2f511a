"""The surfaces of a block of contacts, from the rows of their particles: of pairs and at walls, and the adjoints.

A state's row is (D, q, h). Besides, a contact holds, as columns of ``(6, C)``, what stays the same over a frame: at its
start x_j − x_i of a pair and x_i at a wall, and its spring.
"""

import math

import numpy as np

from gran_bench.dem.fast.wall_list import shape_of, toward_wall
from gran_bench.dem.walls import PLANE, REVOLUTION
from gran_bench.surrogate.contact.constants import CHANNELS
from gran_bench.surrogate.contact.kernels.block import (
    CENTER,
    D_GAP,
    D_MOTION,
    D_NORMAL,
    D_SPIN,
    D_TOGETHER,
    DISTANCE,
    GAP,
    HALF,
    MOTION,
    NORMAL,
    ONE,
    SPIN,
    SPRING,
    SUM_A,
    TOGETHER,
    ZERO,
    block_jit,
    both,
    cross,
    dot,
    less,
    plus,
    store,
    three,
    times,
)
from gran_bench.surrogate.contact.kernels.lanes import LANES, WIDTH, gathering, lanes_of, scattering, wide
from gran_bench.surrogate.walls import SHAPE

TINY = np.float32(1e-12)  # units; keeps a division by a distance finite

# A wall's row: its shape, then M row by row and t, which move its point c by M c + t.
MATRIX, SHIFT = SHAPE, SHAPE + 9


def three_rows(*firsts: int) -> list[int]:
    """Three neighbouring rows from each on; of the third as many as there are channels."""
    return [first + m for k, first in enumerate(firsts) for m in range(CHANNELS if k == 2 else 3)]


def of_columns(*values: float) -> list[float]:
    """A factor for each of those rows, of one for each vector and for the channels."""
    return [value for k, value in enumerate(values) for _ in range(CHANNELS if k == 2 else 3)]


# D_j − D_i, q_i + q_j and h_i + h_j; a wall has no row, and answers 2 h_i.
_SEEN, _BACK = three_rows(MOTION, SPIN, TOGETHER), three_rows(D_MOTION, D_SPIN, D_TOGETHER, D_NORMAL)
_gather_pairs = gathering(_SEEN, of_columns(-1.0, 1.0, 1.0), of_columns(1.0, 1.0, 1.0))
_gather_walls = gathering(_SEEN, of_columns(-1.0, 1.0, 2.0), None)
# The other way round; the last vector is what the positions at the frame's start get.
_return_pairs = scattering(_BACK, of_columns(-1.0, 1.0, 1.0, -1.0), of_columns(1.0, 1.0, 1.0, 1.0))
_return_walls = scattering(_BACK, of_columns(-1.0, 1.0, 2.0, -1.0), None)


@block_jit
def hold(contacts, start, springs, position, period):  # pragma: no cover - jitted
    """What contacts hold over a frame, ``(6, C)``, with room for a block more; the pairs end at ``start``."""
    held = np.zeros((6, len(contacts) + LANES), np.float32)
    for p in range(len(contacts)):
        i, j = contacts[p, 0], contacts[p, 1]
        for m in range(3):
            held[m, p], held[3 + m, p] = position[i, m], springs[p, m]
        if p < start:
            for m in range(3):
                held[m, p] = position[j, m] - position[i, m]
            if period > ZERO:
                held[1, p] -= period * math.floor(held[1, p] / period + HALF)
    return held


@block_jit
def gather(b, contacts, first, last, walls, w, state, held, sums, diameter):  # pragma: no cover - jitted
    """Rows of the contacts ``first`` to ``last`` with wall ``w``, of pairs where it is −1; more repeat the last."""
    for place in range(0, LANES, WIDTH):
        if w < 0:
            _gather_pairs(b, place, state, contacts, first, last)
        else:
            _gather_walls(b, place, state, contacts, first, last)
        for m in range(3):
            lanes_of(b, place, NORMAL + m, held, m, first)
            lanes_of(b, place, SPRING + m, held, 3 + m, first)
        for m in range(2):
            lanes_of(b, place, SUM_A + m, sums, m, first)
    for c in range(last - first, LANES):
        for m in range(3):
            b[(NORMAL + m) * LANES + c] = b[(NORMAL + m) * LANES + last - first - 1]
            b[(SPRING + m) * LANES + c] = b[(SPRING + m) * LANES + last - first - 1]
        for m in range(2):
            b[(SUM_A + m) * LANES + c] = b[(SUM_A + m) * LANES + last - first - 1]
    if w < 0:
        _pair_surfaces(b, diameter)
    else:
        _wall_surfaces(b, walls, w, HALF * diameter)


@block_jit
def _pair_surfaces(b, diameter):  # pragma: no cover - jitted
    """NORMAL, DISTANCE and GAP; NORMAL holds x_j − x_i at the start."""
    wide()
    for c in range(LANES):
        e = both(three(b, NORMAL, c), three(b, MOTION, c))
        distance = math.sqrt(dot(e, e))
        store(b, NORMAL, c, times(ONE / distance, e))
        b[DISTANCE * LANES + c], b[GAP * LANES + c] = distance, distance - diameter


@block_jit
def _wall_surfaces(b, walls, w, radius):  # pragma: no cover - jitted
    """The same, CENTER and MOTION of the contacts with a wall; NORMAL holds x_i at the start, MOTION −D_i."""
    shape = shape_of(walls, w)
    for c in range(LANES):
        y0, y1, y2 = less(three(b, NORMAL, c), ONE, three(b, MOTION, c))
        distance, n0, n1, n2 = toward_wall(shape, y0, y1, y2)
        # The wall's point that the particle would touch.
        c0, c1, c2 = y0 + distance * n0, y1 + distance * n1, y2 + distance * n2
        store(b, CENTER, c, (y0, y1, y2))
        store(b, NORMAL, c, (n0, n1, n2))
        b[DISTANCE * LANES + c], b[GAP * LANES + c] = distance, distance - radius
        for m in range(3):
            row = MATRIX + 3 * m
            moved = walls[w, row] * c0 + walls[w, row + 1] * c1 + walls[w, row + 2] * c2
            b[(MOTION + m) * LANES + c] += moved + walls[w, SHIFT + m]


@block_jit
def give_back(b, contacts, first, last, walls, w, adjoint, spare):  # pragma: no cover - jitted
    """Adjoint of :func:`gather`, from D_GAP, D_NORMAL, D_MOTION, D_SPIN and D_TOGETHER, into the particles' rows."""
    if w < 0:
        _pair_adjoint(b)
    else:
        _wall_adjoint(b, walls, w)
    for place in range(0, LANES, WIDTH):
        if w < 0:
            _return_pairs(adjoint, contacts, first, last, spare, b, place)
        else:
            _return_walls(adjoint, contacts, first, last, spare, b, place)


@block_jit
def _pair_adjoint(b):  # pragma: no cover - jitted
    """D_NORMAL becomes the adjoint of y_j − y_i, and D_MOTION gains it."""
    wide()
    for c in range(LANES):
        n, g = three(b, NORMAL, c), three(b, D_NORMAL, c)
        inverse = ONE / b[DISTANCE * LANES + c]
        radial = b[D_GAP * LANES + c] - dot(g, n) * inverse
        apart = plus(times(radial, n), inverse, g)
        store(b, D_NORMAL, c, apart)
        store(b, D_MOTION, c, both(apart, three(b, D_MOTION, c)))


@block_jit
def _wall_adjoint(b, walls, w):  # pragma: no cover - jitted
    """D_NORMAL becomes the adjoint of −y, and D_MOTION gains it.

    The distance has the gradient −n. The normal turns with y about the wall's axis by (n·o)/ρ, with o the way out from
    the axis and ρ the distance from it, and in the plane through the axis about a rim by −1/distance.
    """
    kind, d = walls[w, 0], (walls[w, 4], walls[w, 5], walls[w, 6])
    r0, s0, dr, ds = walls[w, 7], walls[w, 8], walls[w, 9] - walls[w, 7], walls[w, 10] - walls[w, 8]
    for c in range(LANES):
        n, g, y = three(b, NORMAL, c), three(b, D_MOTION, c), three(b, CENTER, c)
        distance = b[DISTANCE * LANES + c]
        # The adjoints of the touched point, of the distance and of the normal.
        c0 = walls[w, MATRIX] * g[0] + walls[w, MATRIX + 3] * g[1] + walls[w, MATRIX + 6] * g[2]
        c1 = walls[w, MATRIX + 1] * g[0] + walls[w, MATRIX + 4] * g[1] + walls[w, MATRIX + 7] * g[2]
        c2 = walls[w, MATRIX + 2] * g[0] + walls[w, MATRIX + 5] * g[1] + walls[w, MATRIX + 8] * g[2]
        closer = b[D_GAP * LANES + c] + n[0] * c0 + n[1] * c1 + n[2] * c2
        t = plus(three(b, D_NORMAL, c), distance, (c0, c1, c2))
        c0, c1, c2 = c0 - closer * n[0], c1 - closer * n[1], c2 - closer * n[2]
        if kind != PLANE:
            o = (y[0] - walls[w, 1], y[1] - walls[w, 2], y[2] - walls[w, 3])
            along = dot(o, d)
            across = less(o, along, d)
            reach = math.sqrt(dot(across, across))
            inverse = ONE / max(reach, TINY)
            out = times(inverse, across)
            f = cross(d, out)
            around = dot(n, out) * inverse * dot(f, t)
            c0, c1, c2 = c0 + around * f[0], c1 + around * f[1], c2 + around * f[2]
            share = (reach - r0) * dr + (along - s0) * ds
            if kind == REVOLUTION and not ZERO < share < dr * dr + ds * ds:
                e = cross(n, f)
                over = dot(e, t) / max(distance, TINY)
                c0, c1, c2 = c0 - over * e[0], c1 - over * e[1], c2 - over * e[2]
        store(b, D_NORMAL, c, (-c0, -c1, -c2))
        store(b, D_MOTION, c, (g[0] - c0, g[1] - c1, g[2] - c2))
