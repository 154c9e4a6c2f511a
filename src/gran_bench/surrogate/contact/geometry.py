"""Which contacts a frame has: a particle i and a partner j, another particle or a wall."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gran_bench.dem.seams import one_contact_each
from gran_bench.dem.walls import wall_contact
from gran_bench.neighbors import bin_cells, check_period
from gran_bench.scene import Scene
from gran_bench.state import FloatArray
from gran_bench.surrogate.contact.constants import DIAMETER, SKIN
from gran_bench.surrogate.contact.kernels.listing import closer, farthest, near_walls, pairs_in_order
from gran_bench.surrogate.walls import FrameWalls, frame_walls


@dataclass(frozen=True)
class NearPairs:
    """All pairs that were closer than a reach when they were listed; later frames look no further than among these."""

    pairs: NDArray[np.int64]  # (M, 2) i < j, sorted
    sphere: FloatArray  # (N, 3) where the centres were, m
    reach: float  # m

    def covers(self, sphere: FloatArray, reach: float, period: float) -> bool:
        """Whether all pairs that are closer than ``reach`` now must be among these: no sphere went half the rest."""
        if len(sphere) != len(self.sphere) or reach > self.reach:
            return False
        return 2.0 * farthest(sphere, self.sphere, period) <= self.reach - reach


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
    near: NearPairs | None = None  # among which the pairs were found

    @property
    def keys(self) -> NDArray[np.int64]:
        """One increasing number for each contact, pairs first, ``(M + W,)``."""
        wall_keys = (self.count + self.wall) * self.count + self.wall_particle
        return np.concatenate((self.pairs @ (self.count, 1), wall_keys))


def find_contacts(
    scene: Scene,
    time: float,
    position: FloatArray,
    reach: float,
    wall_reach: float,
    start: FloatArray | None = None,
    known: NearPairs | None = None,
) -> ContactList:
    """Pairs closer than ``reach`` and walls closer than ``wall_reach`` at the end of the frame from ``time``, s.

    Pieces of one surface answer a sphere once, as in the DEM (:mod:`gran_bench.dem.seams`).

    Args:
        position: ``(N, 3)`` m, there; y in [−L/2, L/2) where the scene is periodic. A position that is not finite has
            no contact to search for; then nothing has, and the frame carries the failure on.
        reach: distance of two centres, m.
        wall_reach: gap between a surface and a wall, m.
        start: ``(N, 3)`` m, at the frame's start: where spheres are slow, pairs somewhat farther apart are listed too,
            for the frames to come.
        known: ``near`` of an earlier frame's contacts. The result is the same with it.

    Raises:
        ValueError: a period that is shorter than twice the reach.
    """
    check_period(scene.period, reach)
    walls, count, diameter = frame_walls(scene, time), len(position), scene.filling.diameter
    frame = walls.in_unit(diameter / DIAMETER), scene.period * (DIAMETER / diameter), count
    if not np.isfinite(position).all():
        nothing = np.zeros(0, np.int64)
        return ContactList(np.zeros((0, 2), np.int64), nothing, nothing, nothing, *frame)
    sphere = _centers(position)
    if known is None or not known.covers(sphere, reach, scene.period):
        # A longer list pays where it outlives the next frames.
        slow = start is not None and farthest(sphere, _centers(start), scene.period) < 0.25 * SKIN * diameter
        known = _near_pairs(sphere, reach + SKIN * diameter if slow else reach, scene.period)
    pairs = closer(known.pairs, sphere, reach, scene.period)
    if any(scene.surfaces):
        return ContactList(pairs, *_at_pieces(scene, walls, sphere, wall_reach), *frame, known)
    shapes, apart = np.array(walls.after, order="C"), scene.filling.radius + wall_reach
    wall, particle = _filled(2 * count + 64, lambda rows: near_walls(shapes, sphere, apart, rows)).T.copy()
    return ContactList(pairs, particle, wall, wall, *frame, known)


def _centers(position: FloatArray) -> FloatArray:
    """``(N, 3)`` centres as the kernels take them, and nobody else changes them."""
    return np.array(position, np.float64, order="C")


def _near_pairs(sphere: FloatArray, reach: float, period: float) -> NearPairs:
    """The pairs closer than ``reach``, m, whatever the rounding."""
    reach = min(reach, 0.5 * period) if period > 0.0 else reach
    margin, count = reach * (1.0 + 1e-9), len(sphere)
    if count < 2:
        return NearPairs(np.zeros((0, 2), np.int64), sphere, reach)
    binned = bin_cells(sphere, margin, period)
    pairs = _filled(8 * count, lambda rows: pairs_in_order(sphere, margin, period, *binned, rows))
    return NearPairs(pairs, sphere, reach)


def _filled(room: int, fill: Callable[[NDArray[np.int64]], int]) -> NDArray[np.int64]:
    """The rows of two that ``fill`` finds; where it has too little room, it says −1 and is called again with more."""
    while (found := fill(rows := np.empty((room, 2), np.int64))) < 0:
        room *= 4
    return rows[:found].copy()


def _at_pieces(scene: Scene, walls: FrameWalls, position: FloatArray, reach: float) -> tuple[NDArray[np.int64], ...]:
    """Particle, wall and other piece of each contact with walls of which some are pieces of one surface."""
    count, radius = len(position), scene.filling.radius
    reached = [wall_contact(shape, position) for shape in walls.after]
    alone = [distance - radius < reach for distance, _ in reached]
    near, merged = one_contact_each(walls.after, scene.surfaces, position, np.full(count, radius), reached, alone)
    # As one array, so that both are contiguous: for strided ones the kernels would be compiled again.
    wall, particle = np.array(np.nonzero(np.array(near, bool).reshape(len(near), count)))
    other = np.tile(np.arange(len(near))[:, None], count)
    for w, v, i in reversed(merged):  # the first of several
        other[v, i] = w
    return particle, wall, other[wall, particle]
