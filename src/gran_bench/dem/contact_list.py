"""Which contacts are looked at, and what they remember when the lists change (jitted).

Pairs are listed twice. The outer list reaches a whole skin beyond touch; it is rarely searched for and holds the
history in the slot of each pair. The inner list is pruned from it often and at little cost; only its pairs are looked
at in a step. With D the largest displacement, an inner list is complete while 2 D since its pruning stays below its
reach, and may be pruned while 2 D since the search stays below what the skin has beyond that reach.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gran_bench.neighbors import list_pairs

# Reach of the inner list beyond touch, as a share of the skin.
INNER_SHARE = 0.25
# Columns of a slot and of a known contact: elastic tangential force, overlap, rolling moment.
FORCE, OVERLAP, MOMENT = 0, 3, 4


@njit(error_model="numpy")
def list_contacts(sphere, wall_i, wall_w, skin, period, known_first, known_second, known, evaluation, rolling):
    """Pairs and wall contacts within the skin, with the history of the known contacts in their slots.

    Args:
        sphere: ``(N, 4)`` x, y, z, r, m.
        wall_i, wall_w: ``(M,)`` particles and walls that may touch (:func:`wall_contacts.near_walls`).
        skin: m.
        period: of y, m; 0 for none.
        known_first, known_second: ``(C,)`` contacts that touch, first < second; wall w is the second −1 − w.
        known: ``(C, 7)`` what they remember.
        evaluation: number of the force evaluation that knew them.
        rolling: whether slots need room for the rolling moment.

    Returns:
        For pairs, then for walls: ``(M,)`` first, ``(M,)`` second or wall, ``(M, 4)`` or ``(M, 7)`` slots, and
        ``(M,)`` number of the evaluation that last touched, −1 for none.
    """
    pair_i, pair_j = list_pairs(sphere, skin, period)
    columns = 7 if rolling else 4
    pair_slot, wall_slot = np.zeros((len(pair_i), columns)), np.zeros((len(wall_i), columns))
    pair_touched, wall_touched = np.full(len(pair_i), -1, np.int32), np.full(len(wall_i), -1, np.int32)
    # Known contacts of each first particle as a chain.
    head, following = np.full(len(sphere), -1, np.int32), np.empty(len(known_first), np.int32)
    for c in range(len(known_first)):
        following[c] = head[known_first[c]]
        head[known_first[c]] = c
    # A pair that no longer touches has nothing to remember, so only the few that touch are looked up.
    touching = np.empty(len(pair_i) + 1, np.uint32)
    for q in range(prune(sphere, pair_i, pair_j, 0.0, period, touching)):
        p = touching[q]
        c = head[pair_i[p]]
        while c >= 0 and known_second[c] != pair_j[p]:
            c = following[c]
        if c >= 0:
            for k in range(columns):
                pair_slot[p, k] = known[c, k]
            pair_touched[p] = evaluation
    for p in range(len(wall_i)):
        c = head[wall_i[p]]
        while c >= 0 and known_second[c] != -1 - np.int64(wall_w[p]):
            c = following[c]
        if c >= 0:
            for k in range(columns):
                wall_slot[p, k] = known[c, k]
            wall_touched[p] = evaluation
    return pair_i, pair_j, pair_slot, pair_touched, wall_i, wall_w, wall_slot, wall_touched


@njit(error_model="numpy")
def touching_contacts(
    pair_i, pair_j, pair_slot, pair_touched, wall_i, wall_w, wall_slot, wall_touched, evaluation
):  # fmt: skip
    """The contacts that an evaluation found touching: ``(C,)`` first, ``(C,)`` second, ``(C, 7)`` memory."""
    pairs, pair_count = _where(pair_touched, evaluation)
    contacts, wall_count = _where(wall_touched, evaluation)
    count, columns = pair_count + wall_count, pair_slot.shape[1]
    first, second, known = np.empty(count, np.int64), np.empty(count, np.int64), np.zeros((count, 7))
    for c in range(pair_count):
        p = pairs[c]
        first[c], second[c] = pair_i[p], pair_j[p]
        for k in range(columns):
            known[c, k] = pair_slot[p, k]
    for w in range(wall_count):
        p, c = contacts[w], pair_count + w
        first[c], second[c] = wall_i[p], -1 - np.int64(wall_w[p])
        for k in range(columns):
            known[c, k] = wall_slot[p, k]
    return first, second, known


@njit(error_model="numpy")
def _where(touched, evaluation):
    """Slots that an evaluation touched, and their number."""
    slots, found = np.empty(len(touched) + 1, np.uint32), 0
    for p in range(len(touched)):
        slots[found] = p
        found += touched[p] == evaluation
    return slots, found


@njit(error_model="numpy")
def prune(sphere, pair_i, pair_j, reach, period, near):
    """Fills ``near`` with the places of the pairs whose surfaces are closer than ``reach``; returns their number.

    Args:
        sphere: ``(N, 4)`` x, y, z, r, m.
        pair_i, pair_j: ``(M,)`` outer list.
        reach: m; 0 finds those that touch.
        period: of y, m; 0 for none.
        near: ``(≥ M + 1,)`` written here.
    """
    found = 0
    for p in range(len(pair_i)):
        i, j = pair_i[p], pair_j[p]
        dx = sphere[j, 0] - sphere[i, 0]
        dy = sphere[j, 1] - sphere[i, 1]
        dz = sphere[j, 2] - sphere[i, 2]
        if period > 0.0:
            dy -= period * np.rint(dy / period)
        closer = sphere[i, 3] + sphere[j, 3] + reach
        # Written always, kept only if near: no branch to mispredict.
        near[found] = p
        found += dx * dx + dy * dy + dz * dz < closer * closer
    return found


@njit(error_model="numpy")
def largest_displacement(sphere, reference):
    """max ‖x − x_ref‖ over the particles, m."""
    largest = 0.0
    for i in range(len(sphere)):
        dx, dy, dz = sphere[i, 0] - reference[i, 0], sphere[i, 1] - reference[i, 1], sphere[i, 2] - reference[i, 2]
        largest = max(largest, dx * dx + dy * dy + dz * dz)
    return math.sqrt(largest)
