"""The adjoint of a frame's iterations, jitted: from the last back to the first, block by block.

Each iteration starts from what :mod:`gran_bench.surrogate.contact.kernels.iterations` kept, the particles' rows and the
contacts' sums; all else is computed again. Blocks are scattered in the same order as there.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gran_bench.surrogate.contact.kernels.block import (
    CHANNELS,
    D_ANSWER,
    D_EXTRA_PUSH,
    D_EXTRA_TURN,
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
    HALF,
    LANES,
    ONE,
    ROWS,
    ZERO,
    answer_adjoint,
    block_jit,
    look_adjoint,
    perceive_adjoint,
    row_sum,
)
from gran_bench.surrogate.contact.kernels.iterations import CHANNEL_CLAMP, SPIN_RESPONSE, respond
from gran_bench.surrogate.contact.kernels.kinematics import (
    gather_pairs,
    gather_walls,
    pair_geometry_adjoint,
    wall_geometry_adjoint,
)

EXTRA = 6 + CHANNELS  # in a row of adjoints (D, q, h, extra translation, extra spin)


@njit(nogil=True, error_model="numpy")
def _mix_adjoint(
    messages, adjoint, gravity, nearness, weight, bias, d_weight, d_bias, d_nearness
):  # pragma: no cover - jitted
    """Adjoint of :func:`contact_iterations.mix`; ``messages``: channels before it, ``adjoint``: the particles' rows."""
    held, d_held = np.empty(CHANNELS, np.float32), np.empty(CHANNELS, np.float32)
    for i in range(len(adjoint)):
        d_share = ZERO
        for m in range(3):
            d_share += adjoint[i, m] * gravity[0, m] + adjoint[i, 6 + CHANNELS + m] * gravity[1, m]
        d_whole = nearness[i] * d_share
        for m in range(CHANNELS):
            held[m] = min(max(messages[i, m], -CHANNEL_CLAMP), CHANNEL_CLAMP)
            d_held[m] = d_whole * weight[CHANNELS, m]
            d_weight[CHANNELS, m] += d_whole * held[m]
            d_nearness[i] += d_share * weight[CHANNELS, m] * held[m]
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
    """Adjoint of :func:`contact_iterations.respond`, the weights' and the sums' gradients included."""
    answer_adjoint(b, strength, share, slope)
    perceive_adjoint(b, w1, w2, d_w1, d_b1, d_w2, d_b2)
    look_adjoint(b)
    for c in range(last - first):
        d_sums[0, first + c], d_sums[1, first + c] = b[D_SUM_A * LANES + c], b[D_SUM_B * LANES + c]


@njit(nogil=True, error_model="numpy")
def iterate_adjoint(
    pairs, near, wall_start, walls, springs, limits, period, gravity, nearness,
    w1, b1, w2, b2, stiffness, spin_share, mix_weight, mix_bias, states, messages, sums, adjoint, d_position,
    d_nearness, d_w1, d_b1, d_w2, d_b2, d_stiffness, d_spin_share, d_mix_weight, d_mix_bias,
):  # fmt: skip  # pragma: no cover - jitted
    """Adjoint of :func:`contact_iterations.iterate`; ``adjoint`` is its seed and its result.

    A row of it is (D, q, h, extra translation, extra spin). The extra parts are only ever added to, so their adjoint
    stays what it was seeded with. ``d_nearness`` is what the particles' nearness gets.
    """
    iterations, pair_count = len(w1), len(pairs)
    b = np.zeros(ROWS * LANES, np.float32)
    before = np.empty_like(adjoint)
    d_sums = np.zeros(sums.shape[1:], np.float32)
    diameter = limits[4]
    for k in range(iterations - 1, -1, -1):
        now, running = states[k], sums[k]
        d_mixing = d_mix_weight[k], d_mix_bias[k]
        _mix_adjoint(messages[k], adjoint, gravity, nearness, mix_weight[k], mix_bias[k], *d_mixing, d_nearness)
        before[:] = adjoint
        slope, reach = ONE / limits[1], limits[0]
        u1, c1, u2, c2 = w1[k, 0], b1[k, 0], w2[k, 0], b2[k, 0]
        d_u1, d_c1, d_u2, d_c2 = d_w1[k, 0], d_b1[k, 0], d_w2[k, 0], d_b2[k, 0]
        for first in range(0, pair_count, LANES):
            last = min(first + LANES, pair_count)
            strength, share = stiffness[k, 0], spin_share[k, 0]
            gather_pairs(b, pairs, first, last, now, running, springs, diameter, period)
            respond(b, slope, reach, strength, share, u1, c1, u2, c2)
            _seed_pairs(b, pairs, before, d_sums, first, last)
            _respond_adjoint(b, slope, strength, share, u1, u2, d_u1, d_c1, d_u2, d_c2, d_sums, first, last)
            d_stiffness[k, 0] += row_sum(b, D_STIFFNESS)
            d_spin_share[k, 0] += row_sum(b, D_SHARE)
            pair_geometry_adjoint(b)
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
                gather_walls(b, near, first, last, pair_count, walls, w, now, running, springs, HALF * diameter)
                respond(b, slope, reach, strength, share, u1, c1, u2, c2)
                _seed_walls(b, near, pair_count, before, d_sums, first, last)
                low, high = pair_count + first, pair_count + last
                _respond_adjoint(b, slope, strength, share, u1, u2, d_u1, d_c1, d_u2, d_c2, d_sums, low, high)
                pushed = row_sum(b, D_STIFFNESS)
                d_stiffness[k, 1] += pushed + pushed
                d_spin_share[k, 1] += row_sum(b, D_SHARE)
                wall_geometry_adjoint(b, near, first, last, walls, w, now)
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
