"""A block of contacts of the contact network: what they answer, and the hand-written adjoint of that.

A block is one flat float32 array; row ``R`` of its ``LANES`` contacts is ``block[R * LANES : (R + 1) * LANES]``. One
array with offsets known at compile time is what lets LLVM prove that rows do not overlap, and turn each loop over
lanes into SIMD; separate or two-dimensional arrays keep it scalar. The equations are those of
:func:`gran_bench.surrogate.contact.solver.solve_contacts`, which the tests hold this file to.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numba import njit

from gran_bench.surrogate.contact.constants import (
    CHANNELS,
    HIDDEN,
    INPUT_CLAMP,
    INPUT_SCALE,
    RAMP_NODES,
    SMALLEST_SLIP_SQUARED,
    VISCOUS_SHARE,
)

LANES = 32  # contacts a block: all rows stay in the first-level cache
RAMPS = len(RAMP_NODES) - 1
INPUTS = RAMPS + 5 + CHANNELS + 2
OUTPUTS = 3 + CHANNELS + 3

# Rows of a block: geometry, inputs, activations and answers ...
NORMAL, GAP, APPROACH, SLIP, SLIP_SIZE, FADE, DISTANCE = 0, 3, 4, 5, 8, 9, 10
MOTION, SPIN, SUM_A, SUM_B, SPRING, FLAT, LOAD, ALONG = 11, 14, 17, 18, 19, 22, 25, 26
SEEN = 27
TOGETHER = SEEN + RAMPS + 5
ACTIVE = SEEN + INPUTS
ANSWER = ACTIVE + HIDDEN  # a, b, c, messages, e, a_v, b_v; faded, and a with its push
RAW = ANSWER + OUTPUTS  # the same before fading
PUSH = RAW + OUTPUTS
TURN, EXTRA_PUSH, EXTRA_TURN = PUSH + 3, PUSH + 6, PUSH + 9
# ... and their adjoints.
D_PUSH = EXTRA_TURN + 3
D_TURN, D_EXTRA_PUSH, D_EXTRA_TURN = D_PUSH + 3, D_PUSH + 6, D_PUSH + 9
D_SUM_A = D_PUSH + 12
D_SUM_B = D_SUM_A + 1
D_ANSWER = D_SUM_B + 1
D_ACTIVE = D_ANSWER + OUTPUTS
D_SEEN = D_ACTIVE + HIDDEN
D_TOGETHER = D_SEEN + RAMPS + 5
D_NORMAL = D_SEEN + INPUTS
D_GAP, D_APPROACH, D_SLIP, D_SLIP_SIZE = D_NORMAL + 3, D_NORMAL + 4, D_NORMAL + 5, D_NORMAL + 8
D_MOTION, D_SPIN, D_FLAT = D_NORMAL + 9, D_NORMAL + 12, D_NORMAL + 15
D_STIFFNESS, D_SHARE = D_NORMAL + 18, D_NORMAL + 19  # each lane's part
ROWS = D_NORMAL + 20

ZERO, ONE, HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
CLAMP, SCALE, SMALLEST = np.float32(INPUT_CLAMP), np.float32(INPUT_SCALE), np.float32(SMALLEST_SLIP_SQUARED)
VISCOUS = np.float32(VISCOUS_SHARE)  # of c
RAMP_START = tuple(np.float32(low) for low in RAMP_NODES[:-1])
RAMP_SLOPE = tuple(np.float32(1.0 / (high - low)) for low, high in pairwise(RAMP_NODES))

# Sums may be reordered and multiply-adds contracted; infinities and NaN keep their meaning.
block_jit = njit(nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz", "arcp"})


@block_jit
def clamp(value, low, high):  # pragma: no cover - jitted
    """``value`` held in [low, high]."""
    return min(max(value, low), high)


@block_jit
def inside(value):  # pragma: no cover - jitted
    """The scale of an input, where it is not clamped: its derivative."""
    return SCALE if abs(value) <= CLAMP else ZERO


@block_jit
def surfaces(b):  # pragma: no cover - jitted
    """u_n and slip from NORMAL, MOTION and SPIN."""
    for c in range(LANES):
        n0, n1, n2 = b[NORMAL * LANES + c], b[(NORMAL + 1) * LANES + c], b[(NORMAL + 2) * LANES + c]
        u0, u1, u2 = b[MOTION * LANES + c], b[(MOTION + 1) * LANES + c], b[(MOTION + 2) * LANES + c]
        w0, w1, w2 = b[SPIN * LANES + c], b[(SPIN + 1) * LANES + c], b[(SPIN + 2) * LANES + c]
        approach = u0 * n0 + u1 * n1 + u2 * n2
        s0 = u0 - approach * n0 - (w1 * n2 - w2 * n1)
        s1 = u1 - approach * n1 - (w2 * n0 - w0 * n2)
        s2 = u2 - approach * n2 - (w0 * n1 - w1 * n0)
        b[APPROACH * LANES + c] = approach
        b[SLIP * LANES + c], b[(SLIP + 1) * LANES + c], b[(SLIP + 2) * LANES + c] = s0, s1, s2
        b[SLIP_SIZE * LANES + c] = math.sqrt(s0 * s0 + s1 * s1 + s2 * s2 + SMALLEST)


@block_jit
def look(b, reach, slope):  # pragma: no cover - jitted
    """The inputs of the perceptron and the fade, from the surfaces, sums and springs."""
    for c in range(LANES):
        gap, size = b[GAP * LANES + c], b[SLIP_SIZE * LANES + c]
        b[FADE * LANES + c] = clamp((reach - gap) * slope, ZERO, ONE)
        b[(SEEN + RAMPS) * LANES + c] = SCALE * clamp(b[APPROACH * LANES + c], -CLAMP, CLAMP)
        b[(SEEN + RAMPS + 1) * LANES + c] = SCALE * clamp(size, -CLAMP, CLAMP)
        b[(SEEN + RAMPS + 2) * LANES + c] = SCALE * clamp(gap, -CLAMP, CLAMP)
        b[(SEEN + RAMPS + 3) * LANES + c] = SCALE * clamp(b[SUM_A * LANES + c], -CLAMP, CLAMP)
        b[(SEEN + RAMPS + 4) * LANES + c] = SCALE * clamp(b[SUM_B * LANES + c], -CLAMP, CLAMP)
        n0, n1, n2 = b[NORMAL * LANES + c], b[(NORMAL + 1) * LANES + c], b[(NORMAL + 2) * LANES + c]
        x0, x1, x2 = b[SPRING * LANES + c], b[(SPRING + 1) * LANES + c], b[(SPRING + 2) * LANES + c]
        lift = x0 * n0 + x1 * n1 + x2 * n2
        x0, x1, x2 = x0 - lift * n0, x1 - lift * n1, x2 - lift * n2
        b[FLAT * LANES + c], b[(FLAT + 1) * LANES + c], b[(FLAT + 2) * LANES + c] = x0, x1, x2
        load = math.sqrt(x0 * x0 + x1 * x1 + x2 * x2 + SMALLEST)
        s0, s1, s2 = b[SLIP * LANES + c], b[(SLIP + 1) * LANES + c], b[(SLIP + 2) * LANES + c]
        along = (x0 * s0 + x1 * s1 + x2 * s2) / size
        b[LOAD * LANES + c], b[ALONG * LANES + c] = load, along
        b[(SEEN + INPUTS - 2) * LANES + c] = clamp(load, -CLAMP, CLAMP)
        b[(SEEN + INPUTS - 1) * LANES + c] = clamp(along, -CLAMP, CLAMP)
    for ramp in range(RAMPS):
        for c in range(LANES):
            rise = (b[GAP * LANES + c] - RAMP_START[ramp]) * RAMP_SLOPE[ramp]
            b[(SEEN + ramp) * LANES + c] = clamp(rise, ZERO, ONE)


@block_jit
def perceive(b, hidden_weight, hidden_bias, output_weight, output_bias):  # pragma: no cover - jitted
    """ACTIVE and RAW, the hidden units and the outputs of the perceptron."""
    for unit in range(HIDDEN):
        for c in range(LANES):
            total = hidden_bias[unit]
            for k in range(INPUTS):
                total += hidden_weight[unit * INPUTS + k] * b[(SEEN + k) * LANES + c]
            b[(ACTIVE + unit) * LANES + c] = max(total, ZERO)
    for out in range(OUTPUTS):
        for c in range(LANES):
            total = output_bias[out]
            for k in range(HIDDEN):
                total += output_weight[out * HIDDEN + k] * b[(ACTIVE + k) * LANES + c]
            b[(RAW + out) * LANES + c] = total


@block_jit
def answer(b, strength, share):  # pragma: no cover - jitted
    """ANSWER, PUSH, TURN and their extra parts from RAW; ``strength`` is κ (wall: 2κ), ``share`` is σ."""
    for out in range(OUTPUTS):
        for c in range(LANES):
            b[(ANSWER + out) * LANES + c] = b[FADE * LANES + c] * b[(RAW + out) * LANES + c]
    for c in range(LANES):
        a = b[ANSWER * LANES + c] + strength * max(-b[GAP * LANES + c], ZERO)
        b[ANSWER * LANES + c] = a
        size = b[SLIP_SIZE * LANES + c]
        drag = b[(ANSWER + 1) * LANES + c] / size + VISCOUS * b[(ANSWER + 2) * LANES + c]
        pull = b[(ANSWER + 3 + CHANNELS) * LANES + c]
        away = b[(ANSWER + 4 + CHANNELS) * LANES + c]
        extra = b[(ANSWER + 5 + CHANNELS) * LANES + c] / size
        n0, n1, n2 = b[NORMAL * LANES + c], b[(NORMAL + 1) * LANES + c], b[(NORMAL + 2) * LANES + c]
        s0, s1, s2 = b[SLIP * LANES + c], b[(SLIP + 1) * LANES + c], b[(SLIP + 2) * LANES + c]
        t0 = drag * s0 + pull * b[FLAT * LANES + c]
        t1 = drag * s1 + pull * b[(FLAT + 1) * LANES + c]
        t2 = drag * s2 + pull * b[(FLAT + 2) * LANES + c]
        b[PUSH * LANES + c] = t0 - a * n0
        b[(PUSH + 1) * LANES + c] = t1 - a * n1
        b[(PUSH + 2) * LANES + c] = t2 - a * n2
        b[TURN * LANES + c] = share * (n1 * t2 - n2 * t1)
        b[(TURN + 1) * LANES + c] = share * (n2 * t0 - n0 * t2)
        b[(TURN + 2) * LANES + c] = share * (n0 * t1 - n1 * t0)
        b[EXTRA_PUSH * LANES + c] = extra * s0 - away * n0
        b[(EXTRA_PUSH + 1) * LANES + c] = extra * s1 - away * n1
        b[(EXTRA_PUSH + 2) * LANES + c] = extra * s2 - away * n2
        b[EXTRA_TURN * LANES + c] = share * extra * (n1 * s2 - n2 * s1)
        b[(EXTRA_TURN + 1) * LANES + c] = share * extra * (n2 * s0 - n0 * s2)
        b[(EXTRA_TURN + 2) * LANES + c] = share * extra * (n0 * s1 - n1 * s0)


@block_jit
def answer_adjoint(b, strength, share, slope):  # pragma: no cover - jitted
    """Adjoint of :func:`answer`: from D_PUSH … D_SUM_B and the messages in D_ANSWER to D_ANSWER (of RAW) and surfaces.

    With gτ = gp + σ gt × n the adjoint of the tangential displacement, gp and gt those of push and turn.
    """
    for c in range(LANES):
        n0, n1, n2 = b[NORMAL * LANES + c], b[(NORMAL + 1) * LANES + c], b[(NORMAL + 2) * LANES + c]
        s0, s1, s2 = b[SLIP * LANES + c], b[(SLIP + 1) * LANES + c], b[(SLIP + 2) * LANES + c]
        x0, x1, x2 = b[FLAT * LANES + c], b[(FLAT + 1) * LANES + c], b[(FLAT + 2) * LANES + c]
        p0, p1, p2 = b[D_PUSH * LANES + c], b[(D_PUSH + 1) * LANES + c], b[(D_PUSH + 2) * LANES + c]
        t0, t1, t2 = b[D_TURN * LANES + c], b[(D_TURN + 1) * LANES + c], b[(D_TURN + 2) * LANES + c]
        inverse = ONE / b[SLIP_SIZE * LANES + c]
        a, friction = b[ANSWER * LANES + c], b[(ANSWER + 1) * LANES + c]
        drag = friction * inverse + VISCOUS * b[(ANSWER + 2) * LANES + c]
        pull = b[(ANSWER + 3 + CHANNELS) * LANES + c]
        g0 = p0 + share * (t1 * n2 - t2 * n1)
        g1 = p1 + share * (t2 * n0 - t0 * n2)
        g2 = p2 + share * (t0 * n1 - t1 * n0)
        v0, v1, v2 = drag * s0 + pull * x0, drag * s1 + pull * x1, drag * s2 + pull * x2
        along_slip = g0 * s0 + g1 * s1 + g2 * s2
        d_a = b[D_SUM_A * LANES + c] - (p0 * n0 + p1 * n1 + p2 * n2)
        d_b = b[D_SUM_B * LANES + c] + along_slip * inverse
        d_share = t0 * (n1 * v2 - n2 * v1) + t1 * (n2 * v0 - n0 * v2) + t2 * (n0 * v1 - n1 * v0)
        d_n0 = share * (v1 * t2 - v2 * t1) - a * p0
        d_n1 = share * (v2 * t0 - v0 * t2) - a * p1
        d_n2 = share * (v0 * t1 - v1 * t0) - a * p2
        d_size = -along_slip * friction * inverse * inverse

        # The parts that act on the velocity alone, in the same way.
        q0, q1, q2 = b[D_EXTRA_PUSH * LANES + c], b[(D_EXTRA_PUSH + 1) * LANES + c], b[(D_EXTRA_PUSH + 2) * LANES + c]
        r0, r1, r2 = b[D_EXTRA_TURN * LANES + c], b[(D_EXTRA_TURN + 1) * LANES + c], b[(D_EXTRA_TURN + 2) * LANES + c]
        away, extra = b[(ANSWER + 4 + CHANNELS) * LANES + c], b[(ANSWER + 5 + CHANNELS) * LANES + c] * inverse
        e0 = q0 + share * (r1 * n2 - r2 * n1)
        e1 = q1 + share * (r2 * n0 - r0 * n2)
        e2 = q2 + share * (r0 * n1 - r1 * n0)
        extra_along = e0 * s0 + e1 * s1 + e2 * s2
        crossed = r0 * (n1 * s2 - n2 * s1) + r1 * (n2 * s0 - n0 * s2) + r2 * (n0 * s1 - n1 * s0)
        b[D_SHARE * LANES + c] = d_share + extra * crossed
        b[D_NORMAL * LANES + c] = d_n0 - away * q0 + share * extra * (s1 * r2 - s2 * r1)
        b[(D_NORMAL + 1) * LANES + c] = d_n1 - away * q1 + share * extra * (s2 * r0 - s0 * r2)
        b[(D_NORMAL + 2) * LANES + c] = d_n2 - away * q2 + share * extra * (s0 * r1 - s1 * r0)
        b[D_SLIP * LANES + c] = drag * g0 + extra * e0
        b[(D_SLIP + 1) * LANES + c] = drag * g1 + extra * e1
        b[(D_SLIP + 2) * LANES + c] = drag * g2 + extra * e2
        b[D_SLIP_SIZE * LANES + c] = d_size - extra_along * extra * inverse
        b[D_FLAT * LANES + c] = pull * g0
        b[(D_FLAT + 1) * LANES + c] = pull * g1
        b[(D_FLAT + 2) * LANES + c] = pull * g2

        overlap = max(-b[GAP * LANES + c], ZERO)
        b[D_STIFFNESS * LANES + c] = d_a * overlap
        b[D_GAP * LANES + c] = -strength * d_a if overlap > ZERO else ZERO
        b[D_ANSWER * LANES + c] = d_a
        b[(D_ANSWER + 1) * LANES + c] = d_b
        b[(D_ANSWER + 2) * LANES + c] = VISCOUS * along_slip
        b[(D_ANSWER + 3 + CHANNELS) * LANES + c] = g0 * x0 + g1 * x1 + g2 * x2
        b[(D_ANSWER + 4 + CHANNELS) * LANES + c] = -(q0 * n0 + q1 * n1 + q2 * n2)
        b[(D_ANSWER + 5 + CHANNELS) * LANES + c] = extra_along * inverse
    for c in range(LANES):
        fade, total = b[FADE * LANES + c], ZERO
        for out in range(OUTPUTS):
            total += b[(D_ANSWER + out) * LANES + c] * b[(RAW + out) * LANES + c]
            b[(D_ANSWER + out) * LANES + c] *= fade
        b[D_GAP * LANES + c] -= slope * total if ZERO < fade < ONE else ZERO


@block_jit
def perceive_adjoint(
    b, hidden_weight, output_weight, d_hidden_weight, d_hidden_bias, d_output_weight, d_output_bias
):  # pragma: no cover - jitted
    """Adjoint of :func:`perceive`: D_SEEN from D_ANSWER, and the sums over lanes for the weights."""
    for unit in range(HIDDEN):
        for c in range(LANES):
            total = ZERO
            for out in range(OUTPUTS):
                total += output_weight[out * HIDDEN + unit] * b[(D_ANSWER + out) * LANES + c]
            b[(D_ACTIVE + unit) * LANES + c] = total if b[(ACTIVE + unit) * LANES + c] > ZERO else ZERO
    for k in range(INPUTS):
        for c in range(LANES):
            total = ZERO
            for unit in range(HIDDEN):
                total += hidden_weight[unit * INPUTS + k] * b[(D_ACTIVE + unit) * LANES + c]
            b[(D_SEEN + k) * LANES + c] = total
    for out in range(OUTPUTS):
        _add_products(b, D_ANSWER + out, ACTIVE, d_output_weight, out * HIDDEN, 1)
        d_output_bias[out] += row_sum(b, D_ANSWER + out)
    for k in range(INPUTS):
        _add_products(b, SEEN + k, D_ACTIVE, d_hidden_weight, k, INPUTS)
    for unit in range(HIDDEN):
        d_hidden_bias[unit] += row_sum(b, D_ACTIVE + unit)


@block_jit
def _add_products(b, row, units, result, start, stride):  # pragma: no cover - jitted
    """Adds the lanes' sums of one row times each of the HIDDEN rows from ``units`` on; HIDDEN is a multiple of 4.

    Four sums a loop: a shorter body would be unrolled over all lanes into scalar code.
    """
    # Slices, because only an index that cannot be negative is read without a gather.
    values, factors = b[row * LANES : (row + 1) * LANES], b[units * LANES : (units + HIDDEN) * LANES]
    for unit in range(0, HIDDEN, 4):
        t0, t1, t2, t3 = ZERO, ZERO, ZERO, ZERO
        for c in range(LANES):
            t0 += values[c] * factors[unit * LANES + c]
            t1 += values[c] * factors[(unit + 1) * LANES + c]
            t2 += values[c] * factors[(unit + 2) * LANES + c]
            t3 += values[c] * factors[(unit + 3) * LANES + c]
        result[start + unit * stride] += t0
        result[start + (unit + 1) * stride] += t1
        result[start + (unit + 2) * stride] += t2
        result[start + (unit + 3) * stride] += t3


@block_jit
def look_adjoint(b):  # pragma: no cover - jitted
    """Adjoint of :func:`look` and :func:`surfaces`: D_GAP, D_NORMAL, D_MOTION, D_SPIN and the sums' adjoints."""
    for ramp in range(RAMPS):
        for c in range(LANES):
            seen = b[(SEEN + ramp) * LANES + c]
            slope = RAMP_SLOPE[ramp] if ZERO < seen < ONE else ZERO
            b[D_GAP * LANES + c] += slope * b[(D_SEEN + ramp) * LANES + c]
    for c in range(LANES):
        approach, size = b[APPROACH * LANES + c], b[SLIP_SIZE * LANES + c]
        b[D_GAP * LANES + c] += inside(b[GAP * LANES + c]) * b[(D_SEEN + RAMPS + 2) * LANES + c]
        b[D_SUM_A * LANES + c] += inside(b[SUM_A * LANES + c]) * b[(D_SEEN + RAMPS + 3) * LANES + c]
        b[D_SUM_B * LANES + c] += inside(b[SUM_B * LANES + c]) * b[(D_SEEN + RAMPS + 4) * LANES + c]
        d_approach = inside(approach) * b[(D_SEEN + RAMPS) * LANES + c]
        d_size = b[D_SLIP_SIZE * LANES + c] + inside(size) * b[(D_SEEN + RAMPS + 1) * LANES + c]

        n0, n1, n2 = b[NORMAL * LANES + c], b[(NORMAL + 1) * LANES + c], b[(NORMAL + 2) * LANES + c]
        s0, s1, s2 = b[SLIP * LANES + c], b[(SLIP + 1) * LANES + c], b[(SLIP + 2) * LANES + c]
        x0, x1, x2 = b[FLAT * LANES + c], b[(FLAT + 1) * LANES + c], b[(FLAT + 2) * LANES + c]
        load, along, inverse = b[LOAD * LANES + c], b[ALONG * LANES + c], ONE / size
        d_load = b[(D_SEEN + INPUTS - 2) * LANES + c] / load if load <= CLAMP else ZERO
        d_along = b[(D_SEEN + INPUTS - 1) * LANES + c] * inverse if abs(along) <= CLAMP else ZERO
        f0 = b[D_FLAT * LANES + c] + d_load * x0 + d_along * s0
        f1 = b[(D_FLAT + 1) * LANES + c] + d_load * x1 + d_along * s1
        f2 = b[(D_FLAT + 2) * LANES + c] + d_load * x2 + d_along * s2
        d_size = (d_size - d_along * along) * inverse
        g0 = b[D_SLIP * LANES + c] + d_along * x0 + d_size * s0
        g1 = b[(D_SLIP + 1) * LANES + c] + d_along * x1 + d_size * s1
        g2 = b[(D_SLIP + 2) * LANES + c] + d_along * x2 + d_size * s2

        # flat = ξ − (ξ·n) n
        k0, k1, k2 = b[SPRING * LANES + c], b[(SPRING + 1) * LANES + c], b[(SPRING + 2) * LANES + c]
        lift, fall = k0 * n0 + k1 * n1 + k2 * n2, f0 * n0 + f1 * n1 + f2 * n2
        # slip = u − u_n n − w×n and u_n = u·n
        u0, u1, u2 = b[MOTION * LANES + c], b[(MOTION + 1) * LANES + c], b[(MOTION + 2) * LANES + c]
        w0, w1, w2 = b[SPIN * LANES + c], b[(SPIN + 1) * LANES + c], b[(SPIN + 2) * LANES + c]
        d_approach -= g0 * n0 + g1 * n1 + g2 * n2
        b[D_NORMAL * LANES + c] += d_approach * u0 - approach * g0 + (w1 * g2 - w2 * g1) - lift * f0 - fall * k0
        b[(D_NORMAL + 1) * LANES + c] += d_approach * u1 - approach * g1 + (w2 * g0 - w0 * g2) - lift * f1 - fall * k1
        b[(D_NORMAL + 2) * LANES + c] += d_approach * u2 - approach * g2 + (w0 * g1 - w1 * g0) - lift * f2 - fall * k2
        b[D_MOTION * LANES + c] = g0 + d_approach * n0
        b[(D_MOTION + 1) * LANES + c] = g1 + d_approach * n1
        b[(D_MOTION + 2) * LANES + c] = g2 + d_approach * n2
        b[D_SPIN * LANES + c] = g1 * n2 - g2 * n1
        b[(D_SPIN + 1) * LANES + c] = g2 * n0 - g0 * n2
        b[(D_SPIN + 2) * LANES + c] = g0 * n1 - g1 * n0


@block_jit
def row_sum(b, row):  # pragma: no cover - jitted
    """Sum of one row over the lanes."""
    result = ZERO
    for c in range(LANES):
        result += b[row * LANES + c]
    return result
