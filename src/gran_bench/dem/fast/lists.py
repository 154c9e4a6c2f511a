"""What a stretch does where lists are made anew: on a thread's share of the particles, between two marches."""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from gran_bench.dem.fast.bodies import Bodies, Known
from gran_bench.dem.fast.contact_blocks import BUFFER_SIZE, block_buffer
from gran_bench.dem.fast.contact_list import sorted_pairs, with_margins
from gran_bench.dem.fast.wall_list import list_wall_contacts
from gran_bench.dem.integrate import Physics
from gran_bench.dem.walls import PATH
from gran_bench.neighbors import list_pairs

# Rows of a thread's inner list: place of each pair in the outer one, its particles, its row of history.
NEAR, NEAR_I, NEAR_J, NEAR_MEMORY = range(4)


_FIELDS = (
    "pair_i pair_j start memory slot moment wall_i wall_w wall_memory wall_start wall_slot wall_moment margin "
    "inverse_square searched_at pruned_at inner_list touching wall_touching geometry near_start buffer wall_buffer"
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
    """

    def known(self, half: int, pairs: int, walls: int) -> tuple[Known, Known]:
        """What the even or the odd evaluation found touching, so many pairs and walls less one, and its memory."""
        near, on_walls = self.touching[half, 1:pairs], self.wall_touching[half, 1:walls]
        first, second = self.inner_list[NEAR_I][near], self.inner_list[NEAR_J][near]
        particle, wall = self.wall_i[on_walls], self.wall_w[on_walls]
        return (
            Known(first.astype(np.int64), second.astype(np.int64), self.slot[half, 1:pairs],
                  self.moment[half, 1:pairs]),
            Known(particle.astype(np.int64), wall.astype(np.int64), self.wall_slot[half, 1:walls],
                  self.wall_moment[half, 1:walls]),
        )  # fmt: skip


def search(
    bodies: Bodies, bounds: np.ndarray, chunk: int, stop: int, walls: np.ndarray, row: int, last: int,
    physics: Physics, known: tuple[Known, Known],
) -> Lists:  # fmt: skip
    """Lists of the pairs and walls that spheres of ``chunk … stop − 1`` may touch, with what they remember.

    ``row`` of the poses belongs to these positions; ``known`` touched in evaluation ``last``.
    """
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
    buffers = zeros(2, BUFFER_SIZE, dtype=np.float32 if physics.single_precision else np.float64)
    return Lists(
        pair_i, pair_j, start, memory, slot, moment, wall_i, wall_w, wall_memory, wall_start, wall_slot, wall_moment,
        margin, inverse_square, sphere.copy(), np.empty_like(sphere), inner, np.empty((2, slot.shape[1]), np.uint32),
        wall_touching, zeros(wall_slot.shape[1], 4), np.ones(stop - chunk + 1, np.int64),
        *(block_buffer(buffer, sphere[0, 3], velocity[0, 3], physics.pair_laws[0, 0]) for buffer in buffers),
    )  # fmt: skip


def _history(known: Known, contacts: int, evaluation: int, rolling: bool) -> tuple[np.ndarray, np.ndarray]:
    """Room for the histories of so many contacts; in that of ``evaluation`` rows 1, 2, … are the known ones."""
    rows = max(contacts, len(known.first)) + 5  # row 0, and three lanes of a block that is not full
    slot, moment = np.empty((2, rows, 4)), np.empty((2, rows if rolling else 1, 4))
    for room, remembered in ((slot, known.slot), (moment, known.moment)):
        room[:, 0] = 0.0
        room[evaluation % 2, 1 : len(remembered) + 1] = remembered
    return slot, moment


def zeros(*shape: int, dtype: type = np.float64) -> np.ndarray:
    """Zeros from the beginning of a cache line on: rows and columns that cross lines take a tenth longer.

    They come from the operating system: what is never touched costs nothing.
    """
    size, line = math.prod(shape) * np.dtype(dtype).itemsize, 64
    room = np.zeros(size + line, np.uint8)
    skipped = -room.__array_interface__["data"][0] % line
    return room[skipped : skipped + size].view(dtype).reshape(shape)
