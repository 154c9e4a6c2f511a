"""The kinematics of a block's contacts from their particles' rows: normal, gap, relative motion; and its adjoint.

The rows of a block are those of :mod:`gran_bench.surrogate.kernels.contact_block`, which computes what they answer.
"""

from __future__ import annotations

import math

import numpy as np

from gran_bench.surrogate.kernels.contact_block import (
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

# A particle's row: end of the frame y, displacement D, spin q, channels h.
END, MOVE, TURNED, CHANNEL = 0, 3, 6, 9
STATE = CHANNEL + CHANNELS
ROW = 16  # one cache line


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
def gather_walls(b, near, first, last, offset, wall, state, sums, springs, radius):  # pragma: no cover - jitted
    """Rows of the wall contacts ``first`` to ``last``, which come after ``offset`` pairs in sums and springs."""
    x0, x1, x2, d0, d1, d2, size = wall[1], wall[2], wall[3], wall[4], wall[5], wall[6], wall[7]
    for c in range(LANES):
        p = min(first + c, last - 1)
        i = near[p]
        for m in range(3):
            b[(NORMAL + m) * LANES + c] = state[i, END + m]
            b[(MOTION + m) * LANES + c] = state[i, MOVE + m]
            b[(SPIN + m) * LANES + c] = state[i, TURNED + m]
            b[(SPRING + m) * LANES + c] = springs[offset + p, m]
        for m in range(CHANNELS):
            b[(TOGETHER + m) * LANES + c] = state[i, CHANNEL + m] + state[i, CHANNEL + m]
        b[SUM_A * LANES + c] = sums[0, offset + p]
        b[SUM_B * LANES + c] = sums[1, offset + p]
    is_cylinder = wall[0] > ZERO
    for c in range(LANES):
        y0, y1, y2 = b[NORMAL * LANES + c], b[(NORMAL + 1) * LANES + c], b[(NORMAL + 2) * LANES + c]
        along = (y0 - x0) * d0 + (y1 - x1) * d1 + (y2 - x2) * d2
        r0, r1, r2 = y0 - x0 - along * d0, y1 - x1 - along * d1, y2 - x2 - along * d2
        from_axis = math.sqrt(r0 * r0 + r1 * r1 + r2 * r2)
        inverse = ONE / max(from_axis, np.float32(1e-12))
        n0 = r0 * inverse if is_cylinder else -d0
        n1 = r1 * inverse if is_cylinder else -d1
        n2 = r2 * inverse if is_cylinder else -d2
        distance = size - from_axis if is_cylinder else along
        # The wall's point that the particle would touch moves by M c.
        c0, c1, c2 = y0 + distance * n0, y1 + distance * n1, y2 + distance * n2
        b[NORMAL * LANES + c], b[(NORMAL + 1) * LANES + c], b[(NORMAL + 2) * LANES + c] = n0, n1, n2
        b[MOTION * LANES + c] = wall[8] * c0 + wall[9] * c1 + wall[10] * c2 - b[MOTION * LANES + c]
        b[(MOTION + 1) * LANES + c] = wall[11] * c0 + wall[12] * c1 + wall[13] * c2 - b[(MOTION + 1) * LANES + c]
        b[(MOTION + 2) * LANES + c] = wall[14] * c0 + wall[15] * c1 + wall[16] * c2 - b[(MOTION + 2) * LANES + c]
        b[DISTANCE * LANES + c], b[GAP * LANES + c] = from_axis, distance - radius


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
def wall_geometry_adjoint(b, wall):  # pragma: no cover - jitted
    """D_NORMAL becomes the adjoint of y, from D_GAP, D_NORMAL and D_MOTION."""
    d0, d1, d2, size = wall[4], wall[5], wall[6], wall[7]
    is_cylinder = wall[0] > ZERO
    for c in range(LANES):
        g0, g1, g2 = b[D_MOTION * LANES + c], b[(D_MOTION + 1) * LANES + c], b[(D_MOTION + 2) * LANES + c]
        c0 = wall[8] * g0 + wall[11] * g1 + wall[14] * g2
        c1 = wall[9] * g0 + wall[12] * g1 + wall[15] * g2
        c2 = wall[10] * g0 + wall[13] * g1 + wall[16] * g2
        along = c0 * d0 + c1 * d1 + c2 * d2
        d_gap = b[D_GAP * LANES + c]
        if is_cylinder:  # the touched point is on the axis' side plus R n, and n turns with y
            n0, n1, n2 = b[NORMAL * LANES + c], b[(NORMAL + 1) * LANES + c], b[(NORMAL + 2) * LANES + c]
            t0 = b[D_NORMAL * LANES + c] + size * c0
            t1 = b[(D_NORMAL + 1) * LANES + c] + size * c1
            t2 = b[(D_NORMAL + 2) * LANES + c] + size * c2
            inverse = ONE / b[DISTANCE * LANES + c]
            radial, axial = t0 * n0 + t1 * n1 + t2 * n2, t0 * d0 + t1 * d1 + t2 * d2
            b[D_NORMAL * LANES + c] = along * d0 - d_gap * n0 + (t0 - radial * n0 - axial * d0) * inverse
            b[(D_NORMAL + 1) * LANES + c] = along * d1 - d_gap * n1 + (t1 - radial * n1 - axial * d1) * inverse
            b[(D_NORMAL + 2) * LANES + c] = along * d2 - d_gap * n2 + (t2 - radial * n2 - axial * d2) * inverse
        else:
            b[D_NORMAL * LANES + c] = c0 + (d_gap - along) * d0
            b[(D_NORMAL + 1) * LANES + c] = c1 + (d_gap - along) * d1
            b[(D_NORMAL + 2) * LANES + c] = c2 + (d_gap - along) * d2
