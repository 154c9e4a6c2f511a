"""The tangential springs of contacts over one frame, jitted; the rule is that of the module `contact.memory`.

The first four arguments are of a :class:`~gran_bench.surrogate.contact.geometry.ContactList`, whose contacts have the
keys i N + j, and (N + w) N + i at wall w.
"""

import numpy as np

from gran_bench.dem.fast.wall_list import shape_of, toward_wall
from gran_bench.neighbors.kernel import kernel
from gran_bench.surrogate.contact.constants import SPRING_CAP
from gran_bench.surrogate.contact.kernels.listing import jitted


@jitted
def recall(pairs, near, wall, other_piece, count, keys, springs, result):  # pragma: no cover - jitted
    """Into ``result``, zeros, what a memory with increasing ``keys`` has of each contact, pairs first."""
    place = 0
    for c in range(len(pairs) + len(near)):
        if c < len(pairs):
            key = other = pairs[c, 0] * count + pairs[c, 1]
        else:
            w = c - len(pairs)
            key, other = (count + wall[w]) * count + near[w], (count + other_piece[w]) * count + near[w]
        while place < len(keys) and keys[place] < key:
            place += 1
        found = place
        if other != key and not (found < len(keys) and keys[found] == key):
            key, found = other, np.searchsorted(keys, other)
        if found < len(keys) and keys[found] == key:
            for m in range(3):
                result[c, m] = springs[found, m]


@kernel
def _stretch(spring, normal, motion, spin, overlap, overlap_before, result):  # pragma: no cover - jitted
    """ξ' of one contact into ``result``; ``motion`` is D_j − D_i, ``spin`` is q_i + q_j."""
    before = np.sqrt(spring[0] ** 2 + spring[1] ** 2 + spring[2] ** 2)
    along = spring[0] * normal[0] + spring[1] * normal[1] + spring[2] * normal[2]
    for m in range(3):
        result[m] = spring[m] - along * normal[m]
    flat = np.sqrt(result[0] ** 2 + result[1] ** 2 + result[2] ** 2)
    keep = before / flat if flat > 0.0 else 0.0
    met = overlap / (overlap - overlap_before) if overlap_before < 0.0 else 1.0
    parting = motion[0] * normal[0] + motion[1] * normal[1] + motion[2] * normal[2]
    for m in range(3):
        p, q = (m + 1) % 3, (m + 2) % 3
        rolling = spin[p] * normal[q] - spin[q] * normal[p]
        result[m] = keep * result[m] + met * (motion[m] - parting * normal[m] - rolling)
    length = np.sqrt(result[0] ** 2 + result[1] ** 2 + result[2] ** 2)
    longest = SPRING_CAP * overlap
    if length > longest:
        for m in range(3):
            result[m] *= longest / length


@jitted
def stretch(
    pairs, near, wall, other_piece, start, end, spin, diameter, period, before, after, turn, shift, springs, keys,
    result,
):  # fmt: skip  # pragma: no cover - jitted
    """Keys and ξ' of the contacts that touch at the frame's end, pairs first, and how many there are.

    ``before`` to ``shift`` are of the list's walls; start, end and spin ``(N, 3)`` positions at the frame's two ends
    and q, in d/50; springs ξ of all contacts.
    """
    found, count = 0, len(start)
    normal, back, motion, turned = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for c in range(len(pairs) + len(near)):
        if c < len(pairs):
            i, j = pairs[c]
            key = i * count + j
            for m in range(3):
                normal[m] = end[j, m] - end[i, m]
                back[m] = start[j, m] - start[i, m]
                turned[m] = spin[i, m] + spin[j, m]
            if period > 0.0:
                normal[1] -= period * np.floor(normal[1] / period + 0.5)
                back[1] -= period * np.floor(back[1] / period + 0.5)
            distance = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
            if distance >= diameter or distance == 0.0:
                continue
            apart = np.sqrt(back[0] ** 2 + back[1] ** 2 + back[2] ** 2)
            overlap, overlap_before = diameter - distance, diameter - apart
            for m in range(3):
                motion[m] = normal[m] - back[m]
                normal[m] /= distance
        else:
            i, w, other = near[c - len(pairs)], wall[c - len(pairs)], other_piece[c - len(pairs)]
            key = (count + w) * count + i
            distance, normal[0], normal[1], normal[2] = toward_wall(shape_of(after, w), end[i, 0], end[i, 1], end[i, 2])
            if distance >= 0.5 * diameter:
                continue
            for m in range(3):
                back[m] = end[i, m] - start[i, m]
                turned[m] = spin[i, m]
            if period > 0.0:
                back[1] -= period * np.floor(back[1] / period + 0.5)
            for m in range(3):
                motion[m] = shift[w, m] - back[m]
                for p in range(3):
                    motion[m] += turn[w, m, p] * (end[i, p] + distance * normal[p])
            apart = toward_wall(shape_of(before, w), start[i, 0], start[i, 1], start[i, 2])[0]
            if other != w:  # over a seam
                apart = min(apart, toward_wall(shape_of(before, other), start[i, 0], start[i, 1], start[i, 2])[0])
            overlap, overlap_before = 0.5 * diameter - distance, 0.5 * diameter - apart
        _stretch(springs[c], normal, motion, turned, overlap, overlap_before, result[found])
        keys[found] = key
        found += 1
    return found
