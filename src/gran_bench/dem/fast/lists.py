"""Which pairs are looked at, and what they remember (jitted).

Pairs are listed twice, in the order of (first, second). Each particle has a margin m, the larger the faster it is. The
outer list holds the pairs with a gap below m₁ + m₂, the inner one those below a share σ of that. So an inner list is
complete while all displacements since its pruning stay below σ m, and may be pruned while those since the search stay
below (1 − σ) m.

What the touching contacts of an evaluation remember lies densely, in rows 1, 2, … in their order. Each place of a list
has the row of its pair's last touch, and the list of those that touched says whether it was in the last evaluation:
where row r is not place q's, q remembers nothing.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from gran_bench.dem.energy import OWNER
from gran_bench.dem.fast.bodies import Bodies, Known, zeros
from gran_bench.dem.fast.contact_blocks import BUFFER_SIZE, block_buffer, wall_buffer
from gran_bench.dem.fast.rows import squared_gap
from gran_bench.dem.fast.wall_list import list_wall_contacts
from gran_bench.dem.integrate import Physics
from gran_bench.dem.walls import PATH
from gran_bench.neighbors.cells import bin_pairs, find_pairs
from gran_bench.neighbors.kernel import entry, kernel

# σ, what the inner list reaches beyond touch as a share of the margins: so much, or as far as the fastest goes in some
# steps; when less than the least is left of the margins, a search is cheaper.
INNER_SHARE, INNER_STEPS, LEAST_SHARE = 0.2, 4.0, 0.12
# Margin of what rests, as a share of the fastest's: a hit may set it in motion.
LEAST_MARGIN = 0.2
PAIRS_A_PARTICLE = 8  # for which there is room at first
# Rows of a thread's inner list: place of each pair in the outer one, its particles, its row of history.
NEAR, NEAR_I, NEAR_J, NEAR_MEMORY = range(4)
_FIELDS = (
    "pair_i pair_j start memory slot moment wall_i wall_w wall_memory wall_start wall_slot wall_moment margin "
    "inverse_square searched_at pruned_at inner_list touching wall_touching geometry near_start buffer wall_buffer "
    "ledger wall_ledger"
)
# What the lists keep of a contact, as `Known` names it.
KEPT = ("slot", "moment", "ledger")
# What grows with the pairs and with the wall contacts.
_PAIR_ROOM = (*KEPT, "pair_i", "pair_j", "memory", "inner_list", "touching")
_WALL_ROOM = (*(f"wall_{name}" for name in KEPT), "wall_touching", "geometry")


class Lists(namedtuple("Lists", _FIELDS)):
    """Pairs and walls that a thread's spheres may touch, and what they remember, as `stretch.march` takes them.

    All is room that searches fill again and again, for at least M pairs and walls.

    Attributes:
        pair_i, pair_j, memory: ``(≥ M,)`` pairs in the order of (first, second), first < second; row of history, or 0.
        start: ``(n + 2,)`` place of the first pair of each of n firsts, and of the end of the last.
        slot, moment: ``(2, ≥ M + 5, 4)`` histories of even and odd evaluations: elastic tangential force and overlap,
            rolling moment (one row where there is no rolling); row 0 is zero.
        wall_i, wall_w, wall_memory: ``(n W + 2,)`` particle, wall and row of history of each wall contact; place 0 is
            spare.
        wall_start: ``(chunks W + 1,)`` place of the first contact of each chunk and wall.
        wall_slot, wall_moment: as of the pairs.
        margin, inverse_square: ``(N,)`` how far each particle may move until new lists are needed, m, and 1/m².
        searched_at, pruned_at: ``(N, 4)`` rows of the positions that the lists were made for.
        inner_list: ``(4, ≥ M + 5)``; place 0 is the spare pair.
        touching, wall_touching: ``(2, ≥ M + 5)`` places of touching pairs and walls in even and odd evaluations.
        geometry, near_start, buffer, wall_buffer: ``(≥ M + 5, 4)``, ``(chunks + 1,)``, `block_buffer`.
        ledger, wall_ledger: as slot, what contacts have lost and who counts it (energy_blocks.py); one row where nobody
            asks.
    """

    @classmethod
    def of(cls, bodies: Bodies, bounds: np.ndarray, chunk: int, stop: int, walls: int, physics: Physics) -> Lists:
        """Room for the particles of ``chunk … stop − 1`` and so many walls, and nothing in it."""
        count, own, rolling = len(bodies.sphere) - 2, int(bounds[stop] - bounds[chunk]), physics.rolling
        rows, wall_rows = PAIRS_A_PARTICLE * own + 64, own + 64
        slots, wall_slots = (
            [zeros(2, n if wanted else 1, 4) for wanted in (True, rolling, physics.power)] for n in (rows, wall_rows)
        )
        spare = np.array((0, count, count + 1, 0), np.uint32)
        inner_list = np.repeat(spare[:, None], rows, axis=1)
        buffers = zeros(2, BUFFER_SIZE, dtype=np.float32 if physics.single_precision else np.float64)
        (radius, inverse_mass), law = (bodies.sphere[0, 3], bodies.velocity[0, 3]), physics.pair_laws[0, 0]
        block_buffer(buffers[0], radius, inverse_mass, law)
        wall_buffer(buffers[1], radius, inverse_mass, physics.wall_laws[0, 0] if walls else law)
        return cls(
            *np.empty((2, rows), np.uint32), np.empty(own + 2, np.uint32), np.empty(rows, np.uint32), *slots[:2],
            *np.empty((3, own * walls + 2), np.uint32), np.empty((stop - chunk) * walls + 1, np.int64), *wall_slots[:2],
            *np.empty((2, count)), *zeros(2, count, 4), inner_list, np.empty((2, rows), np.uint32),
            np.empty((2, wall_rows), np.uint32), np.empty((wall_rows, 4)), np.ones(stop - chunk + 1, np.int64),
            *buffers, slots[2], wall_slots[2],
        )  # fmt: skip

    def with_room(self, pairs: int, walls: int) -> Lists:
        """The lists with room for so many pairs and wall contacts, and what is in them now."""
        grown = {}
        for wanted, names in ((pairs, _PAIR_ROOM), (walls, _WALL_ROOM)):
            have, wanted = getattr(self, names[0]).shape[1], wanted + 5  # row 0; lanes of a block that is not full
            if have < wanted:
                rooms = {name: getattr(self, name) for name in names}
                grown |= {name: _longer(room, have, wanted) for name, room in rooms.items() if have in room.shape}
        return self._replace(**grown) if grown else self

    def remember(self, known: tuple[Known, Known], evaluation: int) -> Lists:
        """The lists with what was found touching in an evaluation in rows 1, 2, … of its histories."""
        lists = self.with_room(*(len(contacts.first) for contacts in known))
        for kind, contacts in zip(("", "wall_"), known, strict=True):
            for name in KEPT:
                kept = getattr(contacts, name)
                rows = getattr(lists, kind + name)[evaluation % 2, 1 : len(kept) + 1]
                rows[:] = kept
                if name == "ledger" and len(kept):
                    rows[:, OWNER] = contacts.first
        return lists

    def touched(self, evaluation: int, pairs: int, walls: int) -> tuple[np.ndarray, np.ndarray]:
        """First and second particle, ``(2, C)``, of what an evaluation found touching, and particle and wall."""
        near, on_walls = self.touching[evaluation % 2, 1:pairs], self.wall_touching[evaluation % 2, 1:walls]
        return (
            listed_at(near, self.inner_list[NEAR_I], self.inner_list[NEAR_J]),
            listed_at(on_walls, self.wall_i, self.wall_w),
        )


def _longer(array: np.ndarray, length: int, wanted: int) -> np.ndarray:
    """A copy whose axis of a length has another one."""
    axis = array.shape.index(length)
    longer = zeros(*array.shape[:axis], wanted, *array.shape[axis + 1 :], dtype=array.dtype)
    longer[(slice(None),) * axis + (slice(length),)] = array
    return longer


def search(
    lists: Lists, bodies: Bodies, bounds: np.ndarray, chunk: int, stop: int, walls: np.ndarray, row: int, last: int,
    physics: Physics, known: tuple[np.ndarray, np.ndarray],
) -> Lists:  # fmt: skip
    """The lists at ``row`` of the poses for ``chunk … stop − 1``; ``known`` touched in evaluation ``last``."""
    sphere, begin, end = bodies.sphere, int(bounds[chunk]), int(bounds[stop])
    count, period = len(sphere) - 2, physics.period
    # All threads come here between the same two steps, so they find the same margins.
    reaching, margin = lists.pruned_at, lists.margin
    set_margins(sphere, bodies.velocity, physics.skin, margin, lists.inverse_square, lists.searched_at, reaching)
    binned = bin_pairs(reaching, 0.0, period)
    while True:
        # Until it is made, the inner list is room for the pairs as they are found; its place 0 is kept.
        by_second, first, second = lists.inner_list[:3, 1:-4]
        found = find_pairs(reaching, 0.0, period, begin, end, *binned, first, second) if binned else 0
        if found >= 0:
            break
        lists = lists.with_room(2 * len(first), 0)
    sort_pairs(first[:found], second[:found], by_second, begin, count, *known[0], *lists[:4])
    paths = walls[row + 1 :, :, PATH].sum(axis=0)
    on_walls = list_wall_contacts(
        sphere, bounds, chunk, stop, walls[row], paths, margin, *known[1], lists.wall_i, lists.wall_w,
        lists.wall_memory, lists.wall_start, lists.wall_touching[last % 2],
    )  # fmt: skip
    return lists.with_room(0, on_walls)


@entry
def listed_at(places, first, second):
    """``(2, C)`` of what a list has at some places."""
    found = np.empty((2, len(places)), np.int64)
    for c in range(len(places)):
        found[0, c], found[1, c] = first[places[c]], second[places[c]]
    return found


@entry
def set_margins(sphere, velocity, skin, margin, inverse_square, searched_at, reaching):
    """``(N,)`` displacements m that lists have room for, half the skin for the fastest particle, less for slower ones;
    ``(N,)`` 1/m²; ``(N, 4)`` rows, and rows with the margin added to the radius, m.
    """
    fastest = 0.0
    for i in range(len(margin)):
        margin[i] = math.sqrt(velocity[i, 0] ** 2 + velocity[i, 1] ** 2 + velocity[i, 2] ** 2)
        fastest = max(fastest, margin[i])
    for i in range(len(margin)):
        share = margin[i] / fastest if fastest > 0.0 else 1.0
        margin[i] = 0.5 * skin * (LEAST_MARGIN + (1.0 - LEAST_MARGIN) * share)
        inverse_square[i] = 1.0 / (margin[i] * margin[i])
        for k in range(4):
            searched_at[i, k] = reaching[i, k] = sphere[i, k]
        reaching[i, 3] += margin[i]


@entry
def sort_pairs(first, second, by_second, begin, count, known_first, known_second, pair_i, pair_j, start, memory):
    """Pairs in the order of (first, second), and which row of history is whose: ``pair_i … memory`` of `Lists`.

    A counting sort by second, then one by first, which keeps the order among equals. Firsts are in ``begin …``, as many
    as ``start`` has places for, seconds below ``count``; the known pairs touch, and their rows are 1 … C.
    """
    pairs = len(first)
    of_second = np.zeros(count - begin + 1, np.uint32)  # place of the next pair of each second
    start[:] = 0
    memory[:pairs] = 0
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
        if 0 <= row < len(start) - 2:
            for p in range(start[row], start[row + 1]):
                if pair_j[p] == known_second[c]:
                    memory[p] = c + 1


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
