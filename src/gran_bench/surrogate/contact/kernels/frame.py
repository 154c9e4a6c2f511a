"""A frame of the contact network and its adjoint, jitted, cached on disk; the interpreter lock is released.

Contacts are gathered into the blocks of :mod:`gran_bench.surrogate.contact.kernels.block`, computed in SIMD and
scattered in order, so that a result does not depend on the machine's load; then channels are mixed. The adjoint goes
from the last iteration back to the first: each starts from the kept rows and sums, all else is computed again.
"""

import hashlib
from pathlib import Path

import numpy as np
from numba import njit

from gran_bench.dem import walls as dem_walls
from gran_bench.dem.fast import wall_list
from gran_bench.neighbors import kernel as emitters
from gran_bench.surrogate.contact import constants
from gran_bench.surrogate.contact.constants import CHANNELS
from gran_bench.surrogate.contact.kernels import block as contact_block
from gran_bench.surrogate.contact.kernels import lanes, particles, surfaces
from gran_bench.surrogate.contact.kernels.block import (
    ANSWER,
    D_ANSWER,
    D_EXTRA_PUSH,
    D_EXTRA_TURN,
    D_GAP,
    D_PUSH,
    D_SHARE,
    D_STIFFNESS,
    D_SUM_A,
    D_SUM_B,
    D_TURN,
    EXTRA_PUSH,
    EXTRA_TURN,
    FADE,
    ONE,
    PUSH,
    ROWS,
    TURN,
    ZERO,
    block_jit,
    respond,
    respond_adjoint,
    row_sum,
)
from gran_bench.surrogate.contact.kernels.lanes import LANES, WIDTH, gathering, lanes_of, scattering
from gran_bench.surrogate.contact.kernels.particles import EXTRA, MOVE, TURNED, mix, mix_adjoint
from gran_bench.surrogate.contact.kernels.surfaces import gather, give_back, hold, of_columns, three_rows

# What a contact gives to i and to j, in the columns of their rows; its adjoint asks the same of theirs.
_GIVEN = three_rows(PUSH, TURN, ANSWER + 3, EXTRA_PUSH, EXTRA_TURN)
_ASKED = three_rows(D_PUSH, D_TURN, D_ANSWER + 3, D_EXTRA_PUSH, D_EXTRA_TURN)
_TO_FIRST = of_columns(0.5, constants.SPIN_RESPONSE, 1.0, 0.5, constants.SPIN_RESPONSE)
_TO_SECOND = of_columns(-0.5, constants.SPIN_RESPONSE, 1.0, -0.5, constants.SPIN_RESPONSE)
_PARTICLE_ROWS = particles.ROWS
_scatter_pairs, _scatter_walls = (scattering(_GIVEN, _TO_FIRST, second) for second in (_TO_SECOND, None))
_seed_pairs, _seed_walls = (gathering(_ASKED, _TO_FIRST, second) for second in (_TO_SECOND, None))


@njit(nogil=True, error_model="numpy")
def iterate(
    contacts, starts, walls, springs, limits, period, gravity, position, guess, spin,
    w1, b1, w2, b2, stiffness, spin_share, mix_weight, mix_bias, states, messages, sums, nearness, holder, outcome,
):  # fmt: skip  # pragma: no cover - jitted
    """All iterations; ``states`` and ``sums`` keep what each started from, ``messages`` the channels before mixing.

    They have room for every iteration where a gradient is wanted, and for one elsewhere. Of the contacts ``(C, 2)``,
    the pairs come first, then those of each wall, each kind from ``starts[k]`` to ``starts[k + 1]``. Each particle's
    ``nearness`` is the largest fade among its contacts before the first iteration, and ``holder`` the contact that has
    it. Of the particles' R rows, a multiple of a block, N are particles; N itself takes what spare lanes give.
    """
    count, keeps = len(position), len(states) > 1
    b, p = np.zeros(ROWS * LANES, np.float32), np.zeros(_PARTICLE_ROWS * LANES, np.float32)
    now, gain = np.zeros(states.shape[1:], np.float32), np.zeros(states.shape[1:], np.float32)
    running, held = np.zeros(sums.shape[1:], np.float32), hold(contacts, starts[1], springs, position, period)
    nearness[:], holder[:] = ZERO, -1
    for i in range(count):
        for m in range(3):
            now[i, MOVE + m], now[i, TURNED + m] = guess[i, m], spin[i, m]
    for k in range(len(w1)):
        slot = k if keeps else 0
        if keeps:
            states[slot], sums[slot] = now, running
        gain[:] = ZERO
        for place in range(len(starts) - 1):
            kind = min(place, 1)
            strength, share = stiffness[k, kind] * np.float32(1 + kind), spin_share[k, kind]
            u1, c1, u2, c2 = w1[k, kind], b1[k, kind], w2[k, kind], b2[k, kind]
            for first in range(starts[place], starts[place + 1], LANES):
                last = min(first + LANES, starts[place + 1])
                gather(b, contacts, first, last, walls, place - 1, now, held, running, limits[4])
                respond(b, limits, kind, strength, share, u1, c1, u2, c2)
                for part in range(0, LANES, WIDTH):
                    if kind == 0:
                        _scatter_pairs(gain, contacts, first, last, count, b, part)
                    else:
                        _scatter_walls(gain, contacts, first, last, count, b, part)
                for c in range(last - first):
                    running[0, first + c] += b[ANSWER * LANES + c]
                    running[1, first + c] += b[(ANSWER + 1) * LANES + c]
                if k == 0:
                    _find_nearest(b, contacts, first, last, 2 - kind, nearness, holder)
        for m in range(WIDTH):
            gain[count, m] = ZERO
        mix(p, now, gain, gravity, nearness, mix_weight[k], mix_bias[k], messages[slot])
    for i in range(count):
        for m in range(3):
            outcome[0, i, m], outcome[1, i, m] = now[i, MOVE + m], now[i, TURNED + m]
            outcome[2, i, m], outcome[3, i, m] = now[i, EXTRA + m], now[i, EXTRA + 3 + m]


@block_jit
def _find_nearest(b, contacts, first, last, ends, nearness, holder):  # pragma: no cover - jitted
    """Which contact of a particle fades least, of those seen so far; ``ends``: 2 of a pair, 1 at a wall."""
    for c in range(last - first):
        fade = b[FADE * LANES + c]
        for end in range(ends):
            i = contacts[first + c, end]
            if fade > nearness[i]:
                nearness[i], holder[i] = fade, first + c


@block_jit
def _nearest_adjoint(b, contacts, first, last, ends, slope, d_nearness, holder):  # pragma: no cover - jitted
    """Adjoint of :func:`_find_nearest`, into D_GAP."""
    for c in range(last - first):
        if ZERO < b[FADE * LANES + c] < ONE:
            for end in range(ends):
                i = contacts[first + c, end]
                if holder[i] == first + c:
                    b[D_GAP * LANES + c] -= slope * d_nearness[i]


@block_jit
def _seed(b, contacts, first, last, before, d_sums, kind):  # pragma: no cover - jitted
    """What the adjoints of particles and sums ask of a block; lanes beyond ``last`` get nothing."""
    for place in range(0, LANES, WIDTH):
        if kind == 0:
            _seed_pairs(b, place, before, contacts, first, last)
        else:
            _seed_walls(b, place, before, contacts, first, last)
        lanes_of(b, place, D_SUM_A, d_sums, 0, first)
        lanes_of(b, place, D_SUM_B, d_sums, 1, first)
    for c in range(last - first, LANES):
        for row in range(D_PUSH, D_ANSWER + 3 + CHANNELS):
            b[row * LANES + c] = ZERO


@njit(nogil=True, error_model="numpy")
def iterate_adjoint(
    contacts, starts, walls, springs, limits, period, gravity, position,
    w1, b1, w2, b2, stiffness, spin_share, mix_weight, mix_bias, states, messages, sums, nearness, holder, before,
    adjoint, d_w1, d_b1, d_w2, d_b2, d_stiffness, d_spin_share, d_mix_weight, d_mix_bias,
):  # fmt: skip  # pragma: no cover - jitted
    """Adjoint of :func:`iterate`; ``adjoint``, of (D, q, h, x), is its seed and its result.

    ``before`` is the seed once more, of (D, q, h, extra translation, extra spin): the extra parts are only ever added
    to, so their adjoint stays what it was. ``d_w1`` is transposed: the units of an input are neighbours.
    """
    count = len(position)
    b, p = np.zeros(ROWS * LANES, np.float32), np.zeros(_PARTICLE_ROWS * LANES, np.float32)
    d_nearness, held = np.zeros(len(nearness), np.float32), hold(contacts, starts[1], springs, position, period)
    d_sums = np.zeros(sums.shape[1:], np.float32)
    for k in range(len(w1) - 1, -1, -1):
        mix_adjoint(
            p, adjoint, before, gravity, nearness, mix_weight[k], mix_bias[k], messages[k], d_nearness,
            d_mix_weight[k], d_mix_bias[k],
        )  # fmt: skip
        for place in range(len(starts) - 1):
            kind = min(place, 1)
            counted, slope = np.float32(1 + kind), ONE / limits[2 * kind + 1]
            strength, share = stiffness[k, kind] * counted, spin_share[k, kind]
            u1, c1, u2, c2 = w1[k, kind], b1[k, kind], w2[k, kind], b2[k, kind]
            d_u1, d_c1, d_u2, d_c2 = d_w1[k, kind], d_b1[k, kind], d_w2[k, kind], d_b2[k, kind]
            for first in range(starts[place], starts[place + 1], LANES):
                last = min(first + LANES, starts[place + 1])
                gather(b, contacts, first, last, walls, place - 1, states[k], held, sums[k], limits[4])
                respond(b, limits, kind, strength, share, u1, c1, u2, c2)
                _seed(b, contacts, first, last, before, d_sums, kind)
                respond_adjoint(b, limits, kind, strength, share, u1, u2, d_u1, d_c1, d_u2, d_c2)
                d_stiffness[k, kind] += counted * row_sum(b, D_STIFFNESS)
                d_spin_share[k, kind] += row_sum(b, D_SHARE)
                if k == 0:
                    _nearest_adjoint(b, contacts, first, last, 2 - kind, slope, d_nearness, holder)
                give_back(b, contacts, first, last, walls, place - 1, adjoint, count)
                for c in range(last - first):
                    d_sums[0, first + c] = b[D_SUM_A * LANES + c]
                    d_sums[1, first + c] = b[D_SUM_B * LANES + c]
        for m in range(WIDTH):
            adjoint[count, m] = ZERO


def _keyed_entries(sources: str):
    """The two entries, cached on disk under the digest of everything that they are compiled from.

    Numba keys its cache by the file of the function alone, and a change of another file would go unnoticed. The
    variables of a closure are part of the key.
    """

    @njit(cache=True, nogil=True, error_model="numpy")
    def forward(*arguments):  # pragma: no cover - jitted
        sources  # noqa: B018 (the key)
        iterate(*arguments)

    @njit(cache=True, nogil=True, error_model="numpy")
    def adjoint(*arguments):  # pragma: no cover - jitted
        sources  # noqa: B018 (the key)
        iterate_adjoint(*arguments)

    return forward, adjoint


def digest_of_sources() -> str:
    """Of the files that the entries are compiled from, as they are on disk now."""
    modules = contact_block, lanes, particles, surfaces, constants, wall_list, dem_walls, emitters
    files = (__file__, *(module.__file__ for module in modules))
    sizes = repr(constants.FUSED_SIZES).encode()
    return hashlib.sha256(b"".join((sizes, *(Path(file).read_bytes() for file in files)))).hexdigest()


frame_forward, frame_adjoint = _keyed_entries(digest_of_sources())
