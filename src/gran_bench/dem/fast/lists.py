"""Which pairs are looked at, and what they remember (jitted).

Pairs are listed twice, in the order of (first, second). Each particle has a margin m, the larger the faster it is. The
outer list holds the pairs with a gap below m₁ + m₂, the inner one those below a share σ of that. So an inner list is
complete while all displacements since its pruning stay below σ m, and may be pruned while those since the search stay
below (1 − σ) m.

What the touching contacts of an evaluation remember lies densely, in rows 1, 2, … in their order. Each place of a list
has the row of its pair's last touch, and the list of those that touched says whether it was in the last evaluation:
where row r is not place q's, q remembers nothing.
"""

import math
from collections import namedtuple

import numpy as np

from gran_bench.dem.fast.bodies import Bodies, Known
from gran_bench.dem.fast.contact_blocks import BUFFER_SIZE, block_buffer
from gran_bench.dem.fast.energy_blocks import ledger_room
from gran_bench.dem.fast.rows import squared_gap
from gran_bench.dem.fast.wall_list import list_wall_contacts
from gran_bench.dem.integrate import Physics
from gran_bench.dem.walls import PATH
from gran_bench.neighbors import list_pairs
from gran_bench.neighbors.kernel import entry, kernel
from gran_bench.state import FloatArray

# σ, what the inner list reaches beyond touch as a share of the margins.
INNER_SHARE = 0.2
# Margin of what rests, as a share of the fastest's: a hit may set it in motion.
LEAST_MARGIN = 0.2
# Rows of a thread's inner list: place of each pair in the outer one, its particles, its row of history.
NEAR, NEAR_I, NEAR_J, NEAR_MEMORY = range(4)
_FIELDS = (
    "pair_i pair_j start memory slot moment wall_i wall_w wall_memory wall_start wall_slot wall_moment margin "
    "inverse_square searched_at pruned_at inner_list touching wall_touching geometry near_start buffer wall_buffer "
    "ledger wall_ledger"
)


class Lists(namedtuple("Lists", _FIELDS)):
    """Pairs and walls that a thread's spheres may touch, and what they remember, as `stretch.march` takes them.

    Attributes:
        pair_i, pair_j, memory: ``(M,)`` pairs in the order of (first, second), first < second; row of history, or 0.
        start: ``(n + 2,)`` place of the first pair of each of n firsts, and of the end of the last.
        slot, moment: ``(2, ≥ M + 5, 4)`` histories of even and odd evaluations: elastic tangential force and overlap,
            rolling moment (one row where there is no rolling).
        wall_i, wall_w, wall_memory: ``(≥ M + 1,)`` particle and wall, ``(M + 1,)`` row of history of each wall contact;
            place 0 is spare.
        wall_start: ``(chunks W + 1,)`` place of the first contact of each chunk and wall.
        wall_slot, wall_moment: as of the pairs.
        margin, inverse_square: ``(N,)`` how far each particle may move until new lists are needed, m, and 1/m².
        searched_at, pruned_at: ``(N, 4)`` rows of the positions that the lists were made for, and room for others.
        inner_list: ``(4, ≥ M + 2)`` room, but for place 0, which is the spare pair.
        touching, wall_touching: ``(2, ≥ M + 5)`` room for the places of touching pairs and walls in even and odd
            evaluations; those of walls that remember something are there.
        geometry, near_start, buffer, wall_buffer: ``(≥ M + 5, 4)`` room, ``(chunks + 1,)`` ones, `block_buffer`.
        ledger, wall_ledger: as slot, what contacts have lost (energy_blocks.py); None where nobody asks.
    """

    def known(self, half: int, pairs: int, walls: int) -> tuple[Known, Known]:
        """What the even or the odd evaluation found touching, so many pairs and walls less one, and its memory."""
        near, on_walls = self.touching[half, 1:pairs], self.wall_touching[half, 1:walls]
        first, second = self.inner_list[NEAR_I][near], self.inner_list[NEAR_J][near]
        particle, wall = self.wall_i[on_walls], self.wall_w[on_walls]
        return (
            Known(first.astype(np.int64), second.astype(np.int64), self.slot[half, 1:pairs],
                  self.moment[half, 1:pairs], _ledger_rows(self.ledger, half, pairs)),
            Known(particle.astype(np.int64), wall.astype(np.int64), self.wall_slot[half, 1:walls],
                  self.wall_moment[half, 1:walls], _ledger_rows(self.wall_ledger, half, walls)),
        )  # fmt: skip


def search(
    bodies: Bodies, bounds: np.ndarray, chunk: int, stop: int, walls: np.ndarray, row: int, last: int,
    physics: Physics, known: tuple[Known, Known],
) -> Lists:  # fmt: skip
    """The lists at ``row`` of the poses for ``chunk … stop − 1``; ``known`` touched in evaluation ``last``."""
    sphere, velocity, rolling = bodies.sphere, bodies.velocity, physics.rolling
    count, begin, end = len(sphere) - 2, int(bounds[chunk]), int(bounds[stop])
    pairs, on_walls = known
    # All threads come here between the same two steps, so they find the same margins.
    margin, inverse_square, reaching = with_margins(sphere, velocity, physics.skin)
    first, second = list_pairs(reaching, 0.0, physics.period, begin, end)
    pair_i, pair_j, start, memory = sorted_pairs(first, second, begin, end, count, pairs.first, pairs.second)
    paths = walls[row + 1 :, :, PATH].sum(axis=0)
    wall_i, wall_w, wall_memory, wall_start = list_wall_contacts(
        sphere, bounds, chunk, stop, walls[row], paths, margin, on_walls.first, on_walls.second
    )
    slot, moment = _history(pairs, len(pair_i), last, rolling)
    wall_slot, wall_moment = _history(on_walls, len(wall_memory), last, rolling)
    inner, wall_touching = np.empty((4, slot.shape[1]), np.uint32), np.empty((2, wall_slot.shape[1]), np.uint32)
    inner[:, 0] = 0, count, count + 1, 0
    wall_touching[last % 2, wall_memory] = np.arange(len(wall_memory))
    ledgers = (
        ledger_room(kind, room.shape[1], last) if physics.power else None
        for kind, room in ((pairs, slot), (on_walls, wall_slot))
    )
    buffers = zeros(2, BUFFER_SIZE, dtype=np.float32 if physics.single_precision else np.float64)
    return Lists(
        pair_i, pair_j, start, memory, slot, moment, wall_i, wall_w, wall_memory, wall_start, wall_slot, wall_moment,
        margin, inverse_square, sphere.copy(), np.empty_like(sphere), inner, np.empty((2, slot.shape[1]), np.uint32),
        wall_touching, zeros(wall_slot.shape[1], 4), np.ones(stop - chunk + 1, np.int64),
        *(block_buffer(buffer, sphere[0, 3], velocity[0, 3], physics.pair_laws[0, 0]) for buffer in buffers),
        *ledgers,
    )  # fmt: skip


def _ledger_rows(ledger: FloatArray | None, half: int, end: int) -> FloatArray:
    return np.zeros((end - 1, 0)) if ledger is None else ledger[half, 1:end]


def _history(known: Known, contacts: int, evaluation: int, rolling: bool) -> tuple[np.ndarray, np.ndarray]:
    """Room for the histories of so many contacts; in the room of ``evaluation`` rows 1, 2, … are the known ones."""
    rows = max(contacts, len(known.first)) + 5  # row 0, and three lanes of a block that is not full
    slot, moment = np.empty((2, rows, 4)), np.empty((2, rows if rolling else 1, 4))
    for room, remembered in ((slot, known.slot), (moment, known.moment)):
        room[:, 0] = 0.0
        room[evaluation % 2, 1 : len(remembered) + 1] = remembered
    return slot, moment


def zeros(*shape: int, dtype: type = np.float64) -> np.ndarray:
    """Zeros from the beginning of a cache line on: rows and columns that cross lines take a tenth longer."""
    size, line = math.prod(shape) * np.dtype(dtype).itemsize, 64
    room = np.zeros(size + line, np.uint8)
    skipped = -room.__array_interface__["data"][0] % line
    return room[skipped : skipped + size].view(dtype).reshape(shape)


def with_margins(sphere: FloatArray, velocity: FloatArray, skin: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``(N,)`` displacements m that lists have room for, half the skin for the fastest particle, less for slower ones;
    ``(N,)`` 1/m²; ``(N, 4)`` x, y, z and radius with margin, m.
    """
    speed = np.sqrt(np.einsum("nk,nk->n", velocity[:-2, :3], velocity[:-2, :3]))
    share = speed / speed.max() if speed.any() else 1.0 + speed
    margin = 0.5 * skin * (LEAST_MARGIN + (1.0 - LEAST_MARGIN) * share)
    reaching = sphere[:-2].copy()
    reaching[:, 3] += margin
    return margin, 1.0 / (margin * margin), reaching


@entry
def sorted_pairs(first, second, begin, end, count, known_first, known_second):
    """Pairs in the order of (first, second), and which row of history is whose: ``pair_i … memory`` of `Lists`.

    A counting sort by second, then one by first, which keeps the order among equals. Firsts are in ``begin … end − 1``,
    seconds below ``count``; the known pairs touch, and their rows are 1 … C.
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
    """Fills ``near`` from ``found`` on with the places of overlapping pairs, one more must fit; returns the new end."""
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
