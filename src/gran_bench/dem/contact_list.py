"""Which contacts are looked at, and what they remember when the lists change (jitted).

Pairs are listed twice. The outer list reaches a whole skin beyond touch; it is rarely searched for and holds the
history in the slot of each pair. The inner list is pruned from it often and at little cost; only its pairs are looked
at in a step. With D the largest displacement, an inner list is complete while 2 D since its pruning stays below its
reach, and may be pruned while 2 D since the search stays below what the skin has beyond that reach.

Both lists are in the order of (first, second), whatever the skin and whenever they were made. So forces are summed in
one order, and neither skin nor time of a search changes a bit of the result.
"""

from __future__ import annotations

import math

import numpy as np

from gran_bench.dem.kernel import kernel, never, places, quads
from gran_bench.dem.rows import squared_gap
from gran_bench.neighbors import list_pairs

# Reach of the inner list beyond touch, as a share of the skin.
INNER_SHARE = 0.25
# Columns of a known contact: elastic tangential force, overlap, rolling moment.
OVERLAP, ROLLING_MOMENT = 3, 4


@kernel
def list_contacts(sphere, count, begin, end, skin, period, known_first, known_second, known, evaluation, rolling):
    """The pairs within the skin whose first particle is in ``begin … end − 1``, with the history of known contacts.

    Args:
        sphere: ``(N + 2, 4)`` x, y, z, r, m.
        count: N.
        begin, end: range of the first particles.
        skin: m.
        period: of y, m; 0 for none.
        known_first, known_second: ``(C,)`` contacts that touch, first < second; walls have negative seconds.
        known: ``(C, 7)`` what they remember.
        evaluation: number of the force evaluation that knew them.
        rolling: whether rolling moments are remembered.

    Returns:
        ``(M + 1,)`` first and second, ``(end − begin + 1,)`` place of each first's first pair, ``(M + 1, 4)`` slots
        (force, overlap), ``(M + 1 or 1, 4)`` rolling moments and ``(M + 1,)`` number of the evaluation that last
        touched, −1 for none. The last place is spare: the pair of the spare bodies N and N + 1.
    """
    first, second = list_pairs(sphere[:count], skin, period, begin, end)
    pair_i, pair_j, start = _sorted_pairs(first, second, begin, end, count)
    slot, moment, touched = no_memory(len(pair_i), rolling)
    for c in range(len(known_first)):
        row = known_first[c] - begin
        if 0 <= row < end - begin and known_second[c] >= 0:
            p = start[row]
            while p < start[row + 1] and pair_j[p] != known_second[c]:
                p += 1
            if p < start[row + 1]:
                remind(slot, moment, touched, p, known, c, evaluation, rolling)
    return pair_i, pair_j, start, slot, moment, touched


@kernel
def no_memory(contacts, rolling):
    """Slots, rolling moments and numbers of the last touch of contacts that remember nothing."""
    moment = quads(contacts if rolling else 1)
    for p in range(len(moment)):
        for k in range(4):
            moment[p, k] = 0.0
    return quads(contacts), moment, never(contacts)


@kernel
def remind(slot, moment, touched, p, known, c, evaluation, rolling):
    """Contact p remembers what known contact c does."""
    for k in range(4):
        slot[p, k] = known[c, k]
    if rolling:
        for k in range(3):
            moment[p, k] = known[c, ROLLING_MOMENT + k]
    touched[p] = evaluation


@kernel
def _sorted_pairs(first, second, begin, end, count):
    """Pairs in the order of (first, second), the spare pair (N, N + 1) after them, and where each first's begin.

    A counting sort by second, then one by first, which keeps the order among equals.
    """
    pairs = len(first)
    by_second, start = places(pairs), np.zeros(count - begin + 1, np.uint32)
    for p in range(pairs):
        start[second[p] - begin + 1] += 1
    for row in range(count - begin):
        start[row + 1] += start[row]
    for p in range(pairs):
        row = second[p] - begin
        by_second[start[row]] = p
        start[row] += 1
    start = np.zeros(end - begin + 2, np.uint32)  # shifted by one, so that filling it leaves it where it should be
    for p in range(pairs):
        start[first[p] - begin + 2] += 1
    for row in range(end - begin):
        start[row + 2] += start[row + 1]
    pair_i, pair_j = places(pairs + 1), places(pairs + 1)
    for q in range(pairs):
        p = by_second[q]
        row = first[p] - begin + 1
        pair_i[start[row]], pair_j[start[row]] = first[p], second[p]
        start[row] += 1
    pair_i[pairs], pair_j[pairs] = count, count + 1
    return pair_i, pair_j, start[: end - begin + 1].copy()


@kernel
def touching_contacts(
    pair_i, pair_j, slot, moment, touched, wall_i, wall_w, wall_slot, wall_moment, wall_touched, evaluation
):  # fmt: skip
    """The contacts that an evaluation found touching, pairs and then walls.

    Returns:
        ``(C,)`` first, ``(C,)`` second (−1 − w for wall w), ``(C, 7)`` what they remember.
    """
    count = np.int64(0)
    for p in range(len(touched) - 1):
        count += touched[p] == evaluation
    pairs = count
    for p in range(len(wall_touched) - 1):
        count += wall_touched[p] == evaluation
    first, second, known = np.empty(count, np.int64), np.empty(count, np.int64), np.zeros((count, 7))
    _copy_touching(pair_i, pair_j, False, slot, moment, touched, evaluation, first, second, known, np.int64(0))
    _copy_touching(wall_i, wall_w, True, wall_slot, wall_moment, wall_touched, evaluation, first, second, known, pairs)
    return first, second, known


@kernel
def _copy_touching(pair_i, pair_j, walls, slot, moment, touched, evaluation, first, second, known, c):
    """Writes the contacts that an evaluation found touching from place c on; wall w is the second −1 − w."""
    for p in range(len(touched) - 1):
        if touched[p] == evaluation:
            j = np.int64(pair_j[p])
            first[c], second[c] = pair_i[p], -1 - j if walls else j
            for k in range(4):
                known[c, k] = slot[p, k]
            if len(moment) > 1:
                for k in range(3):
                    known[c, ROLLING_MOMENT + k] = moment[p, k]
            c += 1


@kernel
def closer(sphere, pair_i, pair_j, among, reach, period, near):
    """Fills ``near`` with the pairs whose surfaces are closer than ``reach``, in their order; returns their number.

    Args:
        sphere: ``(N + 2, 4)`` x, y, z, r, m.
        pair_i, pair_j: ``(M + 1,)`` outer list.
        among: places in it that are looked at.
        reach: m; 0 finds those that touch.
        period: of y, m; 0 for none.
        near: places written here; one more than are looked at must fit.
    """
    found = 0
    # Written always, kept only if near: no branch to mispredict.
    if period > 0.0:
        for p in among:
            near[found] = p
            found += wrapped_gap(sphere, pair_i[p], pair_j[p], reach, period) < 0.0
    else:
        for p in among:
            near[found] = p
            found += squared_gap(sphere, pair_i[p], pair_j[p], reach) < 0.0
    return found


@kernel
def wrapped_gap(sphere, i, j, margin, period):
    """``squared_gap`` with y taken to the nearest image, m²."""
    dx, dy, dz = sphere[j, 0] - sphere[i, 0], sphere[j, 1] - sphere[i, 1], sphere[j, 2] - sphere[i, 2]
    dy -= period * np.rint(dy / period)
    reach = sphere[i, 3] + sphere[j, 3] + margin
    return dx * dx + dy * dy + dz * dz - reach * reach


@kernel
def largest_displacement(sphere, reference, begin, end):
    """max ‖x − x_ref‖ over the particles ``begin … end − 1``, m; ``reference`` begins with particle ``begin``."""
    largest = 0.0
    for i in range(begin, end):
        dx, dy = sphere[i, 0] - reference[i - begin, 0], sphere[i, 1] - reference[i - begin, 1]
        dz = sphere[i, 2] - reference[i - begin, 2]
        largest = max(largest, dx * dx + dy * dy + dz * dz)
    return math.sqrt(largest)
