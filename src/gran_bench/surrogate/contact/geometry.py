"""Which contacts a frame has, and what two surfaces do there: gap, approach, slip. In millimetres and mm per frame.

A contact joins particle i to a partner j, another particle or a wall; the normal n points from i to j.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from gran_bench.dem.seams import one_contact_each
from gran_bench.dem.walls import wall_contact
from gran_bench.neighbors import check_period, list_pairs
from gran_bench.scene import Scene
from gran_bench.state import FloatArray
from gran_bench.surrogate.step import minimum_image
from gran_bench.surrogate.walls import FrameWalls, closest_point


@dataclass(frozen=True)
class ContactList:
    """The contacts that a frame may have; found once a frame.

    Attributes:
        pairs: ``(M, 2)`` int64, i < j, sorted.
        wall_particle: ``(W,)`` int64, sorted within each wall.
        wall: ``(W,)`` int64, index into ``scene.walls``, sorted.
        other_piece: ``(W,)`` int64, the piece of the same surface that the contact answers for as well, where a sphere
            is over a seam; elsewhere the wall itself.
    """

    pairs: NDArray[np.int64]
    wall_particle: NDArray[np.int64]
    wall: NDArray[np.int64]
    other_piece: NDArray[np.int64]

    def keys(self, count: int) -> NDArray[np.int64]:
        """One increasing number for each contact, pairs first, among ``count`` particles, ``(M + W,)``."""
        pair_keys = self.pairs[:, 0] * count + self.pairs[:, 1]
        return np.concatenate((pair_keys, count * count + self.wall * count + self.wall_particle))

    def keys_of_other_pieces(self, count: int) -> NDArray[np.int64]:
        """The key that each wall contact would have with the other piece of its surface, ``(W,)``."""
        return count * count + self.other_piece * count + self.wall_particle


def find_contacts(
    scene: Scene, walls: FrameWalls, position: FloatArray, reach: float, wall_reach: float
) -> ContactList:
    """Pairs closer than ``reach`` and walls closer than ``wall_reach``, at the ballistic guess of a frame's end.

    Pieces of one surface answer a sphere once, as in the DEM (:mod:`gran_bench.dem.seams`).

    Args:
        walls: of the frame, m.
        position: ``(N, 3)`` m, y in [−L/2, L/2) where the scene is periodic. A position that is not finite has no
            contact to search for; then nothing has, and the frame carries the failure on.
        reach: distance of two centres, m.
        wall_reach: gap between a surface and a wall, m.

    Raises:
        ValueError: a period that is shorter than twice the reach.
    """
    check_period(scene.period, reach)
    nothing = np.zeros(0, np.int64)
    if not np.isfinite(position).all():
        return ContactList(np.zeros((0, 2), np.int64), nothing, nothing, nothing)
    reached = [wall_contact(shape, position) for shape in walls.after]
    near, merged = [distance - scene.filling.radius < wall_reach for distance, _ in reached], []
    if scene.needs.wall_seams:
        exact = np.asarray(position, np.float64)
        radius = np.full(len(position), scene.filling.radius)
        near, merged = one_contact_each(walls.after, scene.surfaces, exact, radius, reached, near)
    # As one array, so that both are contiguous: for strided ones the kernels would be compiled again.
    wall, particle = np.array(np.nonzero(np.array(near, bool).reshape(len(near), len(position))))
    other = np.tile(np.arange(len(near))[:, None], len(position))
    for w, v, i in reversed(merged):  # the first of several
        other[v, i] = w
    sphere = np.zeros((len(position), 4))
    sphere[:, :3] = position
    if scene.period > 0.0:
        sphere[:, 1] %= scene.period
    pairs = _in_order(*list_pairs(sphere, reach, scene.period), len(position))
    return ContactList(pairs, particle, wall, other[wall, particle])


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


@dataclass
class Surfaces:
    """What two surfaces do at C contacts.

    Attributes:
        normal: ``(C, 3)`` unit vectors from i to its partner.
        gap: ``(C,)`` mm, negative where they overlap.
        approach: ``(C,)`` u_n, mm a frame, positive where they part.
        slip: ``(C, 3)`` tangential displacement of the partner's surface against that of i, mm a frame.
    """

    normal: Tensor
    gap: Tensor
    approach: Tensor
    slip: Tensor

    @classmethod
    def from_motion(cls, normal: Tensor, gap: Tensor, displacement: Tensor, spin: Tensor) -> Surfaces:
        """u_n = u·n and slip = u − u_n n − q×n.

        Args:
            displacement: ``(C, 3)`` u = D_j − D_i, mm a frame.
            spin: ``(C, 3)`` q = q_i + q_j with q = r ω Δt, mm a frame.
        """
        approach = (displacement * normal).sum(1)
        slip = displacement - approach[:, None] * normal - torch.linalg.cross(spin, normal)
        return cls(normal, gap, approach, slip)


def pair_surfaces(
    pairs: Tensor, end: Tensor, displacement: Tensor, spin: Tensor, diameter: float, period: float
) -> Surfaces:
    """Surfaces of pairs of particles at the end of the frame.

    Args:
        pairs: ``(M, 2)`` int64.
        end: ``(N, 3)`` x + D, mm.
        displacement: ``(N, 3)`` D, mm a frame.
        spin: ``(N, 3)`` q, mm a frame.
        diameter: mm.
        period: mm, along y; 0 where nothing wraps.
    """
    first, second = pairs.unbind(1)
    offset = minimum_image(end[second] - end[first], period)
    distance = torch.linalg.vector_norm(offset, dim=1)
    normal = offset / distance[:, None]
    return Surfaces.from_motion(
        normal, distance - diameter, displacement[second] - displacement[first], spin[first] + spin[second]
    )


def wall_surfaces(
    walls: FrameWalls, index: int, end: Tensor, displacement: Tensor, spin: Tensor, radius: float
) -> Surfaces:
    """Surfaces of C particles near one wall at the end of the frame; the wall's point has its exact motion, no spin.

    Args:
        walls: of the frame, mm.
        index: of the wall.
        end: ``(C, 3)`` x + D, mm.
        displacement: ``(C, 3)`` mm a frame.
        spin: ``(C, 3)`` mm a frame.
        radius: of the particles, mm.
    """
    distance, normal = closest_point(walls.after[index], end)
    touched = end + distance[:, None] * normal
    moved = touched @ end.new_tensor(walls.turn[index]).T + end.new_tensor(walls.shift[index])
    return Surfaces.from_motion(normal, distance - radius, moved - displacement, spin)
