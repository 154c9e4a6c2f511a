"""A frame of the contact network, jitted: contacts gathered into blocks, computed in SIMD, scattered; and its adjoint.

Contacts are scattered in order, so that a result does not depend on the machine's load. The forward pass keeps the
particles' rows and the contacts' sums at the start of each iteration; the adjoint computes everything else again. The
interpreter lock is released.
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path

import numpy as np
from numba import njit

from gran_bench.surrogate import contact_solver
from gran_bench.surrogate.kernels import contact_block
from gran_bench.surrogate.kernels.contact_block import (
    ANSWER,
    CHANNELS,
    D_ANSWER,
    D_EXTRA_PUSH,
    D_EXTRA_TURN,
    D_GAP,
    D_MOTION,
    D_NORMAL,
    D_PUSH,
    D_SHARE,
    D_SPIN,
    D_STIFFNESS,
    D_SUM_A,
    D_SUM_B,
    D_TOGETHER,
    D_TURN,
    DISTANCE,
    EXTRA_PUSH,
    EXTRA_TURN,
    GAP,
    HALF,
    LANES,
    MOTION,
    NORMAL,
    ONE,
    PUSH,
    ROWS,
    SPIN,
    SPRING,
    SUM_A,
    SUM_B,
    TOGETHER,
    TURN,
    ZERO,
    answer,
    answer_adjoint,
    block_jit,
    look,
    look_adjoint,
    perceive,
    perceive_adjoint,
    row_sum,
    surfaces,
)

# A particle's row: end of the frame y, displacement D, spin q, channels h.
END, MOVE, TURNED, CHANNEL = 0, 3, 6, 9
STATE = CHANNEL + CHANNELS
ROW = 16  # one cache line
EXTRA = 6 + CHANNELS  # in a row of adjoints (D, q, h, extra translation, extra spin)
SPIN_RESPONSE = np.float32(contact_solver.SPIN_RESPONSE)
CHANNEL_CLAMP = np.float32(contact_solver.CHANNEL_CLAMP)


@block_jit
def _gather_pairs(b, pairs, first, last, state, sums, springs, diameter, period):  # pragma: no cover - jitted
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
def _gather_walls(b, near, first, last, offset, wall, state, sums, springs, radius):  # pragma: no cover - jitted
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
def _pair_geometry_adjoint(b):  # pragma: no cover - jitted
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
def _wall_geometry_adjoint(b, wall):  # pragma: no cover - jitted
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


@block_jit
def _respond(b, slope, reach, strength, share, w1, b1, w2, b2):  # pragma: no cover - jitted
    """All of a block's answers from its gathered rows."""
    surfaces(b)
    look(b, reach, slope)
    perceive(b, w1, b1, w2, b2)
    answer(b, strength, share)


@njit(nogil=True, error_model="numpy")
def _forward(
    pairs, near, wall_start, walls, springs, limits, period, gravity, position, guess, spin,
    w1, b1, w2, b2, stiffness, spin_share, mix_weight, mix_bias, states, messages, sums, outcome,
):  # fmt: skip  # pragma: no cover - jitted
    """All iterations; ``states`` and ``sums`` keep what each started from, ``messages`` the channels before mixing.

    They have room for every iteration where a gradient is wanted, and for one elsewhere.
    """
    count, iterations, pair_count = len(position), len(w1), len(pairs)
    keeps = len(states) > 1
    b = np.zeros(ROWS * LANES, np.float32)
    now, gain = np.zeros((count, ROW), np.float32), np.zeros((count, ROW), np.float32)
    extra = np.zeros((count, 6), np.float32)
    running = np.zeros(sums.shape[1:], np.float32)
    now[:, MOVE : MOVE + 3], now[:, TURNED : TURNED + 3] = guess, spin
    for k in range(iterations):
        for i in range(count):
            for m in range(3):
                now[i, END + m] = position[i, m] + now[i, MOVE + m]
        slot = k if keeps else 0
        states[slot], sums[slot] = now, running
        gain[:] = ZERO
        slope, reach, diameter = ONE / limits[1], limits[0], limits[4]
        u1, c1, u2, c2 = w1[k, 0], b1[k, 0], w2[k, 0], b2[k, 0]
        for first in range(0, pair_count, LANES):
            last = min(first + LANES, pair_count)
            _gather_pairs(b, pairs, first, last, now, running, springs, diameter, period)
            _respond(b, slope, reach, stiffness[k, 0], spin_share[k, 0], u1, c1, u2, c2)
            for c in range(last - first):
                i, j = pairs[first + c, 0], pairs[first + c, 1]
                for m in range(3):
                    push, turn = HALF * b[(PUSH + m) * LANES + c], SPIN_RESPONSE * b[(TURN + m) * LANES + c]
                    gain[i, MOVE + m] += push
                    gain[j, MOVE + m] -= push
                    gain[i, TURNED + m] += turn
                    gain[j, TURNED + m] += turn
                    push = HALF * b[(EXTRA_PUSH + m) * LANES + c]
                    turn = SPIN_RESPONSE * b[(EXTRA_TURN + m) * LANES + c]
                    extra[i, m] += push
                    extra[j, m] -= push
                    extra[i, 3 + m] += turn
                    extra[j, 3 + m] += turn
                for m in range(CHANNELS):
                    message = b[(ANSWER + 3 + m) * LANES + c]
                    gain[i, CHANNEL + m] += message
                    gain[j, CHANNEL + m] += message
                running[0, first + c] += b[ANSWER * LANES + c]
                running[1, first + c] += b[(ANSWER + 1) * LANES + c]
        slope, reach = ONE / limits[3], limits[2]
        u1, c1, u2, c2 = w1[k, 1], b1[k, 1], w2[k, 1], b2[k, 1]
        for w in range(len(walls)):
            for first in range(wall_start[w], wall_start[w + 1], LANES):
                last = min(first + LANES, wall_start[w + 1])
                _gather_walls(b, near, first, last, pair_count, walls[w], now, running, springs, HALF * diameter)
                strength = stiffness[k, 1] + stiffness[k, 1]
                _respond(b, slope, reach, strength, spin_share[k, 1], u1, c1, u2, c2)
                for c in range(last - first):
                    i = near[first + c]
                    for m in range(3):
                        gain[i, MOVE + m] += HALF * b[(PUSH + m) * LANES + c]
                        gain[i, TURNED + m] += SPIN_RESPONSE * b[(TURN + m) * LANES + c]
                        extra[i, m] += HALF * b[(EXTRA_PUSH + m) * LANES + c]
                        extra[i, 3 + m] += SPIN_RESPONSE * b[(EXTRA_TURN + m) * LANES + c]
                    for m in range(CHANNELS):
                        gain[i, CHANNEL + m] += b[(ANSWER + 3 + m) * LANES + c]
                    running[0, pair_count + first + c] += b[ANSWER * LANES + c]
                    running[1, pair_count + first + c] += b[(ANSWER + 1) * LANES + c]
        for i in range(count):
            for m in range(MOVE, STATE):
                now[i, m] += gain[i, m]
            for m in range(CHANNELS):
                messages[slot, i, m] = now[i, CHANNEL + m]
        _mix(now, extra, gravity, mix_weight[k], mix_bias[k])
    for i in range(count):
        for m in range(3):
            outcome[0, i, m], outcome[1, i, m] = now[i, MOVE + m], now[i, TURNED + m]
            outcome[2, i, m], outcome[3, i, m] = extra[i, m], extra[i, 3 + m]


@njit(nogil=True, error_model="numpy")
def _mix(now, extra, gravity, weight, bias):  # pragma: no cover - jitted
    """Gravity taken back and channels mixed, for all particles; ``gravity``: what D takes, what the velocity more."""
    held = np.empty(CHANNELS, np.float32)
    for i in range(len(now)):
        share = ZERO
        for m in range(CHANNELS):
            held[m] = min(max(now[i, CHANNEL + m], -CHANNEL_CLAMP), CHANNEL_CLAMP)
            share += weight[CHANNELS, m] * held[m]
        for m in range(3):
            now[i, MOVE + m] += share * gravity[0, m]
            extra[i, m] += share * gravity[1, m]
        for out in range(CHANNELS):
            mixed = bias[out]
            for m in range(CHANNELS):
                mixed += weight[out, m] * held[m]
            now[i, CHANNEL + out] += HALF * max(mixed, ZERO)


@njit(nogil=True, error_model="numpy")
def _mix_adjoint(messages, adjoint, gravity, weight, bias, d_weight, d_bias):  # pragma: no cover - jitted
    """Adjoint of :func:`_mix`; ``messages`` are the channels before it, ``adjoint`` the particles' rows."""
    held, d_held = np.empty(CHANNELS, np.float32), np.empty(CHANNELS, np.float32)
    for i in range(len(adjoint)):
        d_share = ZERO
        for m in range(3):
            d_share += adjoint[i, m] * gravity[0, m] + adjoint[i, 6 + CHANNELS + m] * gravity[1, m]
        for m in range(CHANNELS):
            held[m] = min(max(messages[i, m], -CHANNEL_CLAMP), CHANNEL_CLAMP)
            d_held[m] = d_share * weight[CHANNELS, m]
            d_weight[CHANNELS, m] += d_share * held[m]
        for out in range(CHANNELS):
            mixed = bias[out]
            for m in range(CHANNELS):
                mixed += weight[out, m] * held[m]
            if mixed > ZERO:
                d_mixed = HALF * adjoint[i, 6 + out]
                d_bias[out] += d_mixed
                for m in range(CHANNELS):
                    d_weight[out, m] += d_mixed * held[m]
                    d_held[m] += d_mixed * weight[out, m]
        for m in range(CHANNELS):
            if abs(messages[i, m]) <= CHANNEL_CLAMP:
                adjoint[i, 6 + m] += d_held[m]


@block_jit
def _seed_pairs(b, pairs, adjoint, d_sums, first, last):  # pragma: no cover - jitted
    """What the adjoints of particles and sums ask of a block of pairs; lanes beyond ``last`` get nothing."""
    for c in range(LANES):
        p = min(first + c, last - 1)
        i, j = pairs[p, 0], pairs[p, 1]
        half = HALF if first + c < last else ZERO
        both, spin = half + half, (half + half) * SPIN_RESPONSE
        for m in range(3):
            b[(D_PUSH + m) * LANES + c] = half * (adjoint[i, m] - adjoint[j, m])
            b[(D_TURN + m) * LANES + c] = spin * (adjoint[i, 3 + m] + adjoint[j, 3 + m])
            b[(D_EXTRA_PUSH + m) * LANES + c] = half * (adjoint[i, EXTRA + m] - adjoint[j, EXTRA + m])
            b[(D_EXTRA_TURN + m) * LANES + c] = spin * (adjoint[i, EXTRA + 3 + m] + adjoint[j, EXTRA + 3 + m])
        for m in range(CHANNELS):
            b[(D_ANSWER + 3 + m) * LANES + c] = both * (adjoint[i, 6 + m] + adjoint[j, 6 + m])
        b[D_SUM_A * LANES + c], b[D_SUM_B * LANES + c] = both * d_sums[0, p], both * d_sums[1, p]


@block_jit
def _seed_walls(b, near, offset, adjoint, d_sums, first, last):  # pragma: no cover - jitted
    """The same for a block of wall contacts, which come after ``offset`` pairs in ``d_sums``."""
    for c in range(LANES):
        p = min(first + c, last - 1)
        i = near[p]
        half = HALF if first + c < last else ZERO
        both, spin = half + half, (half + half) * SPIN_RESPONSE
        for m in range(3):
            b[(D_PUSH + m) * LANES + c] = half * adjoint[i, m]
            b[(D_TURN + m) * LANES + c] = spin * adjoint[i, 3 + m]
            b[(D_EXTRA_PUSH + m) * LANES + c] = half * adjoint[i, EXTRA + m]
            b[(D_EXTRA_TURN + m) * LANES + c] = spin * adjoint[i, EXTRA + 3 + m]
        for m in range(CHANNELS):
            b[(D_ANSWER + 3 + m) * LANES + c] = both * adjoint[i, 6 + m]
        b[D_SUM_A * LANES + c] = both * d_sums[0, offset + p]
        b[D_SUM_B * LANES + c] = both * d_sums[1, offset + p]


@block_jit
def _respond_adjoint(
    b, slope, strength, share, w1, w2, d_w1, d_b1, d_w2, d_b2, d_sums, first, last
):  # pragma: no cover - jitted
    """Adjoint of :func:`_respond`, the weights' and the sums' gradients included."""
    answer_adjoint(b, strength, share, slope)
    perceive_adjoint(b, w1, w2, d_w1, d_b1, d_w2, d_b2)
    look_adjoint(b)
    for c in range(last - first):
        d_sums[0, first + c], d_sums[1, first + c] = b[D_SUM_A * LANES + c], b[D_SUM_B * LANES + c]


@njit(nogil=True, error_model="numpy")
def _adjoint(
    pairs, near, wall_start, walls, springs, limits, period, gravity,
    w1, b1, w2, b2, stiffness, spin_share, mix_weight, mix_bias, states, messages, sums, adjoint, d_position,
    d_w1, d_b1, d_w2, d_b2, d_stiffness, d_spin_share, d_mix_weight, d_mix_bias,
):  # fmt: skip  # pragma: no cover - jitted
    """Adjoint of :func:`_forward`; ``adjoint`` is its seed and its result.

    A row of it is (D, q, h, extra translation, extra spin). The extra parts are only ever added to, so their adjoint
    stays what it was seeded with.
    """
    iterations, pair_count = len(w1), len(pairs)
    b = np.zeros(ROWS * LANES, np.float32)
    before = np.empty_like(adjoint)
    d_sums = np.zeros(sums.shape[1:], np.float32)
    diameter = limits[4]
    for k in range(iterations - 1, -1, -1):
        now, running = states[k], sums[k]
        _mix_adjoint(messages[k], adjoint, gravity, mix_weight[k], mix_bias[k], d_mix_weight[k], d_mix_bias[k])
        before[:] = adjoint
        slope, reach = ONE / limits[1], limits[0]
        u1, c1, u2, c2 = w1[k, 0], b1[k, 0], w2[k, 0], b2[k, 0]
        d_u1, d_c1, d_u2, d_c2 = d_w1[k, 0], d_b1[k, 0], d_w2[k, 0], d_b2[k, 0]
        for first in range(0, pair_count, LANES):
            last = min(first + LANES, pair_count)
            strength, share = stiffness[k, 0], spin_share[k, 0]
            _gather_pairs(b, pairs, first, last, now, running, springs, diameter, period)
            _respond(b, slope, reach, strength, share, u1, c1, u2, c2)
            _seed_pairs(b, pairs, before, d_sums, first, last)
            _respond_adjoint(b, slope, strength, share, u1, u2, d_u1, d_c1, d_u2, d_c2, d_sums, first, last)
            d_stiffness[k, 0] += row_sum(b, D_STIFFNESS)
            d_spin_share[k, 0] += row_sum(b, D_SHARE)
            _pair_geometry_adjoint(b)
            for c in range(last - first):
                i, j = pairs[first + c, 0], pairs[first + c, 1]
                for m in range(3):
                    place, turn = b[(D_NORMAL + m) * LANES + c], b[(D_SPIN + m) * LANES + c]
                    move = place + b[(D_MOTION + m) * LANES + c]
                    adjoint[i, m] -= move
                    adjoint[j, m] += move
                    adjoint[i, 3 + m] += turn
                    adjoint[j, 3 + m] += turn
                    d_position[i, m] -= place
                    d_position[j, m] += place
                for m in range(CHANNELS):
                    channel = b[(D_TOGETHER + m) * LANES + c]
                    adjoint[i, 6 + m] += channel
                    adjoint[j, 6 + m] += channel
        slope, reach = ONE / limits[3], limits[2]
        u1, c1, u2, c2 = w1[k, 1], b1[k, 1], w2[k, 1], b2[k, 1]
        d_u1, d_c1, d_u2, d_c2 = d_w1[k, 1], d_b1[k, 1], d_w2[k, 1], d_b2[k, 1]
        for w in range(len(walls)):
            for first in range(wall_start[w], wall_start[w + 1], LANES):
                last = min(first + LANES, wall_start[w + 1])
                strength, share = stiffness[k, 1] + stiffness[k, 1], spin_share[k, 1]
                _gather_walls(b, near, first, last, pair_count, walls[w], now, running, springs, HALF * diameter)
                _respond(b, slope, reach, strength, share, u1, c1, u2, c2)
                _seed_walls(b, near, pair_count, before, d_sums, first, last)
                low, high = pair_count + first, pair_count + last
                _respond_adjoint(b, slope, strength, share, u1, u2, d_u1, d_c1, d_u2, d_c2, d_sums, low, high)
                pushed = row_sum(b, D_STIFFNESS)
                d_stiffness[k, 1] += pushed + pushed
                d_spin_share[k, 1] += row_sum(b, D_SHARE)
                _wall_geometry_adjoint(b, walls[w])
                for c in range(last - first):
                    i = near[first + c]
                    for m in range(3):
                        place = b[(D_NORMAL + m) * LANES + c]
                        adjoint[i, m] += place - b[(D_MOTION + m) * LANES + c]
                        adjoint[i, 3 + m] += b[(D_SPIN + m) * LANES + c]
                        d_position[i, m] += place
                    for m in range(CHANNELS):
                        channel = b[(D_TOGETHER + m) * LANES + c]
                        adjoint[i, 6 + m] += channel + channel


def _keyed_entries(sources: str):
    """The two entries, cached on disk under the digest of everything that they are compiled from.

    Numba keys its cache by the file of the function alone, and a change of another file would go unnoticed. The
    variables of a closure are part of the key.
    """

    @njit(cache=True, nogil=True, error_model="numpy")
    def forward(*arguments):  # pragma: no cover - jitted
        sources  # noqa: B018 (the key)
        _forward(*arguments)

    @njit(cache=True, nogil=True, error_model="numpy")
    def adjoint(*arguments):  # pragma: no cover - jitted
        sources  # noqa: B018 (the key)
        _adjoint(*arguments)

    return forward, adjoint


def _digest_of_sources() -> str:
    files = (__file__, contact_block.__file__, contact_solver.__file__)
    return hashlib.sha256(b"".join(Path(file).read_bytes() for file in files)).hexdigest()


frame_forward, frame_adjoint = _keyed_entries(_digest_of_sources())
