"""Which pairs are looked at, and what they remember (jitted).

Pairs are listed twice. The outer list reaches a margin beyond touch and is rarely searched for. The inner list is
pruned from it often and at little cost; only its pairs are looked at in a step.

Each particle has a margin m of its own, the larger the faster it is: two lists are complete while no displacement
exceeds it, and those that hardly move need no room. The outer list holds the pairs with a gap below m₁ + m₂, the inner
one those below a share σ of that. So an inner list is complete while all displacements since its pruning stay below
σ m, and may be pruned while those since the search stay below (1 − σ) m.

Both lists are in the order of (first, second), so neither skin nor time of a search changes a bit of the result.

What the touching contacts of an evaluation remember lies densely, in rows 1, 2, … in their order. Each place of a list
has the row of its pair's last touch, and the list of those that touched says whether it was in the last evaluation:
where row r is not place q's, q remembers nothing. So histories stay in the cache, and parting costs nothing.
"""

from __future__ import annotations

import math

import numpy as np

from gran_bench.dem.fast.rows import squared_gap
from gran_bench.neighbors.kernel import entry, kernel
from gran_bench.state import FloatArray

# σ, what the inner list reaches beyond touch as a share of the margins.
INNER_SHARE = 0.2
# Margin of what rests, as a share of the fastest's: a hit may set it in motion.
LEAST_MARGIN = 0.2


def with_margins(sphere: FloatArray, velocity: FloatArray, skin: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Displacements that lists have room for: half the skin for the fastest particle, less for slower ones.

    Returns:
        ``(N,)`` margins m, m; ``(N,)`` 1/m², which displacements are held against; ``(N, 4)`` x, y, z and radius with
        margin, m.
    """
    speed = np.sqrt(np.einsum("nk,nk->n", velocity[:-2, :3], velocity[:-2, :3]))
    share = speed / speed.max() if speed.any() else 1.0 + speed
    margin = 0.5 * skin * (LEAST_MARGIN + (1.0 - LEAST_MARGIN) * share)
    reaching = sphere[:-2].copy()
    reaching[:, 3] += margin
    return margin, 1.0 / (margin * margin), reaching


@entry
def sorted_pairs(first, second, begin, end, count, known_first, known_second):
    """Pairs in the order of (first, second), and which row of history is whose.

    A counting sort by second, then one by first, which keeps the order among equals. Firsts are in ``begin … end − 1``,
    seconds below ``count``; the known pairs touch, and their rows are 1 … C.

    Returns:
        ``(M,)`` first and second, ``(end − begin + 2,)`` place of each first's first pair and of the end of the last's,
        ``(M,)`` row of history.
    """
    pairs = len(first)
    by_second, pair_i, pair_j = np.empty(pairs, np.uint32), np.empty(pairs, np.uint32), np.empty(pairs, np.uint32)
    memory, start = np.zeros(pairs, np.uint32), np.zeros(end - begin + 2, np.uint32)
    of_second = np.zeros(count - begin + 1, np.uint32)  # place of the next pair of each second
    for p in range(pairs):
        of_second[second[p] - begin + 1] += 1
        start[first[p] - begin + 2] += 1  # shifted by one, so that filling it leaves it where it should be
    for row in range(1, len(of_second)):
        of_second[row] += of_second[row - 1]
    for row in range(2, len(start)):
        start[row] += start[row - 1]
    for p in range(pairs):
        row = second[p] - begin
        by_second[of_second[row]] = p
        of_second[row] += 1
    for q in range(pairs):
        p = by_second[q]
        row = first[p] - begin + 1
        pair_i[start[row]], pair_j[start[row]] = first[p], second[p]
        start[row] += 1
    for c in range(len(known_first)):
        row = known_first[c] - begin
        if 0 <= row < end - begin:
            for p in range(start[row], start[row + 1]):
                if pair_j[p] == known_second[c]:
                    memory[p] = c + 1
    return pair_i, pair_j, start, memory


@kernel
def overlapping(sphere, first, second, begin, end, period, near, found):
    """Fills ``near`` from ``found`` on with the places of pairs ``begin … end − 1`` that overlap; returns the new end.

    One more than are looked at must fit.
    """
    # Written always, kept only if near: no branch to mispredict.
    if period > 0.0:
        for p in range(begin, end):
            near[found] = p
            found += wrapped_gap(sphere, first[p], second[p], period) < 0.0
    else:
        for p in range(begin, end):
            near[found] = p
            found += squared_gap(sphere, first[p], second[p]) < 0.0
    return found


@kernel
def wrapped_gap(sphere, i, j, period):
    """``squared_gap`` with y taken to the nearest image, m²."""
    dx, dy, dz = sphere[j, 0] - sphere[i, 0], sphere[j, 1] - sphere[i, 1], sphere[j, 2] - sphere[i, 2]
    dy -= period * np.rint(dy / period)
    reach = sphere[i, 3] + sphere[j, 3]
    return dx * dx + dy * dy + dz * dz - reach * reach


@kernel
def largest_displacement(sphere, reference, inverse_square, begin, end):
    """max ‖x − x_ref‖ / m over the particles ``begin … end − 1``; ``reference`` has their rows, 1/m² is given."""
    largest = 0.0
    for i in range(begin, end):
        dx, dy, dz = sphere[i, 0] - reference[i, 0], sphere[i, 1] - reference[i, 1], sphere[i, 2] - reference[i, 2]
        largest = max(largest, (dx * dx + dy * dy + dz * dz) * inverse_square[i])
    return math.sqrt(largest)
