"""What particles do between two rounds of their contacts, in blocks of particles: gravity taken back, channels mixed.

A particle's row is D, q, its channels h, and what acts on the velocity alone (translation, spin). Its adjoint has the
same columns.
"""

import numpy as np

from gran_bench.surrogate.contact import constants
from gran_bench.surrogate.contact.constants import CHANNELS
from gran_bench.surrogate.contact.kernels.block import HALF, ZERO, block_jit, row_sum
from gran_bench.surrogate.contact.kernels.lanes import LANES, WIDTH, columns_of, rows_of, wide

CHANNEL_CLAMP = np.float32(constants.CHANNEL_CLAMP)

MOVE, TURNED, CHANNEL, EXTRA = 0, 3, 6, 6 + CHANNELS  # columns of a particle's row

# Rows of a block of particles.
OWN, OTHER = 0, WIDTH
HELD = OTHER + WIDTH  # clamped channels
MESSAGE = HELD + CHANNELS  # channels before they are mixed
D_HELD = MESSAGE + CHANNELS
D_MIXED = D_HELD + CHANNELS
NEAR, D_SHARE, D_NEAR = D_MIXED + CHANNELS, D_MIXED + CHANNELS + 1, D_MIXED + CHANNELS + 2
D_WEIGHT = D_NEAR + 1  # sums over particles, a lane each: of the weights, row by row, then of the biases
ROWS = D_WEIGHT + (CHANNELS + 1) * (CHANNELS + 1)


@block_jit
def _held(p):  # pragma: no cover - jitted
    """HELD from MESSAGE."""
    wide()
    for m in range(CHANNELS):
        for c in range(LANES):
            p[(HELD + m) * LANES + c] = min(max(p[(MESSAGE + m) * LANES + c], -CHANNEL_CLAMP), CHANNEL_CLAMP)


@block_jit
def _take_back(p, gravity, weight):  # pragma: no cover - jitted
    """Gravity taken back, ``(2, 3)`` in D and in what acts on the velocity alone."""
    wide()
    g0, g1, g2 = gravity[0, 0], gravity[0, 1], gravity[0, 2]
    e0, e1, e2 = gravity[1, 0], gravity[1, 1], gravity[1, 2]
    w0, w1, w2, w3 = weight[CHANNELS, 0], weight[CHANNELS, 1], weight[CHANNELS, 2], weight[CHANNELS, 3]
    for c in range(LANES):
        share = w0 * p[HELD * LANES + c] + w1 * p[(HELD + 1) * LANES + c]
        share += w2 * p[(HELD + 2) * LANES + c] + w3 * p[(HELD + 3) * LANES + c]
        share *= p[NEAR * LANES + c]
        p[MOVE * LANES + c] += share * g0
        p[(MOVE + 1) * LANES + c] += share * g1
        p[(MOVE + 2) * LANES + c] += share * g2
        p[EXTRA * LANES + c] += share * e0
        p[(EXTRA + 1) * LANES + c] += share * e1
        p[(EXTRA + 2) * LANES + c] += share * e2


@block_jit
def _mixed(p, weight, bias, c):  # pragma: no cover - jitted
    total = bias
    for m in range(CHANNELS):
        total += weight[m] * p[(HELD + m) * LANES + c]
    return total


@block_jit
def _mix_block(p, gravity, weight, bias):  # pragma: no cover - jitted
    """OWN gains OTHER, MESSAGE keeps the channels; then gravity is taken back and the channels are mixed."""
    wide()
    for c in range(WIDTH * LANES):
        p[c] += p[OTHER * LANES + c]
    for c in range(CHANNELS * LANES):
        p[MESSAGE * LANES + c] = p[CHANNEL * LANES + c]
    _held(p)
    _take_back(p, gravity, weight)
    for out in range(CHANNELS):
        w = weight[out, 0], weight[out, 1], weight[out, 2], weight[out, 3]
        start = bias[out]
        for c in range(LANES):
            p[(CHANNEL + out) * LANES + c] += HALF * max(_mixed(p, w, start, c), ZERO)


@block_jit
def mix(p, now, gain, gravity, nearness, weight, bias, messages):  # pragma: no cover - jitted
    """All particles gain what contacts gave them and are mixed; ``messages`` keeps the channels, ``(CHANNELS, R)``."""
    for first in range(0, len(now), LANES):
        for place in range(0, LANES, WIDTH):
            columns_of(p, place, OWN, now, first)
            columns_of(p, place, OTHER, gain, first)
        for c in range(LANES):
            p[NEAR * LANES + c] = nearness[first + c]
        _mix_block(p, gravity, weight, bias)
        for place in range(0, LANES, WIDTH):
            rows_of(now, first, p, place, OWN)
        for m in range(CHANNELS):
            for c in range(LANES):
                messages[m, first + c] = p[(MESSAGE + m) * LANES + c]


@block_jit
def _mix_block_adjoint(p, gravity, weight, bias):  # pragma: no cover - jitted
    """Adjoint of :func:`_mix_block`: OWN is the adjoint, OTHER its constant part in the columns of the extra."""
    wide()
    g0, g1, g2 = gravity[0, 0], gravity[0, 1], gravity[0, 2]
    e0, e1, e2 = gravity[1, 0], gravity[1, 1], gravity[1, 2]
    _held(p)
    for c in range(LANES):
        share = g0 * p[MOVE * LANES + c] + g1 * p[(MOVE + 1) * LANES + c] + g2 * p[(MOVE + 2) * LANES + c]
        share += e0 * p[(OTHER + EXTRA) * LANES + c] + e1 * p[(OTHER + EXTRA + 1) * LANES + c]
        p[D_SHARE * LANES + c] = share + e2 * p[(OTHER + EXTRA + 2) * LANES + c]
        p[D_NEAR * LANES + c] = ZERO
    for m in range(CHANNELS):
        w = weight[CHANNELS, m]
        for c in range(LANES):
            share, held = p[D_SHARE * LANES + c], p[(HELD + m) * LANES + c]
            whole = share * p[NEAR * LANES + c]
            p[(D_HELD + m) * LANES + c] = whole * w
            p[D_NEAR * LANES + c] += share * w * held
            p[(D_WEIGHT + CHANNELS * CHANNELS + m) * LANES + c] += whole * held
    for out in range(CHANNELS):
        w = weight[out, 0], weight[out, 1], weight[out, 2], weight[out, 3]
        start = bias[out]
        for c in range(LANES):
            d_mixed = HALF * p[(CHANNEL + out) * LANES + c] if _mixed(p, w, start, c) > ZERO else ZERO
            p[(D_MIXED + out) * LANES + c] = d_mixed
            p[(D_WEIGHT + CHANNELS * (CHANNELS + 1) + out) * LANES + c] += d_mixed
            for m in range(CHANNELS):
                p[(D_HELD + m) * LANES + c] += d_mixed * w[m]
                p[(D_WEIGHT + CHANNELS * out + m) * LANES + c] += d_mixed * p[(HELD + m) * LANES + c]
    for m in range(CHANNELS):
        for c in range(LANES):
            inside = abs(p[(MESSAGE + m) * LANES + c]) <= CHANNEL_CLAMP
            p[(CHANNEL + m) * LANES + c] += p[(D_HELD + m) * LANES + c] if inside else ZERO
    for c in range(EXTRA * LANES):
        p[OTHER * LANES + c] = p[c]


@block_jit
def mix_adjoint(
    p, adjoint, before, gravity, nearness, weight, bias, messages, d_nearness, d_weight, d_bias
):  # pragma: no cover - jitted
    """Adjoint of :func:`mix`; ``before`` is what ``adjoint`` is now, with the extra's constant columns."""
    for c in range(D_WEIGHT * LANES, ROWS * LANES):
        p[c] = ZERO
    for first in range(0, len(adjoint), LANES):
        for place in range(0, LANES, WIDTH):
            columns_of(p, place, OWN, adjoint, first)
            columns_of(p, place, OTHER, before, first)
        for c in range(LANES):
            p[NEAR * LANES + c] = nearness[first + c]
        for m in range(CHANNELS):
            for c in range(LANES):
                p[(MESSAGE + m) * LANES + c] = messages[m, first + c]
        _mix_block_adjoint(p, gravity, weight, bias)
        for c in range(LANES):
            d_nearness[first + c] += p[D_NEAR * LANES + c]
        for place in range(0, LANES, WIDTH):
            rows_of(adjoint, first, p, place, OWN)
            rows_of(before, first, p, place, OTHER)
    for out in range(CHANNELS + 1):
        for m in range(CHANNELS):
            d_weight[out, m] += row_sum(p, D_WEIGHT + CHANNELS * out + m)
    for out in range(CHANNELS):
        d_bias[out] += row_sum(p, D_WEIGHT + CHANNELS * (CHANNELS + 1) + out)
