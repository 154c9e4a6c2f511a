"""The tangential springs of contacts over one frame, jitted; the rule is that of the module contact_memory.

Lengths are in mm. Each result is zero, and ``touches`` False, where a contact does not touch at the end of the frame.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gran_bench import dem, neighbors
from gran_bench.dem.fast.wall_list import shape_of, toward_wall
from gran_bench.neighbors.kernel import cached, kernel
from gran_bench.surrogate.contact.constants import SPRING_CAP

jitted = cached(*(Path(room).parent for room in (__file__, dem.__file__, neighbors.__file__)), nogil=True)


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
def stretch_pairs(pairs, start, end, spin, diameter, period, springs, result, touches):  # pragma: no cover - jitted
    """ξ' of the pairs: ``start`` and ``end`` are positions, ``spin`` is q, all ``(N, 3)``."""
    normal, before, motion, turn = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for c in range(len(pairs)):
        i, j = pairs[c]
        for m in range(3):
            normal[m] = end[j, m] - end[i, m]
            before[m] = start[j, m] - start[i, m]
            turn[m] = spin[i, m] + spin[j, m]
        if period > 0.0:
            normal[1] -= period * np.floor(normal[1] / period + 0.5)
            before[1] -= period * np.floor(before[1] / period + 0.5)
        distance = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        if distance >= diameter or distance == 0.0:
            continue
        apart = np.sqrt(before[0] ** 2 + before[1] ** 2 + before[2] ** 2)
        for m in range(3):
            motion[m] = normal[m] - before[m]
            normal[m] /= distance
        _stretch(springs[c], normal, motion, turn, diameter - distance, diameter - apart, result[c])
        touches[c] = True


@jitted
def stretch_walls(
    near, wall, other_piece, start, end, spin, radius, period, before, after, turn, shift, springs, result, touches
):  # fmt: skip  # pragma: no cover - jitted
    """ξ' of the particles ``near`` walls, whose touched point c moves by ``turn`` c + ``shift``.

    Args:
        wall, other_piece: ``(C,)`` index of the wall of each, and of the piece that it may come from over a seam.
        before, after: ``(W, 11)`` shapes at the frame's two ends.
        turn, shift: ``(W, 3, 3)`` and ``(W, 3)``.
    """
    normal, motion, moved = np.empty(3), np.empty(3), np.empty(3)
    for c in range(len(near)):
        i, w = near[c], wall[c]
        distance, normal[0], normal[1], normal[2] = toward_wall(shape_of(after, w), end[i, 0], end[i, 1], end[i, 2])
        if distance >= radius:
            continue
        for m in range(3):
            moved[m] = end[i, m] - start[i, m]
        if period > 0.0:
            moved[1] -= period * np.floor(moved[1] / period + 0.5)
        for m in range(3):
            motion[m] = shift[w, m] - moved[m]
            for p in range(3):
                motion[m] += turn[w, m, p] * (end[i, p] + distance * normal[p])
        apart = toward_wall(shape_of(before, w), start[i, 0], start[i, 1], start[i, 2])[0]
        if other_piece[c] != w:
            from_there = toward_wall(shape_of(before, other_piece[c]), start[i, 0], start[i, 1], start[i, 2])[0]
            apart = min(apart, from_there)
        _stretch(springs[c], normal, motion, spin[i], radius - distance, radius - apart, result[c])
        touches[c] = True
