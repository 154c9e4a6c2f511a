"""The memory of each contact: a tangential spring, carried from frame to frame, without weights of its own.

A contact that touches at both ends of a frame gathers the slip of its surfaces:

    ξ' = turned(ξ) + φ slip,   ‖ξ'‖ ≤ 0.40 × overlap,

where ``turned`` lays ξ into the new contact plane and keeps its length, and φ is the part of the frame after the
surfaces met, overlap/(overlap + gap before) for a new contact and 1 for an old one. A contact that does not touch has
no spring. Because nothing here is learned, the memory of any start frame follows from stored frames before it. It is
input to the network only: no gradient runs through it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gran_bench.scene import Plane, Rotation, Scene, Translation, Vibration, Wall
from gran_bench.state import FloatArray
from gran_bench.surrogate.contact.constants import MILLIMETRE
from gran_bench.surrogate.contact.geometry import ContactList, find_contacts
from gran_bench.surrogate.contact.kernels.springs import stretch_pairs, stretch_walls
from gran_bench.surrogate.step import FrameState
from gran_bench.surrogate.walls import FrameWalls, frame_walls

FLIP = np.array([1.0, -1.0, 1.0])  # y → −y


@dataclass(frozen=True)
class ContactMemory:
    """The springs of the touching contacts of one instant.

    Attributes:
        keys: ``(C,)`` int64, increasing, as of :meth:`ContactList.keys`.
        spring: ``(C, 3)`` float32, tangential displacement of the partner's surface against that of i, mm.
    """

    keys: NDArray[np.int64]
    spring: FloatArray

    @classmethod
    def empty(cls) -> ContactMemory:
        """No contact remembers anything, as at the settled state."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 3), np.float32))

    def mirrored(self, scene: Scene, count: int) -> ContactMemory:
        """The memory of the bed reflected along y, for ``count`` particles.

        Raises:
            ValueError: a wall without a mirror image among the scene's walls.
        """
        image = np.array([_mirror_image(scene, index) for index in range(len(scene.walls))], np.int64)
        keys = self.keys.copy()
        of_wall = keys >= count * count
        wall, particle = np.divmod(keys[of_wall] - count * count, count)
        keys[of_wall] = count * count + image[wall] * count + particle
        order = np.argsort(keys, kind="stable")
        return ContactMemory(keys[order], self.spring[order] * np.array([1.0, -1.0, 1.0], np.float32))

    def renumbered(self, numbers: NDArray[np.int64], count: int) -> ContactMemory:
        """The memory under other numbers of the particles.

        Args:
            numbers: ``(N,)`` new number of each particle, increasing where it is kept; −1 where it is not.
            count: of particles under the new numbers.
        """
        before = len(numbers)
        first, second = np.divmod(self.keys, max(before, 1))
        of_pair = self.keys < before * before
        kept = (numbers[second] >= 0) & (~of_pair | (numbers[np.where(of_pair, first, second)] >= 0))
        # A wall contact is count² + wall count + particle: its wall is what is left above the pairs.
        new_first = np.where(of_pair, numbers[np.where(of_pair, first, second)], first - before + count)
        keys = new_first * count + numbers[second]
        return ContactMemory(keys[kept], self.spring[kept])


def springs_of(memory: ContactMemory, contacts: ContactList, count: int) -> Tensor:
    """The spring of each listed contact, zero where it is new, ``(M + W, 3)`` float32 mm.

    A contact over a seam goes on with the spring that the sphere had with the other piece of the surface.
    """
    keys = contacts.keys(count)
    spring = np.zeros((len(keys), 3), np.float32)
    if len(memory.keys):
        place = np.minimum(np.searchsorted(memory.keys, keys), len(memory.keys) - 1)
        known = memory.keys[place] == keys
        spring[known] = memory.spring[place[known]]
        pairs = len(contacts.pairs)
        keys = contacts.keys_of_other_pieces(count)
        place = np.minimum(np.searchsorted(memory.keys, keys), len(memory.keys) - 1)
        handed = ~known[pairs:] & (memory.keys[place] == keys)
        spring[pairs:][handed] = memory.spring[place[handed]]
    return torch.from_numpy(spring)


def update_memory(
    scene: Scene, walls: FrameWalls, before: FrameState, after: FrameState, contacts: ContactList, springs: Tensor
) -> ContactMemory:
    """The memory at the end of a frame that a model has moved.

    Args:
        walls: of the frame, mm.
        before, after: states at its two ends.
        contacts: that the frame had.
        springs: ``(M + W, 3)`` mm, theirs at the start.
    """

    def plain(tensor: Tensor) -> FloatArray:
        return tensor.detach().cpu().numpy()

    return _gather(
        scene,
        walls,
        (plain(before.position), plain(after.position)),
        (plain(before.angular_velocity), plain(after.angular_velocity)),
        contacts,
        plain(springs),
    )


def follow_memory(
    scene: Scene, times: Iterable[float], positions: FloatArray, angular_velocities: FloatArray
) -> Iterator[ContactMemory]:
    """The memory at each of F stored frames, the first one empty.

    Args:
        times: F times, s.
        positions: ``(F, N, 3)`` m.
        angular_velocities: ``(F, N, 3)`` rad/s.
    """
    memory = ContactMemory.empty()
    yield memory
    for k, time in enumerate(list(times)[:-1]):
        walls = frame_walls(scene, time)
        contacts = find_contacts(scene, walls, positions[k + 1], scene.filling.diameter, 0.0)
        springs = springs_of(memory, contacts, positions.shape[1]).numpy()
        in_millimetres = walls.in_unit(MILLIMETRE)
        memory = _gather(scene, in_millimetres, positions[k : k + 2], angular_velocities[k : k + 2], contacts, springs)
        yield memory


def warm_memory(
    scene: Scene, times: Iterable[float], positions: FloatArray, angular_velocities: FloatArray
) -> ContactMemory:
    """The memory at the last of F stored frames; exact where the first one is the settled state.

    Args:
        times, positions, angular_velocities: as for :func:`follow_memory`.
    """
    memory = ContactMemory.empty()
    for memory in follow_memory(scene, times, positions, angular_velocities):  # noqa: B007
        pass
    return memory


def _gather(
    scene: Scene,
    walls: FrameWalls,
    positions: tuple[FloatArray, FloatArray] | FloatArray,
    angular_velocities: tuple[FloatArray, FloatArray] | FloatArray,
    contacts: ContactList,
    springs: FloatArray,
) -> ContactMemory:
    """One frame of slip gathered: states at its two ends in SI, springs in mm."""
    radius = scene.filling.radius / MILLIMETRE
    start, end = (np.asarray(p, np.float32) / np.float32(MILLIMETRE) for p in positions)
    # The spin of the frame is the mean of its ends: the model and the data give both.
    spin = (np.asarray(angular_velocities[0], np.float32) + np.asarray(angular_velocities[1], np.float32)) * np.float32(
        0.5 * radius * scene.frame_interval
    )
    spring = np.zeros_like(springs)
    touches = np.zeros(len(springs), np.bool_)
    count = len(contacts.pairs)
    period = scene.period / MILLIMETRE
    stretch_pairs(contacts.pairs, start, end, spin, 2.0 * radius, period, springs, spring, touches)
    stretch_walls(
        contacts.wall_particle,
        contacts.wall,
        contacts.other_piece,
        start,
        end,
        spin,
        radius,
        period,
        walls.before,
        walls.after,
        walls.turn,
        walls.shift,
        springs[count:],
        spring[count:],
        touches[count:],
    )
    return ContactMemory(contacts.keys(len(start))[touches], spring[touches])


def _mirror_image(scene: Scene, index: int) -> int:
    """Which wall the reflection y → −y lays wall ``index`` onto, with its motion."""
    wall = scene.walls[index]
    if _mirrors_motion(wall):
        for other, candidate in enumerate(scene.walls):
            alike = (candidate.turns, candidate.motion, candidate.opens) == (wall.turns, wall.motion, wall.opens)
            if alike and type(candidate) is type(wall) and _mirrors(wall, candidate):
                return other
    raise ValueError(f"wall {index} of scene {scene.name!r} has no mirror image; switch rollout.mirror off")


def _mirrors(wall: Wall, other: Wall) -> bool:
    """Whether the reflection lays the one's surface onto the other's."""
    if isinstance(wall, Plane):
        normal = FLIP * wall.normal
        return np.allclose(normal, other.normal) and abs((FLIP * wall.point - np.array(other.point)) @ normal) < 1e-9
    if wall.meridian is None:
        along = FLIP * wall.point - np.array(other.point)
        across = along - (along @ other.axis) * np.array(other.axis)
        parallel = np.allclose(np.abs(FLIP * wall.axis @ other.axis), 1.0)
        return bool(parallel and wall.radius == other.radius and np.allclose(across, 0.0))
    here, there = ([(r, np.array(w.point) + s * np.array(w.axis)) for r, s in w.meridian] for w in (wall, other))
    parallel = np.allclose(np.abs(FLIP * wall.axis @ other.axis), 1.0)
    return bool(parallel) and any(
        all(np.isclose(r, q) and np.allclose(FLIP * x, y) for (r, x), (q, y) in zip(here, order, strict=True))
        for order in (there, there[::-1])
    )


def _mirrors_motion(wall: Wall) -> bool:
    """Whether a motion of the wall's own is its own image."""
    motion = wall.motion
    if isinstance(motion, Rotation):  # of a turned-round axis but for its y
        return not (motion.axis[0] or motion.axis[2])
    if isinstance(motion, Translation):
        return not np.any(np.array(motion.velocities)[:, 1])
    return not isinstance(motion, Vibration) or motion.direction[1] == 0.0
