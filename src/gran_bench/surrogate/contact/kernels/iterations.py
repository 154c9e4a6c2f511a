"""A frame's iterations, jitted: contacts gathered into blocks, computed in SIMD, scattered; then channels are mixed.

Contacts are scattered in order, so that a result does not depend on the machine's load. The particles' rows and the
contacts' sums at the start of each iteration are kept, for :mod:`gran_bench.surrogate.contact.kernels.adjoint`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gran_bench.surrogate.contact import constants
from gran_bench.surrogate.contact.kernels.block import (
    ANSWER,
    CHANNELS,
    EXTRA_PUSH,
    EXTRA_TURN,
    HALF,
    LANES,
    ONE,
    PUSH,
    ROWS,
    TURN,
    ZERO,
    answer,
    block_jit,
    look,
    perceive,
    surfaces,
)
from gran_bench.surrogate.contact.kernels.kinematics import (
    CHANNEL,
    END,
    MOVE,
    ROW,
    STATE,
    TURNED,
    gather_pairs,
    gather_walls,
)

SPIN_RESPONSE = np.float32(constants.SPIN_RESPONSE)
CHANNEL_CLAMP = np.float32(constants.CHANNEL_CLAMP)


@block_jit
def respond(b, slope, reach, strength, share, w1, b1, w2, b2):  # pragma: no cover - jitted
    """All of a block's answers from its gathered rows."""
    surfaces(b)
    look(b, reach, slope)
    perceive(b, w1, b1, w2, b2)
    answer(b, strength, share)


@njit(nogil=True, error_model="numpy")
def iterate(
    pairs, near, wall_start, walls, springs, limits, period, gravity, position, guess, spin, nearness,
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
            gather_pairs(b, pairs, first, last, now, running, springs, diameter, period)
            respond(b, slope, reach, stiffness[k, 0], spin_share[k, 0], u1, c1, u2, c2)
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
                gather_walls(b, near, first, last, pair_count, walls, w, now, running, springs, HALF * diameter)
                strength = stiffness[k, 1] + stiffness[k, 1]
                respond(b, slope, reach, strength, spin_share[k, 1], u1, c1, u2, c2)
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
        mix(now, extra, gravity, nearness, mix_weight[k], mix_bias[k])
    for i in range(count):
        for m in range(3):
            outcome[0, i, m], outcome[1, i, m] = now[i, MOVE + m], now[i, TURNED + m]
            outcome[2, i, m], outcome[3, i, m] = extra[i, m], extra[i, 3 + m]


@njit(nogil=True, error_model="numpy")
def mix(now, extra, gravity, nearness, weight, bias):  # pragma: no cover - jitted
    """Gravity taken back and channels mixed, for all particles.

    Args:
        gravity: ``(2, 3)`` what D takes of it, and what the velocity takes more.
        nearness: ``(N,)`` share that a particle may take; 0 without a contact.
    """
    held = np.empty(CHANNELS, np.float32)
    for i in range(len(now)):
        share = ZERO
        for m in range(CHANNELS):
            held[m] = min(max(now[i, CHANNEL + m], -CHANNEL_CLAMP), CHANNEL_CLAMP)
            share += weight[CHANNELS, m] * held[m]
        share *= nearness[i]
        for m in range(3):
            now[i, MOVE + m] += share * gravity[0, m]
            extra[i, m] += share * gravity[1, m]
        for out in range(CHANNELS):
            mixed = bias[out]
            for m in range(CHANNELS):
                mixed += weight[out, m] * held[m]
            now[i, CHANNEL + out] += HALF * max(mixed, ZERO)
