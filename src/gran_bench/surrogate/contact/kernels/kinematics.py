"""The kinematics of a block's contacts from their particles' rows: normal, gap, relative motion; and its adjoint.

The rows of a block are those of :mod:`gran_bench.surrogate.contact.kernels.block`, which computes what they answer.
"""

from __future__ import annotations

import math

import numpy as np

from gran_bench.dem.fast.wall_list import shape_of, toward_wall
from gran_bench.dem.walls import PLANE, REVOLUTION
from gran_bench.surrogate.contact.kernels.block import (
    CHANNELS,
    D_GAP,
    D_MOTION,
    D_NORMAL,
    DISTANCE,
    GAP,
    HALF,
    LANES,
    MOTION,
    NORMAL,
    ONE,
    SPIN,
    SPRING,
    SUM_A,
    SUM_B,
    TOGETHER,
    ZERO,
    block_jit,
)
from gran_bench.surrogate.walls import SHAPE

# A particle's row: end of the frame y, displacement D, spin q, channels h.
END, MOVE, TURNED, CHANNEL = 0, 3, 6, 9
STATE = CHANNEL + CHANNELS
ROW = 16  # one cache line
# A wall's row: its shape, then M row by row and t, which move its point c by M c + t.
TURN, SHIFT = SHAPE, SHAPE + 9
SMALLEST = np.float32(1e-12)  # mm; keeps a division by a distance finite


@block_jit
def gather_pairs(b, pairs, first, last, state, sums, springs, diameter, period):  # pragma: no cover - jitted
    """Rows of the pairs ``first`` to ``last``; lanes beyond repeat the last pair."""
    for c in range(LANES):
        p = min(first + c, last - 1)
        i, j = pairs[p, 0], pairs[p, 1]
        for m in range(3):
            b[(NORMAL + m) * LANES + c] = state[j, END + m] - state[i, END + m]
            b[(MOTION + m) * LANES + c] = state[j, MOVE + m] - state[i, MOVE + m]
            b[(SPIN + m) * LANES + c] = state[i, TURNED + m] + state[j, TURNED + m]
            b[(SPRING + m) * LANES + c] = springs[p, m]
        for m in range(CHANNELS):
            b[(TOGETHER + m) * LANES + c] = state[i, CHANNEL + m] + state[j, CHANNEL + m]
        b[SUM_A * LANES + c] = sums[0, p]
        b[SUM_B * LANES + c] = sums[1, p]
    if period > ZERO:
        for c in range(LANES):
            along = b[(NORMAL + 1) * LANES + c]
            b[(NORMAL + 1) * LANES + c] = along - period * math.floor(along / period + HALF)
    for c in range(LANES):
        e0, e1, e2 = b[NORMAL * LANES + c], b[(NORMAL + 1) * LANES + c], b[(NORMAL + 2) * LANES + c]
        distance = math.sqrt(e0 * e0 + e1 * e1 + e2 * e2)
        inverse = ONE / distance
        b[NORMAL * LANES + c], b[(NORMAL + 1) * LANES + c] = e0 * inverse, e1 * inverse
        b[(NORMAL + 2) * LANES + c] = e2 * inverse
        b[DISTANCE * LANES + c], b[GAP * LANES + c] = distance, distance - diameter


@block_jit
def gather_walls(b, near, first, last, offset, walls, w, state, sums, springs, radius):  # pragma: no cover - jitted
    """Rows of the wall contacts ``first`` to ``last``, which come after ``offset`` pairs in sums and springs."""
    shape = shape_of(walls, w)
    for c in range(LANES):
        p = min(first + c, last - 1)
        i = near[p]
        y0, y1, y2 = state[i, END], state[i, END + 1], state[i, END + 2]
        distance, n0, n1, n2 = toward_wall(shape, y0, y1, y2)
        # The wall's point that the particle would touch.
        c0, c1, c2 = y0 + distance * n0, y1 + distance * n1, y2 + distance * n2
        b[NORMAL * LANES + c], b[(NORMAL + 1) * LANES + c], b[(NORMAL + 2) * LANES + c] = n0, n1, n2
        b[DISTANCE * LANES + c], b[GAP * LANES + c] = distance, distance - radius
        for m in range(3):
            moved = walls[w, TURN + 3 * m] * c0 + walls[w, TURN + 3 * m + 1] * c1 + walls[w, TURN + 3 * m + 2] * c2
            b[(MOTION + m) * LANES + c] = moved + walls[w, SHIFT + m] - state[i, MOVE + m]
            b[(SPIN + m) * LANES + c] = state[i, TURNED + m]
            b[(SPRING + m) * LANES + c] = springs[offset + p, m]
        for m in range(CHANNELS):
            b[(TOGETHER + m) * LANES + c] = state[i, CHANNEL + m] + state[i, CHANNEL + m]
        b[SUM_A * LANES + c] = sums[0, offset + p]
        b[SUM_B * LANES + c] = sums[1, offset + p]


@block_jit
def pair_geometry_adjoint(b):  # pragma: no cover - jitted
    """D_NORMAL becomes the adjoint of y_j − y_i, from D_GAP and D_NORMAL."""
    for c in range(LANES):
        n0, n1, n2 = b[NORMAL * LANES + c], b[(NORMAL + 1) * LANES + c], b[(NORMAL + 2) * LANES + c]
        g0, g1, g2 = b[D_NORMAL * LANES + c], b[(D_NORMAL + 1) * LANES + c], b[(D_NORMAL + 2) * LANES + c]
        inverse = ONE / b[DISTANCE * LANES + c]
        radial = b[D_GAP * LANES + c] - (g0 * n0 + g1 * n1 + g2 * n2) * inverse
        b[D_NORMAL * LANES + c] = radial * n0 + g0 * inverse
        b[(D_NORMAL + 1) * LANES + c] = radial * n1 + g1 * inverse
        b[(D_NORMAL + 2) * LANES + c] = radial * n2 + g2 * inverse


@block_jit
def wall_geometry_adjoint(b, near, first, last, walls, w, state):  # pragma: no cover - jitted
    """D_NORMAL becomes the adjoint of y, from D_GAP, D_NORMAL and D_MOTION.

    The distance has the gradient −n. The normal turns with y about the wall's axis by (n·o)/ρ, with o the way out from
    the axis and ρ the distance from it, and in the plane through the axis about a rim by −1/distance.
    """
    kind = walls[w, 0]
    d0, d1, d2 = walls[w, 4], walls[w, 5], walls[w, 6]
    r0, s0, dr, ds = walls[w, 7], walls[w, 8], walls[w, 9] - walls[w, 7], walls[w, 10] - walls[w, 8]
    for c in range(LANES):
        i = near[min(first + c, last - 1)]
        n0, n1, n2 = b[NORMAL * LANES + c], b[(NORMAL + 1) * LANES + c], b[(NORMAL + 2) * LANES + c]
        g0, g1, g2 = b[D_MOTION * LANES + c], b[(D_MOTION + 1) * LANES + c], b[(D_MOTION + 2) * LANES + c]
        distance = b[DISTANCE * LANES + c]
        # The adjoints of the touched point, of the distance and of the normal.
        c0 = walls[w, TURN] * g0 + walls[w, TURN + 3] * g1 + walls[w, TURN + 6] * g2
        c1 = walls[w, TURN + 1] * g0 + walls[w, TURN + 4] * g1 + walls[w, TURN + 7] * g2
        c2 = walls[w, TURN + 2] * g0 + walls[w, TURN + 5] * g1 + walls[w, TURN + 8] * g2
        closer = b[D_GAP * LANES + c] + n0 * c0 + n1 * c1 + n2 * c2
        t0 = b[D_NORMAL * LANES + c] + distance * c0
        t1 = b[(D_NORMAL + 1) * LANES + c] + distance * c1
        t2 = b[(D_NORMAL + 2) * LANES + c] + distance * c2
        c0, c1, c2 = c0 - closer * n0, c1 - closer * n1, c2 - closer * n2
        if kind != PLANE:
            o0, o1, o2 = (
                state[i, END] - walls[w, 1],
                state[i, END + 1] - walls[w, 2],
                state[i, END + 2] - walls[w, 3],
            )
            along = o0 * d0 + o1 * d1 + o2 * d2
            o0, o1, o2 = o0 - along * d0, o1 - along * d1, o2 - along * d2
            reach = math.sqrt(o0 * o0 + o1 * o1 + o2 * o2)
            inverse = ONE / max(reach, SMALLEST)
            o0, o1, o2 = o0 * inverse, o1 * inverse, o2 * inverse
            f0, f1, f2 = d1 * o2 - d2 * o1, d2 * o0 - d0 * o2, d0 * o1 - d1 * o0
            around = (n0 * o0 + n1 * o1 + n2 * o2) * inverse * (f0 * t0 + f1 * t1 + f2 * t2)
            c0, c1, c2 = c0 + around * f0, c1 + around * f1, c2 + around * f2
            share = (reach - r0) * dr + (along - s0) * ds
            if kind == REVOLUTION and not ZERO < share < dr * dr + ds * ds:
                e0, e1, e2 = n1 * f2 - n2 * f1, n2 * f0 - n0 * f2, n0 * f1 - n1 * f0
                over = (e0 * t0 + e1 * t1 + e2 * t2) / max(distance, SMALLEST)
                c0, c1, c2 = c0 - over * e0, c1 - over * e1, c2 - over * e2
        b[D_NORMAL * LANES + c], b[(D_NORMAL + 1) * LANES + c], b[(D_NORMAL + 2) * LANES + c] = c0, c1, c2
