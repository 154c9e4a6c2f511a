"""What a stretch does where lists are made anew: on a thread's share of the particles, between two marches.

It is done once for tens of steps, so NumPy does what takes little time, and only the rest is jitted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gran_bench.dem.fast.bodies import Known
from gran_bench.dem.fast.contact_list import sorted_pairs, with_margins
from gran_bench.dem.fast.wall_list import list_wall_contacts
from gran_bench.neighbors import IndexArray, list_pairs
from gran_bench.state import FloatArray


class Lists(NamedTuple):
    """Pairs and walls that a thread's spheres may touch, and what they remember, as `stretch.march` takes them.

    Attributes:
        pair_i, pair_j: ``(M,)`` pairs, first < second, in the order of (first, second).
        start: ``(n + 2,)`` place of the first pair of each of n firsts, and of the end of the last.
        memory: ``(M,)`` row of history of each pair; 0 for none.
        slot, moment: ``(2, ≥ M + 5, 4)`` histories of even and odd evaluations: elastic tangential force and overlap,
            rolling moment (one row where there is no rolling).
        wall_i, wall_w, wall_memory: ``(≥ M + 1,)`` particle and wall, ``(M + 1,)`` row of history of each wall contact;
            place 0 is spare.
        wall_start: ``(chunks W + 1,)`` place of the first contact of each chunk and wall.
        wall_slot, wall_moment: as of the pairs.
        margin, inverse_square: ``(N,)`` how far each particle may move until new lists are needed, m, and 1/m².
    """

    pair_i: IndexArray
    pair_j: IndexArray
    start: IndexArray
    memory: IndexArray
    slot: FloatArray
    moment: FloatArray
    wall_i: IndexArray
    wall_w: IndexArray
    wall_memory: IndexArray
    wall_start: IndexArray
    wall_slot: FloatArray
    wall_moment: FloatArray
    margin: FloatArray
    inverse_square: FloatArray


def search(
    sphere: FloatArray,
    velocity: FloatArray,
    bounds: IndexArray,
    chunk: int,
    stop: int,
    walls: FloatArray,
    row: int,
    last: int,
    skin: float,
    period: float,
    known: tuple[Known, Known],
    rolling: bool,
) -> Lists:
    """Lists of the pairs and walls that spheres of ``chunk … stop − 1`` may touch, with what they remember.

    Args:
        sphere, velocity: ``(N + 2, 4)`` x, y, z, r, m, and v, m/s.
        bounds: ``(C + 1,)`` first particle of each chunk.
        chunk, stop: range of chunks.
        walls: ``(steps + 1, W, 22)`` poses.
        row: of the poses that belong to these positions.
        last: step of the last evaluation, these positions' own or the one before.
        skin: m.
        period: of y, m; 0 for none.
        known: pairs and walls by row that touched in the last evaluation.
        rolling: whether rolling moments are remembered.
    """
    count, begin, end = len(sphere) - 2, int(bounds[chunk]), int(bounds[stop])
    pairs, on_walls = known
    # All threads come here between the same two steps, so they find the same margins.
    margin, inverse_square, reaching = with_margins(sphere, velocity, skin)
    first, second = list_pairs(reaching, 0.0, period, begin, end)
    pair_i, pair_j, start, memory = sorted_pairs(first, second, begin, end, count, pairs.first, pairs.second)
    wall_i, wall_w, wall_memory, wall_start = list_wall_contacts(
        sphere, bounds, chunk, stop, walls, row, margin, on_walls.first, on_walls.second
    )
    return Lists(
        pair_i, pair_j, start, memory, *_history(pairs, len(pair_i), last, rolling),
        wall_i, wall_w, wall_memory, wall_start, *_history(on_walls, len(wall_memory), last, rolling),
        margin, inverse_square,
    )  # fmt: skip


def _history(known: Known, contacts: int, evaluation: int, rolling: bool) -> tuple[FloatArray, FloatArray]:
    """Room for the histories of so many contacts; in that of ``evaluation`` rows 1, 2, … are the known ones."""
    rows = max(contacts, len(known.first)) + 5  # row 0, and three lanes of a block that is not full
    slot, moment = np.empty((2, rows, 4)), np.empty((2, rows if rolling else 1, 4))
    for room, remembered in ((slot, known.slot), (moment, known.moment)):
        room[:, 0] = 0.0
        room[evaluation % 2, 1 : len(remembered) + 1] = remembered
    return slot, moment


def touching(
    lists: Lists, near_i: IndexArray, near_j: IndexArray, pairs: IndexArray, walls: IndexArray, evaluation: int
) -> tuple[Known, Known]:
    """The pairs and the walls that an evaluation found touching, with what they remember.

    Args:
        lists: in whose histories they are.
        near_i, near_j: inner list.
        pairs: ``(C,)`` places in it.
        walls: ``(C,)`` places in the list of walls.
        evaluation: its number.
    """
    half = evaluation % 2
    return (
        Known(
            near_i[pairs].astype(np.int64), near_j[pairs].astype(np.int64), lists.slot[half, 1 : len(pairs) + 1],
            lists.moment[half, 1 : len(pairs) + 1],
        ),
        Known(
            lists.wall_i[walls].astype(np.int64), lists.wall_w[walls].astype(np.int64),
            lists.wall_slot[half, 1 : len(walls) + 1], lists.wall_moment[half, 1 : len(walls) + 1],
        ),
    )  # fmt: skip
