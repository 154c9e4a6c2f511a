"""Which contacts a frame has: a particle i and a partner j, another particle or a wall."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gran_bench.dem.seams import one_contact_each
from gran_bench.dem.walls import wall_contact
from gran_bench.neighbors import check_period, list_pairs
from gran_bench.scene import Scene
from gran_bench.state import FloatArray
from gran_bench.surrogate.contact.constants import DIAMETER
from gran_bench.surrogate.walls import FrameWalls, frame_walls


@dataclass(frozen=True)
class ContactList:
    """The contacts that a frame may have; found once a frame."""

    pairs: NDArray[np.int64]  # (M, 2) i < j, sorted
    wall_particle: NDArray[np.int64]  # (W,) sorted within each wall
    wall: NDArray[np.int64]  # (W,) index into scene.walls, sorted
    # (W,) of a sphere over a seam the piece of the same surface that the contact answers for too; else the wall itself
    other_piece: NDArray[np.int64]
    walls: FrameWalls  # of the frame, units
    period: float  # units, along y; 0 where nothing wraps
    count: int  # N

    @property
    def keys(self) -> NDArray[np.int64]:
        """One increasing number for each contact, pairs first, ``(M + W,)``."""
        return np.concatenate((self.pairs @ (self.count, 1), self.wall_keys(self.wall)))

    def wall_keys(self, wall: NDArray[np.int64]) -> NDArray[np.int64]:
        """The key that each wall contact would have with another wall, ``(W,)``."""
        return (self.count + wall) * self.count + self.wall_particle


def find_contacts(scene: Scene, time: float, position: FloatArray, reach: float, wall_reach: float) -> ContactList:
    """Pairs closer than ``reach`` and walls closer than ``wall_reach`` at the end of the frame from ``time``, s.

    Pieces of one surface answer a sphere once, as in the DEM (:mod:`gran_bench.dem.seams`).

    Args:
        position: ``(N, 3)`` m, there; y in [−L/2, L/2) where the scene is periodic. A position that is not finite has
            no contact to search for; then nothing has, and the frame carries the failure on.
        reach: distance of two centres, m.
        wall_reach: gap between a surface and a wall, m.

    Raises:
        ValueError: a period that is shorter than twice the reach.
    """
    check_period(scene.period, reach)
    walls, count, unit = frame_walls(scene, time), len(position), scene.filling.diameter / DIAMETER
    frame = walls.in_unit(unit), scene.period / unit, count
    if not np.isfinite(position).all():
        nothing = np.zeros(0, np.int64)
        return ContactList(np.zeros((0, 2), np.int64), nothing, nothing, nothing, *frame)
    reached = [wall_contact(shape, position) for shape in walls.after]
    near, merged = [distance - scene.filling.radius < wall_reach for distance, _ in reached], []
    if scene.needs.wall_seams:
        exact, radius = np.asarray(position, np.float64), np.full(count, scene.filling.radius)
        near, merged = one_contact_each(walls.after, scene.surfaces, exact, radius, reached, near)
    # As one array, so that both are contiguous: for strided ones the kernels would be compiled again.
    wall, particle = np.array(np.nonzero(np.array(near, bool).reshape(len(near), count)))
    other = np.tile(np.arange(len(near))[:, None], count)
    for w, v, i in reversed(merged):  # the first of several
        other[v, i] = w
    sphere = np.zeros((count, 4))
    sphere[:, :3] = position
    if scene.period > 0.0:
        sphere[:, 1] %= scene.period
    pairs = _in_order(*list_pairs(sphere, reach, scene.period), count)
    return ContactList(pairs, particle, wall, other[wall, particle], *frame)


@njit(cache=True, nogil=True, error_model="numpy")
def _in_order(first, second, count):  # pragma: no cover - jitted
    """Pairs sorted by i, then j, ``(M, 2)`` int64: counted by i, then each particle's few j by insertion."""
    start = np.zeros(count + 1, np.int64)
    for i in first:
        start[i + 1] += 1
    for i in range(count):
        start[i + 1] += start[i]
    pairs, fill = np.empty((len(first), 2), np.int64), start[:-1].copy()
    for c in range(len(first)):
        i, j = np.int64(first[c]), np.int64(second[c])
        place = fill[i]
        while place > start[i] and pairs[place - 1, 1] > j:
            pairs[place, 1] = pairs[place - 1, 1]
            place -= 1
        pairs[place, 1] = j
        pairs[fill[i], 0] = i
        fill[i] += 1
    return pairs
