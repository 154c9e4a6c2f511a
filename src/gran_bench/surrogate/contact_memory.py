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
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from gran_bench.scene import Cylinder, Plane, Scene
from gran_bench.state import FloatArray
from gran_bench.surrogate.contact_geometry import MILLIMETRE, ContactList, find_contacts, wall_displacement_matrix
from gran_bench.surrogate.step import FrameState

SPRING_CAP = 0.40  # of the overlap; a longer spring has slid


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


def springs_of(memory: ContactMemory, contacts: ContactList, count: int) -> Tensor:
    """The spring of each listed contact, zero where it is new, ``(M + W, 3)`` float32 mm."""
    keys = contacts.keys(count)
    spring = np.zeros((len(keys), 3), np.float32)
    if len(memory.keys):
        place = np.minimum(np.searchsorted(memory.keys, keys), len(memory.keys) - 1)
        known = memory.keys[place] == keys
        spring[known] = memory.spring[place[known]]
    return torch.from_numpy(spring)


def update_memory(
    scene: Scene, time: float, before: FrameState, after: FrameState, contacts: ContactList, springs: Tensor
) -> ContactMemory:
    """The memory at the end of a frame that a model has moved.

    Args:
        time: s, start of the frame.
        before, after: states at its two ends.
        contacts: that the frame had.
        springs: ``(M + W, 3)`` mm, theirs at the start.
    """

    def plain(tensor: Tensor) -> FloatArray:
        return tensor.detach().cpu().numpy()

    return _gather(
        scene,
        time,
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
        contacts = find_contacts(scene, positions[k + 1], scene.filling.diameter, 0.0)
        springs = springs_of(memory, contacts, positions.shape[1]).numpy()
        memory = _gather(scene, time, positions[k : k + 2], angular_velocities[k : k + 2], contacts, springs)
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
    time: float,
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
    _gather_pairs(contacts.pairs, start, end, spin, 2.0 * radius, period, springs, spring, touches)
    for index, wall in enumerate(scene.walls):
        low, high = contacts.wall.searchsorted([index, index + 1])
        span = slice(count + low, count + high)
        _gather_wall(
            contacts.wall_particle[low:high],
            start,
            end,
            spin,
            radius,
            period,
            isinstance(wall, Cylinder),
            np.array(wall.point) / MILLIMETRE,
            np.array(wall.axis if isinstance(wall, Cylinder) else wall.normal),
            wall.radius / MILLIMETRE if isinstance(wall, Cylinder) else 0.0,
            wall_displacement_matrix(scene, wall, time),
            springs[span],
            spring[span],
            touches[span],
        )
    return ContactMemory(contacts.keys(len(start))[touches], spring[touches])


@njit(cache=True, nogil=True, error_model="numpy")
def _stretch(spring, normal, motion, spin, overlap, overlap_before, result):  # pragma: no cover - jitted
    """ξ' of one contact into ``result``; ``motion`` is D_j − D_i, ``spin`` is q_i + q_j."""
    before = np.sqrt(spring[0] ** 2 + spring[1] ** 2 + spring[2] ** 2)
    along = spring[0] * normal[0] + spring[1] * normal[1] + spring[2] * normal[2]
    for m in range(3):
        result[m] = spring[m] - along * normal[m]
    flat = np.sqrt(result[0] ** 2 + result[1] ** 2 + result[2] ** 2)
    keep = before / flat if flat > 0.0 else 0.0
    met = overlap / (overlap - overlap_before) if overlap_before < 0.0 else 1.0
    parting = motion[0] * normal[0] + motion[1] * normal[1] + motion[2] * normal[2]
    for m in range(3):
        p, q = (m + 1) % 3, (m + 2) % 3
        rolling = spin[p] * normal[q] - spin[q] * normal[p]
        result[m] = keep * result[m] + met * (motion[m] - parting * normal[m] - rolling)
    length = np.sqrt(result[0] ** 2 + result[1] ** 2 + result[2] ** 2)
    longest = SPRING_CAP * overlap
    if length > longest:
        for m in range(3):
            result[m] *= longest / length


@njit(cache=True, nogil=True, error_model="numpy")
def _gather_pairs(pairs, start, end, spin, diameter, period, springs, result, touches):  # pragma: no cover - jitted
    normal, before, motion, turn = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for c in range(len(pairs)):
        i, j = pairs[c]
        for m in range(3):
            normal[m] = end[j, m] - end[i, m]
            before[m] = start[j, m] - start[i, m]
            turn[m] = spin[i, m] + spin[j, m]
        if period > 0.0:
            normal[1] -= period * np.floor(normal[1] / period + 0.5)
            before[1] -= period * np.floor(before[1] / period + 0.5)
        distance = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        if distance >= diameter or distance == 0.0:
            continue
        apart = np.sqrt(before[0] ** 2 + before[1] ** 2 + before[2] ** 2)
        for m in range(3):
            motion[m] = normal[m] - before[m]
            normal[m] /= distance
        _stretch(springs[c], normal, motion, turn, diameter - distance, diameter - apart, result[c])
        touches[c] = True


@njit(cache=True, nogil=True, error_model="numpy")
def _gather_wall(  # pragma: no cover - jitted
    near, start, end, spin, radius, period, is_cylinder, point, direction, wall_radius, matrix, springs, result, touches
):
    normal, motion, moved = np.empty(3), np.empty(3), np.empty(3)
    for c in range(len(near)):
        i = near[c]
        distance = _to_wall(end[i], is_cylinder, point, direction, wall_radius, normal)
        if distance >= radius:
            continue
        for m in range(3):
            moved[m] = end[i, m] - start[i, m]
        if period > 0.0:
            moved[1] -= period * np.floor(moved[1] / period + 0.5)
        for m in range(3):
            motion[m] = -moved[m]
            for p in range(3):
                motion[m] += matrix[m, p] * (end[i, p] + distance * normal[p])
        before = _to_wall(start[i], is_cylinder, point, direction, wall_radius, np.empty(3))
        _stretch(springs[c], normal, motion, spin[i], radius - distance, radius - before, result[c])
        touches[c] = True


@njit(cache=True, nogil=True, error_model="numpy")
def _to_wall(place, is_cylinder, point, direction, wall_radius, normal):  # pragma: no cover - jitted
    """Distance of ``place`` from a wall; the unit vector towards it into ``normal``."""
    along = 0.0
    for m in range(3):
        along += (place[m] - point[m]) * direction[m]
    if not is_cylinder:
        for m in range(3):
            normal[m] = -direction[m]
        return along
    squared = 0.0
    for m in range(3):
        normal[m] = place[m] - point[m] - along * direction[m]
        squared += normal[m] ** 2
    from_axis = np.sqrt(squared)
    for m in range(3):
        normal[m] = normal[m] / from_axis if from_axis > 0.0 else 0.0
    return wall_radius - from_axis


def _mirror_image(scene: Scene, index: int) -> int:
    """Which wall the reflection y → −y lays wall ``index`` onto."""
    flip = np.array([1.0, -1.0, 1.0])
    wall = scene.walls[index]
    for other, candidate in enumerate(scene.walls):
        if type(candidate) is not type(wall) or candidate.turns != wall.turns:
            continue
        if isinstance(wall, Plane):
            normal = flip * wall.normal
            offset = (flip * wall.point - np.array(candidate.point)) @ normal
            if np.allclose(normal, candidate.normal) and abs(offset) < 1e-9:
                return other
        elif candidate.radius == wall.radius and np.allclose(np.abs(flip * wall.axis @ candidate.axis), 1.0):
            offset = flip * wall.point - np.array(candidate.point)
            if np.allclose(offset - (offset @ candidate.axis) * np.array(candidate.axis), 0.0):
                return other
    raise ValueError(f"wall {index} of scene {scene.name!r} has no mirror image; switch rollout.mirror off")
