"""A block of contacts of the contact network: what they answer, and the hand-written adjoint of that.

A block is one flat float32 array; row ``R`` of its ``LANES`` contacts is ``block[R * LANES : (R + 1) * LANES]``. One
array with offsets known at compile time is what lets LLVM prove that rows do not overlap, and turn each loop over
lanes into SIMD; separate or two-dimensional arrays keep it scalar. The equations are those of
:func:`gran_bench.surrogate.contact.solver.solve_contacts`, which the tests hold this file to.
"""

import math
from itertools import pairwise

import numpy as np
from numba import njit

from gran_bench.surrogate.contact import constants
from gran_bench.surrogate.contact.constants import CHANNELS, HIDDEN, RAMP_NODES
from gran_bench.surrogate.contact.kernels.lanes import LANES, WIDTH, layer, outer, wide

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
INVERSE = D_NORMAL + 20  # of SLIP_SIZE
CENTER = INVERSE + 1  # of the particle at a wall
ROWS = CENTER + 3

ZERO, ONE, HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
CLAMP, SCALE = np.float32(constants.INPUT_CLAMP), np.float32(constants.INPUT_SCALE)
SMALLEST, VISCOUS = np.float32(constants.SMALLEST_SLIP_SQUARED), np.float32(constants.VISCOUS_SHARE)  # of c
RAMP_START = tuple(np.float32(low) for low in RAMP_NODES[:-1])
RAMP_SLOPE = tuple(np.float32(1.0 / (high - low)) for low, high in pairwise(RAMP_NODES))

# The perceptron and its adjoint; an intrinsic takes sixteen lanes.
_hidden_layer = layer(SEEN, INPUTS, ACTIVE, HIDDEN, (INPUTS, 1), "rectified")
_output_layer = layer(ACTIVE, HIDDEN, RAW, OUTPUTS, (HIDDEN, 1), "biased")
_to_hidden = layer(D_ANSWER, OUTPUTS, D_ACTIVE, HIDDEN, (1, HIDDEN), "masked")
_to_seen = layer(D_ACTIVE, HIDDEN, D_SEEN, INPUTS, (1, INPUTS), "masked")
_output_products, _hidden_products = outer(ACTIVE, D_ANSWER, OUTPUTS), outer(D_ACTIVE, SEEN, INPUTS)

# Sums may be reordered and multiply-adds contracted; infinities and NaN keep their meaning.
block_jit = njit(nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz", "arcp"})
# Vectors of one lane as tuples that stay in registers; written into whoever calls them.
_lane = njit(inline="always")
three = _lane(lambda b, row, c: (b[row * LANES + c], b[(row + 1) * LANES + c], b[(row + 2) * LANES + c]))
dot = _lane(lambda x, y: x[0] * y[0] + x[1] * y[1] + x[2] * y[2])
cross = _lane(lambda x, y: (x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]))
times = _lane(lambda a, x: (a * x[0], a * x[1], a * x[2]))  # a x
plus = _lane(lambda x, a, y: (x[0] + a * y[0], x[1] + a * y[1], x[2] + a * y[2]))  # x + a y
less = _lane(lambda x, a, y: (x[0] - a * y[0], x[1] - a * y[1], x[2] - a * y[2]))  # x − a y
both = _lane(lambda x, y: (x[0] + y[0], x[1] + y[1], x[2] + y[2]))  # x + y


@njit(inline="always")
def store(b, row, c, x):  # pragma: no cover - jitted
    """A vector into rows ``row`` to ``row + 2``."""
    b[row * LANES + c], b[(row + 1) * LANES + c], b[(row + 2) * LANES + c] = x[0], x[1], x[2]


@block_jit
def _clamp(value, low, high):  # pragma: no cover - jitted
    """``value`` held in [low, high]."""
    return min(max(value, low), high)


@block_jit
def _inside(value):  # pragma: no cover - jitted
    """The scale of an input, where it is not clamped: its derivative."""
    return SCALE if abs(value) <= CLAMP else ZERO


@block_jit
def _surfaces(b):  # pragma: no cover - jitted
    """u_n and slip from NORMAL, MOTION and SPIN."""
    wide()
    for c in range(LANES):
        n, u = three(b, NORMAL, c), three(b, MOTION, c)
        approach, rolled = dot(u, n), cross(three(b, SPIN, c), n)
        s = less(less(u, approach, n), ONE, rolled)
        b[APPROACH * LANES + c] = approach
        store(b, SLIP, c, s)
        size = math.sqrt(dot(s, s) + SMALLEST)
        b[SLIP_SIZE * LANES + c], b[INVERSE * LANES + c] = size, ONE / size


@block_jit
def _look(b, reach, slope):  # pragma: no cover - jitted
    """The inputs of the perceptron and the fade, from the surfaces, sums and springs."""
    wide()
    for c in range(LANES):
        gap, size = b[GAP * LANES + c], b[SLIP_SIZE * LANES + c]
        b[FADE * LANES + c] = _clamp((reach - gap) * slope, ZERO, ONE)
        b[(SEEN + RAMPS) * LANES + c] = SCALE * _clamp(b[APPROACH * LANES + c], -CLAMP, CLAMP)
        b[(SEEN + RAMPS + 1) * LANES + c] = SCALE * _clamp(size, -CLAMP, CLAMP)
        b[(SEEN + RAMPS + 2) * LANES + c] = SCALE * _clamp(gap, -CLAMP, CLAMP)
        b[(SEEN + RAMPS + 3) * LANES + c] = SCALE * _clamp(b[SUM_A * LANES + c], -CLAMP, CLAMP)
        b[(SEEN + RAMPS + 4) * LANES + c] = SCALE * _clamp(b[SUM_B * LANES + c], -CLAMP, CLAMP)
        n, spring = three(b, NORMAL, c), three(b, SPRING, c)
        flat = less(spring, dot(spring, n), n)
        store(b, FLAT, c, flat)
        load = math.sqrt(dot(flat, flat) + SMALLEST)
        along = dot(flat, three(b, SLIP, c)) * b[INVERSE * LANES + c]
        b[LOAD * LANES + c], b[ALONG * LANES + c] = load, along
        b[(SEEN + INPUTS - 2) * LANES + c] = _clamp(load, -CLAMP, CLAMP)
        b[(SEEN + INPUTS - 1) * LANES + c] = _clamp(along, -CLAMP, CLAMP)
    for ramp in range(RAMPS):
        for c in range(LANES):
            rise = (b[GAP * LANES + c] - RAMP_START[ramp]) * RAMP_SLOPE[ramp]
            b[(SEEN + ramp) * LANES + c] = _clamp(rise, ZERO, ONE)


@block_jit
def _perceive(b, hidden_weight, hidden_bias, output_weight, output_bias):  # pragma: no cover - jitted
    """ACTIVE and RAW, the hidden units and the outputs of the perceptron."""
    for place in range(0, LANES, WIDTH):
        _hidden_layer(b, place, hidden_weight, hidden_bias)
        _output_layer(b, place, output_weight, output_bias)


@block_jit
def _answer(b, strength, share):  # pragma: no cover - jitted
    """ANSWER, PUSH, TURN and their extra parts from RAW; ``strength`` is κ (wall: 2κ), ``share`` is σ."""
    wide()
    for out in range(OUTPUTS):
        for c in range(LANES):
            b[(ANSWER + out) * LANES + c] = b[FADE * LANES + c] * b[(RAW + out) * LANES + c]
    for c in range(LANES):
        a = b[ANSWER * LANES + c] + strength * max(-b[GAP * LANES + c], ZERO)
        b[ANSWER * LANES + c] = a
        inverse = b[INVERSE * LANES + c]
        drag = b[(ANSWER + 1) * LANES + c] * inverse + VISCOUS * b[(ANSWER + 2) * LANES + c]
        pull = b[(ANSWER + 3 + CHANNELS) * LANES + c]
        away = b[(ANSWER + 4 + CHANNELS) * LANES + c]
        extra = b[(ANSWER + 5 + CHANNELS) * LANES + c] * inverse
        n, s = three(b, NORMAL, c), three(b, SLIP, c)
        t = plus(times(drag, s), pull, three(b, FLAT, c))
        store(b, PUSH, c, less(t, a, n))
        store(b, TURN, c, times(share, cross(n, t)))
        store(b, EXTRA_PUSH, c, less(times(extra, s), away, n))
        store(b, EXTRA_TURN, c, times(share * extra, cross(n, s)))


@block_jit
def _answer_adjoint(b, strength, share, slope):  # pragma: no cover - jitted
    """Adjoint of :func:`_answer`: from D_PUSH … D_SUM_B and the messages in D_ANSWER to D_ANSWER (of RAW) and surfaces.

    With g = gp + σ gt × n the adjoint of the tangential displacement v, gp and gt those of push and turn.
    """
    wide()
    for c in range(LANES):
        n, s, x = three(b, NORMAL, c), three(b, SLIP, c), three(b, FLAT, c)
        p, t = three(b, D_PUSH, c), three(b, D_TURN, c)
        inverse = b[INVERSE * LANES + c]
        a, friction = b[ANSWER * LANES + c], b[(ANSWER + 1) * LANES + c]
        drag = friction * inverse + VISCOUS * b[(ANSWER + 2) * LANES + c]
        pull = b[(ANSWER + 3 + CHANNELS) * LANES + c]
        g, v = plus(p, share, cross(t, n)), plus(times(drag, s), pull, x)
        along_slip = dot(g, s)
        d_a = b[D_SUM_A * LANES + c] - dot(p, n)
        d_b = b[D_SUM_B * LANES + c] + along_slip * inverse
        d_share = dot(t, cross(n, v))
        d_n = less(times(share, cross(v, t)), a, p)
        d_size = -along_slip * friction * inverse * inverse

        # The parts that act on the velocity alone, in the same way.
        q, r = three(b, D_EXTRA_PUSH, c), three(b, D_EXTRA_TURN, c)
        away, extra = b[(ANSWER + 4 + CHANNELS) * LANES + c], b[(ANSWER + 5 + CHANNELS) * LANES + c] * inverse
        e = plus(q, share, cross(r, n))
        extra_along = dot(e, s)
        b[D_SHARE * LANES + c] = d_share + extra * dot(r, cross(n, s))
        store(b, D_NORMAL, c, plus(less(d_n, away, q), share * extra, cross(s, r)))
        store(b, D_SLIP, c, plus(times(drag, g), extra, e))
        b[D_SLIP_SIZE * LANES + c] = d_size - extra_along * extra * inverse
        store(b, D_FLAT, c, times(pull, g))

        overlap = max(-b[GAP * LANES + c], ZERO)
        b[D_STIFFNESS * LANES + c] = d_a * overlap
        b[D_GAP * LANES + c] = -strength * d_a if overlap > ZERO else ZERO
        store(b, D_ANSWER, c, (d_a, d_b, VISCOUS * along_slip))
        store(b, D_ANSWER + 3 + CHANNELS, c, (dot(g, x), -dot(q, n), extra_along * inverse))
    for c in range(LANES):
        fade, total = b[FADE * LANES + c], ZERO
        for out in range(OUTPUTS):
            total += b[(D_ANSWER + out) * LANES + c] * b[(RAW + out) * LANES + c]
            b[(D_ANSWER + out) * LANES + c] *= fade
        b[D_GAP * LANES + c] -= slope * total if ZERO < fade < ONE else ZERO


@block_jit
def _perceive_adjoint(
    b, hidden_weight, output_weight, d_hidden_weight, d_hidden_bias, d_output_weight, d_output_bias
):  # pragma: no cover - jitted
    """Adjoint of :func:`_perceive`: D_SEEN from D_ANSWER, and the sums over lanes for the weights.

    Those of the hidden weights are transposed: the units of an input are neighbours.
    """
    for place in range(0, LANES, WIDTH):
        _to_hidden(b, place, output_weight, ACTIVE)
        _to_seen(b, place, hidden_weight, None)
        _output_products(b, place, d_output_weight, None)
        _hidden_products(b, place, d_hidden_weight, d_hidden_bias)
    for out in range(OUTPUTS):
        d_output_bias[out] += row_sum(b, D_ANSWER + out)


@block_jit
def _look_adjoint(b):  # pragma: no cover - jitted
    """Adjoint of :func:`look` and :func:`surfaces`: D_GAP, D_NORMAL, D_MOTION, D_SPIN and the sums' adjoints."""
    wide()
    for ramp in range(RAMPS):
        for c in range(LANES):
            seen = b[(SEEN + ramp) * LANES + c]
            slope = RAMP_SLOPE[ramp] if ZERO < seen < ONE else ZERO
            b[D_GAP * LANES + c] += slope * b[(D_SEEN + ramp) * LANES + c]
    for c in range(LANES):
        approach, size = b[APPROACH * LANES + c], b[SLIP_SIZE * LANES + c]
        b[D_GAP * LANES + c] += _inside(b[GAP * LANES + c]) * b[(D_SEEN + RAMPS + 2) * LANES + c]
        b[D_SUM_A * LANES + c] += _inside(b[SUM_A * LANES + c]) * b[(D_SEEN + RAMPS + 3) * LANES + c]
        b[D_SUM_B * LANES + c] += _inside(b[SUM_B * LANES + c]) * b[(D_SEEN + RAMPS + 4) * LANES + c]
        d_approach = _inside(approach) * b[(D_SEEN + RAMPS) * LANES + c]
        d_size = b[D_SLIP_SIZE * LANES + c] + _inside(size) * b[(D_SEEN + RAMPS + 1) * LANES + c]

        n0, n1, n2 = b[NORMAL * LANES + c], b[(NORMAL + 1) * LANES + c], b[(NORMAL + 2) * LANES + c]
        s0, s1, s2 = b[SLIP * LANES + c], b[(SLIP + 1) * LANES + c], b[(SLIP + 2) * LANES + c]
        x0, x1, x2 = b[FLAT * LANES + c], b[(FLAT + 1) * LANES + c], b[(FLAT + 2) * LANES + c]
        load, along, inverse = b[LOAD * LANES + c], b[ALONG * LANES + c], b[INVERSE * LANES + c]
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
def respond(b, limits, kind, strength, share, w1, b1, w2, b2):  # pragma: no cover - jitted
    """All of a block's answers from its gathered rows; ``limits`` are the reach and the fade of each kind."""
    _surfaces(b)
    _look(b, limits[2 * kind], ONE / limits[2 * kind + 1])
    _perceive(b, w1, b1, w2, b2)
    _answer(b, strength, share)


@block_jit
def respond_adjoint(b, limits, kind, strength, share, w1, w2, d_w1, d_b1, d_w2, d_b2):  # pragma: no cover - jitted
    """Adjoint of :func:`respond`, the weights' gradients included."""
    _answer_adjoint(b, strength, share, ONE / limits[2 * kind + 1])
    _perceive_adjoint(b, w1, w2, d_w1, d_b1, d_w2, d_b2)
    _look_adjoint(b)


@block_jit
def row_sum(b, row):  # pragma: no cover - jitted
    """Sum of one row over the lanes."""
    wide()
    result = ZERO
    for c in range(LANES):
        result += b[row * LANES + c]
    return result
