"""The iterations of a frame of the contact network in plain torch: the readable reference of the fused kernel."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gran_bench.surrogate.contact.constants import (
    CHANNEL_CLAMP,
    INPUT_CLAMP,
    INPUT_SCALE,
    PAIR,
    RAMP_NODES,
    SMALLEST_SLIP_SQUARED,
    SPIN_RESPONSE,
    VISCOUS_SHARE,
    WALL,
)
from gran_bench.surrogate.contact.geometry import ContactList, Surfaces, pair_surfaces, wall_surfaces
from gran_bench.surrogate.contact.weights import ContactWeights
from gran_bench.surrogate.step import minimum_image
from gran_bench.surrogate.walls import FrameWalls, closest_point


@dataclass
class Answer:
    """What C contacts do to their particles in one iteration, mm a frame; equal and opposite on the two.

    Attributes:
        push: ``(C, 3)`` τ − a n, added by half to i and taken by half from its partner.
        turn: ``(C, 3)`` n × τ, turns both.
        extra_push, extra_turn: the same beyond that, for the velocity at the end of the frame alone.
        messages: ``(C, channels)``, added to the channels of both.
    """

    push: Tensor
    turn: Tensor
    extra_push: Tensor
    extra_turn: Tensor
    messages: Tensor


def solve_contacts(
    weights: ContactWeights,
    period: float,
    walls: FrameWalls,
    contacts: ContactList,
    position: Tensor,
    displacement: Tensor,
    spin: Tensor,
    fall: Tensor,
    nearness: Tensor,
    springs: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """All iterations of a frame in plain torch: the readable reference of the fused kernel.

    Args:
        period: mm, along y; 0 where nothing wraps.
        walls: of the frame, mm.
        position: ``(N, 3)`` at the start of the frame, mm.
        displacement: ``(N, 3)`` ballistic guess D, mm a frame.
        spin: ``(N, 3)`` q, mm a frame.
        fall: ``(3,)`` g Δt², mm a frame.
        nearness: ``(N,)`` of :func:`nearest_fade`.
        springs: ``(M + W, 3)`` mm, of each contact, or None.

    Returns:
        D and q at the end, and what acts on the velocity alone (translation, spin); each ``(N, 3)`` mm a frame.
    """
    channels_count = weights.channels
    groups = _contact_groups(contacts, len(walls.after), position.device)
    channels = position.new_zeros(len(position), channels_count)
    extra, extra_spin = torch.zeros_like(position), torch.zeros_like(position)
    taken_back = 0.5 * fall if weights.instantaneous else fall
    sums = [position.new_zeros(len(group.first), 2) for group in groups]
    for k in range(len(weights.hidden_weight)):
        end = position + displacement
        moves = []
        for index, group in enumerate(groups):
            surfaces = group.surfaces(end, displacement, spin, weights.diameter, period, walls)
            together = channels[group.first] + channels[group.second]
            spring = None if springs is None else springs[group.span]
            answer, sums[index] = _answer(weights, k, group.kind, surfaces, sums[index], together, spring)
            moves.append(answer)
        for group, answer in zip(groups, moves, strict=True):
            displacement = group.scatter(displacement, 0.5 * answer.push, -1.0)
            extra = group.scatter(extra, 0.5 * answer.extra_push, -1.0)
            spin = group.scatter(spin, SPIN_RESPONSE * answer.turn, 1.0)
            extra_spin = group.scatter(extra_spin, SPIN_RESPONSE * answer.extra_turn, 1.0)
            channels = group.scatter(channels, answer.messages, 1.0)
        limited = channels.clamp(-CHANNEL_CLAMP, CHANNEL_CLAMP)
        share = nearness * (limited @ weights.mix_weight[k, channels_count])
        displacement = displacement + share[:, None] * taken_back
        extra = extra + share[:, None] * (fall - taken_back)
        mixed = limited @ weights.mix_weight[k, :channels_count].T + weights.mix_bias[k, :channels_count]
        channels = channels + 0.5 * torch.relu(mixed)
    return displacement, spin, extra, extra_spin


def nearest_fade(
    weights: ContactWeights, period: float, walls: FrameWalls, contacts: ContactList, end: Tensor
) -> Tensor:
    """The largest fade among each particle's contacts at the ballistic guess, ``(N,)``.

    1 where a contact is within full reach, 0 without a contact: the share of its answer that a particle may have
    where no contact acts on it directly.

    Args:
        period: mm, along y; 0 where nothing wraps.
        walls: of the frame, mm.
        end: ``(N, 3)`` ballistic guess of the frame's end, mm.
    """
    nearness = end.new_zeros(len(end))
    for group in _contact_groups(contacts, len(walls.after), end.device):
        reach, width = weights.fades[group.kind]
        fade = ((reach - group.gap(end, weights.diameter, period, walls)) / width).clamp(0.0, 1.0)
        nearness = nearness.scatter_reduce(0, group.first, fade, "amax")
        if group.kind == PAIR:
            nearness = nearness.scatter_reduce(0, group.second, fade, "amax")
    return nearness


@dataclass
class _Group:
    """Contacts of one kind: all pairs, or all particles near one wall (then ``second`` is ``first``)."""

    kind: int
    first: Tensor
    second: Tensor
    span: slice  # among all contacts of the frame
    wall: int = -1

    def gap(self, end: Tensor, diameter: float, period: float, walls: FrameWalls) -> Tensor:
        if self.kind == PAIR:
            offset = minimum_image(end.index_select(0, self.second) - end.index_select(0, self.first), period)
            return torch.linalg.vector_norm(offset, dim=1) - diameter
        return closest_point(walls.after[self.wall], end[self.first])[0] - 0.5 * diameter

    def surfaces(
        self, end: Tensor, displacement: Tensor, spin: Tensor, diameter: float, period: float, walls: FrameWalls
    ) -> Surfaces:
        if self.kind == PAIR:
            pairs = torch.stack((self.first, self.second), 1)
            return pair_surfaces(pairs, end, displacement, spin, diameter, period)
        near = self.first
        return wall_surfaces(walls, self.wall, end[near], displacement[near], spin[near], 0.5 * diameter)

    def scatter(self, target: Tensor, value: Tensor, sign: float) -> Tensor:
        target = target.index_add(0, self.first, value)
        return target.index_add(0, self.second, sign * value) if self.kind == PAIR else target


def _contact_groups(contacts: ContactList, walls: int, device: torch.device) -> list[_Group]:
    first, second = torch.from_numpy(contacts.pairs).to(device).unbind(1)
    groups = [_Group(PAIR, first, second, slice(0, len(first)))]
    particle = torch.from_numpy(contacts.wall_particle).to(device)
    for index in range(walls):
        low, high = contacts.wall.searchsorted([index, index + 1])
        near, span = particle[low:high], slice(len(first) + low, len(first) + high)
        groups.append(_Group(WALL, near, near, span, index))
    return groups


def _answer(
    weights: ContactWeights,
    k: int,
    kind: int,
    surfaces: Surfaces,
    sums: Tensor,
    together: Tensor,
    spring: Tensor | None,
) -> tuple[Answer, Tensor]:
    """What contacts of one kind answer in iteration ``k``, and the running sums of a and b, ``(C, 2)``."""
    channels_count = weights.channels
    normal, gap, slip = surfaces.normal, surfaces.gap, surfaces.slip
    slip_size = torch.sqrt((slip * slip).sum(1) + SMALLEST_SLIP_SQUARED)
    seen = torch.stack((surfaces.approach, slip_size, gap, sums[:, 0], sums[:, 1]), 1)
    inputs = [_ramps(gap), INPUT_SCALE * seen.clamp(-INPUT_CLAMP, INPUT_CLAMP), together]
    if spring is not None:
        flat = spring - (spring * normal).sum(1, keepdim=True) * normal
        load = torch.sqrt((flat * flat).sum(1) + SMALLEST_SLIP_SQUARED)
        along = (flat * slip).sum(1) / slip_size
        inputs.append(torch.stack((load, along), 1).clamp(-INPUT_CLAMP, INPUT_CLAMP))
    hidden = torch.relu(torch.cat(inputs, 1) @ weights.hidden_weight[k, kind].T + weights.hidden_bias[k, kind])
    outputs = hidden @ weights.output_weight[k, kind].T + weights.output_bias[k, kind]

    reach, width = weights.fades[kind]
    outputs = outputs * ((reach - gap) / width).clamp(0.0, 1.0)[:, None]
    a, b, c = outputs[:, 0], outputs[:, 1], outputs[:, 2]
    strength = weights.stiffness[k, kind] * (2.0 if kind == WALL else 1.0)
    a = a + strength * torch.relu(-gap)
    tangential = slip * (b / slip_size + VISCOUS_SHARE * c)[:, None]
    column = 3 + channels_count
    if spring is not None:
        tangential = tangential + outputs[:, column, None] * flat
        column += 1
    share = weights.spin_share[k, kind]
    answer = Answer(
        push=tangential - a[:, None] * normal,
        turn=share * torch.linalg.cross(normal, tangential),
        extra_push=torch.zeros_like(normal),
        extra_turn=torch.zeros_like(normal),
        messages=outputs[:, 3 : 3 + channels_count],
    )
    if weights.instantaneous:
        extra = slip * (outputs[:, column + 1] / slip_size)[:, None]
        answer.extra_push = extra - outputs[:, column, None] * normal
        answer.extra_turn = share * torch.linalg.cross(normal, extra)
    return answer, sums + torch.stack((a, b), 1)


def _ramps(gap: Tensor) -> Tensor:
    """The gap as eight numbers that rise from 0 to 1 between neighbouring nodes, ``(C, 8)``."""
    nodes = gap.new_tensor(RAMP_NODES)
    return ((gap[:, None] - nodes[:-1]) / (nodes[1:] - nodes[:-1])).clamp(0.0, 1.0)
