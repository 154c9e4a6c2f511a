"""The memory of each contact: a tangential spring, carried from frame to frame, without weights of its own.

A contact that touches at both ends of a frame gathers the slip of its surfaces:

    ξ' = turned(ξ) + φ slip,   ‖ξ'‖ ≤ 0.40 × overlap,

where ``turned`` lays ξ into the new contact plane and keeps its length, and φ is the part of the frame after the
surfaces met, overlap/(overlap + gap before) for a new contact and 1 for an old one. A contact that does not touch has
no spring. Because nothing here is learned, the memory of any start frame follows from stored frames before it. It is
input to the network only: no gradient runs through it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gran_bench.dem.walls import wall_contact
from gran_bench.scene import Rotation, Scene, Translation, Vibration, Wall
from gran_bench.state import FloatArray
from gran_bench.surrogate.contact.constants import DIAMETER
from gran_bench.surrogate.contact.geometry import ContactList, find_contacts
from gran_bench.surrogate.contact.kernels.springs import recall, stretch
from gran_bench.surrogate.walls import frame_walls

FLIP = np.array([1.0, -1.0, 1.0], np.float32)  # y → −y


@dataclass(frozen=True)
class ContactMemory:
    """The springs of the touching contacts of one instant."""

    keys: NDArray[np.int64]  # (C,) increasing, as of ContactList.keys
    spring: FloatArray  # (C, 3) float32 units, tangential displacement of the partner's surface against that of i

    @classmethod
    def empty(cls) -> ContactMemory:
        """No contact remembers anything, as at the settled state."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 3), np.float32))

    def mirrored(self, scene: Scene, count: int) -> ContactMemory:
        """The memory of the bed reflected along y, for ``count`` particles.

        Raises:
            ValueError: a wall without a mirror image among the scene's walls.
        """
        image, keys = _mirror_images(scene), self.keys.copy()
        of_wall = keys >= count * count
        wall, particle = np.divmod(keys[of_wall] - count * count, count)
        keys[of_wall] = count * count + image[wall] * count + particle
        order = np.argsort(keys, kind="stable")
        return ContactMemory(keys[order], self.spring[order] * FLIP)

    def renumbered(self, numbers: NDArray[np.int64], count: int) -> ContactMemory:
        """The memory under other numbers of the particles.

        Args:
            numbers: ``(N,)`` new number of each particle, increasing where it is kept; −1 where it is not.
            count: of particles under the new numbers.
        """
        before = len(numbers)
        first, second = np.divmod(self.keys, max(before, 1))
        of_pair = self.keys < before * before
        partner = numbers[np.where(of_pair, first, second)]
        kept = (numbers[second] >= 0) & (partner >= 0)
        # A wall contact is count² + wall count + particle: its wall is what is left above the pairs.
        keys = np.where(of_pair, partner, first - before + count) * count + numbers[second]
        return ContactMemory(keys[kept], self.spring[kept])


def springs_of(memory: ContactMemory | None, contacts: ContactList) -> Tensor:
    """The spring of each listed contact, zero where it is new, ``(M + W, 3)`` float32 units.

    A contact over a seam goes on with the spring that the sphere had with the other piece of the surface.
    """
    spring = np.zeros((len(contacts.pairs) + len(contacts.wall), 3), np.float32)
    if memory is not None and len(memory.keys):
        recall(*_listed(contacts), contacts.count, memory.keys, memory.spring, spring)
    return torch.from_numpy(spring)


def _listed(contacts: ContactList) -> tuple[NDArray[np.int64], ...]:
    """A list as the kernels take it."""
    return contacts.pairs, contacts.wall_particle, contacts.wall, contacts.other_piece


def gather(
    scene: Scene,
    contacts: ContactList,
    springs: FloatArray,
    positions: Sequence[FloatArray],
    angular_velocities: Sequence[FloatArray],
) -> ContactMemory:
    """The memory at the end of a frame of contacts with ``springs``, ``(M + W, 3)`` units, at its start.

    Positions and angular velocities are those at its two ends, ``(N, 3)`` m and rad/s.
    """
    radius, walls, unit = 0.5 * DIAMETER, contacts.walls, np.float32(scene.filling.diameter / DIAMETER)
    start, end = (np.asarray(p, np.float32) / unit for p in positions)
    # The spin of the frame is the mean of its ends: the model and the data give both.
    spins = [np.asarray(w, np.float32) for w in angular_velocities]
    spin = (spins[0] + spins[1]) * np.float32(0.5 * radius * scene.frame_interval)
    keys, spring = np.empty(len(springs), np.int64), np.empty_like(springs)
    moves = walls.before, walls.after, walls.turn, walls.shift
    found = stretch(*_listed(contacts), start, end, spin, 2.0 * radius, contacts.period, *moves, springs, keys, spring)
    return ContactMemory(keys[:found].copy(), spring[:found].copy())


def follow_memory(
    scene: Scene, times: Iterable[float], positions: FloatArray, angular_velocities: FloatArray
) -> Iterator[ContactMemory]:
    """The memory at each of F stored frames (s, m, rad/s), the first empty; exact where that is the settled state."""
    memory, near = ContactMemory.empty(), None
    yield memory
    for k, time in enumerate(list(times)[:-1]):
        contacts = find_contacts(scene, time, positions[k + 1], scene.filling.diameter, 0.0, positions[k], near)
        near = contacts.near
        springs, ends = springs_of(memory, contacts).numpy(), slice(k, k + 2)
        memory = gather(scene, contacts, springs, positions[ends], angular_velocities[ends])
        yield memory


def _mirror_images(scene: Scene) -> NDArray[np.int64]:
    """Which wall the reflection y → −y lays each wall onto, with its motion: points see the two at one distance."""
    shapes = frame_walls(scene, scene.start_time).before
    points = 20.0 * scene.filling.diameter * np.random.default_rng(0).normal(size=(64, 3))
    seen, mirrored = ([wall_contact(shape, p)[0] for shape in shapes] for p in (points, FLIP * points))
    images = []
    for index, wall in enumerate(scene.walls):
        ways = wall.turns, wall.motion, wall.opens
        alike = [
            other
            for other, candidate in enumerate(scene.walls)
            if (candidate.turns, candidate.motion, candidate.opens) == ways
            and np.allclose(seen[index], mirrored[other], rtol=0.0, atol=2e-8 * scene.filling.diameter)
        ]
        if not alike or not _mirrors_motion(wall):
            raise ValueError(f"wall {index} of scene {scene.name!r} has no mirror image; switch rollout.mirror off")
        images.append(alike[0])
    return np.array(images, np.int64)


def _mirrors_motion(wall: Wall) -> bool:
    """Whether a motion of the wall's own is its own image."""
    motion = wall.motion
    if isinstance(motion, Rotation):  # of a turned-round axis but for its y
        return not (motion.axis[0] or motion.axis[2])
    if isinstance(motion, Translation):
        return not np.any(np.array(motion.velocities)[:, 1])
    return not isinstance(motion, Vibration) or motion.direction[1] == 0.0
