"""The iterations of a frame of the contact network in plain torch: the readable reference of the fused kernel.

A contact joins particle i to a partner j; the normal n points from i to j. In units of d/50.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from gran_bench.surrogate.contact import constants
from gran_bench.surrogate.contact.constants import INPUT_CLAMP, PAIR, SPIN_RESPONSE, WALL
from gran_bench.surrogate.contact.geometry import ContactList
from gran_bench.surrogate.step import Surrogate, minimum_image
from gran_bench.surrogate.walls import closest_point


def solve_contacts(
    model: Surrogate,
    contacts: ContactList,
    position: Tensor,
    displacement: Tensor,
    spin: Tensor,
    fall: Tensor,
    springs: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """All iterations of a frame in plain torch: the readable reference of the fused kernel.

    Args:
        model: a :class:`~gran_bench.surrogate.contact.network.ContactNetwork`.
        position: ``(N, 3)`` at the start of the frame, units.
        displacement: ``(N, 3)`` ballistic guess D, units a frame.
        spin: ``(N, 3)`` q, units a frame.
        fall: ``(3,)`` g Δt², units a frame.
        springs: ``(M + W, 3)`` units, of each contact, or None.

    Returns:
        D and q at the end, and what acts on the velocity alone (translation, spin); each ``(N, 3)`` units a frame.
    """
    groups, width = contact_groups(contacts, position.device), model.config.channels
    channels = position.new_zeros(len(position), width)
    extra, extra_spin = torch.zeros_like(position), torch.zeros_like(position)
    taken_back = 0.5 * fall if model.is_instantaneous else fall
    nearness = nearest_fade(model, contacts, position + displacement)
    sums = [position.new_zeros(len(group.first), 2) for group in groups]
    for k in range(model.config.iterations):
        end, answers = position + displacement, []
        for index, group in enumerate(groups):
            seen = group.surfaces(end, displacement, spin, model.diameter)
            together = channels[group.first] + channels[group.second]
            spring = None if springs is None else springs[group.span]
            answer, sums[index] = _answer(model, k, group.kind, seen, sums[index], together, spring)
            answers.append(answer)
        for group, (push, turn, extra_push, extra_turn, messages) in zip(groups, answers, strict=True):
            displacement = group.scatter(displacement, 0.5 * push, -1.0)
            extra = group.scatter(extra, 0.5 * extra_push, -1.0)
            spin = group.scatter(spin, SPIN_RESPONSE * turn, 1.0)
            extra_spin = group.scatter(extra_spin, SPIN_RESPONSE * extra_turn, 1.0)
            channels = group.scatter(channels, messages, 1.0)
        limited = channels.clamp(-constants.CHANNEL_CLAMP, constants.CHANNEL_CLAMP)
        share = nearness * (limited @ model.mix_weight[k, width])
        displacement = displacement + share[:, None] * taken_back
        extra = extra + share[:, None] * (fall - taken_back)
        mixed = limited @ model.mix_weight[k, :width].T + model.mix_bias[k, :width]
        channels = channels + 0.5 * torch.relu(mixed)
    return displacement, spin, extra, extra_spin


def nearest_fade(model: Surrogate, contacts: ContactList, end: Tensor) -> Tensor:
    """The largest fade among each particle's contacts at the ballistic guess ``end``, ``(N, 3)`` units; ``(N,)``.

    1 where a contact is within full reach, 0 without a contact: the share of its answer that a particle may have
    where no contact acts on it directly.
    """
    nearness = end.new_zeros(len(end))
    for group in contact_groups(contacts, end.device):
        reach, width = model.fades[group.kind]
        fade = ((reach - group.gap(end, model.diameter)) / width).clamp(0.0, 1.0)
        nearness = nearness.scatter_reduce(0, group.first, fade, "amax")
        if group.kind == PAIR:
            nearness = nearness.scatter_reduce(0, group.second, fade, "amax")
    return nearness


@dataclass
class Surfaces:
    """What two surfaces do at C contacts."""

    normal: Tensor  # (C, 3) unit vectors from i to its partner
    gap: Tensor  # (C,) units, negative where they overlap
    approach: Tensor  # (C,) u_n, units a frame, positive where they part
    slip: Tensor  # (C, 3) tangential displacement of the partner's surface against that of i, units a frame


@dataclass
class Group:
    """Contacts of one kind: all pairs, or all particles near one wall (then ``second`` is ``first``)."""

    contacts: ContactList
    kind: int
    first: Tensor
    second: Tensor
    span: slice  # among all contacts of the frame
    wall: int = -1

    def gap(self, end: Tensor, diameter: float) -> Tensor:
        """Distance of the surfaces, ``(C,)`` units, with the particles at ``end``, ``(N, 3)`` units."""
        if self.kind == PAIR:
            return torch.linalg.vector_norm(self._apart(end), dim=1) - diameter
        return closest_point(self.contacts.walls.after[self.wall], end[self.first])[0] - 0.5 * diameter

    def surfaces(self, end: Tensor, displacement: Tensor, spin: Tensor, diameter: float) -> Surfaces:
        """u_n = u·n and slip = u − u_n n − q×n, with u the displacement of j against i and q = q_i + q_j.

        A wall's point has its exact motion and no spin.

        Args:
            end, displacement, spin: ``(N, 3)`` x + D, D and q = r ω Δt, units (a frame).
            diameter: units.
        """
        first, second = self.first, self.second
        if self.kind == PAIR:
            offset = self._apart(end)
            distance = torch.linalg.vector_norm(offset, dim=1)
            normal, gap = offset / distance[:, None], distance - diameter
            motion, turn = displacement[second] - displacement[first], spin[first] + spin[second]
        else:
            walls, end, turn = self.contacts.walls, end[first], spin[first]
            distance, normal = closest_point(walls.after[self.wall], end)
            gap, touched = distance - 0.5 * diameter, end + distance[:, None] * normal
            moved = touched @ end.new_tensor(walls.turn[self.wall]).T + end.new_tensor(walls.shift[self.wall])
            motion = moved - displacement[first]
        approach = (motion * normal).sum(1)
        slip = motion - approach[:, None] * normal - torch.linalg.cross(turn, normal)
        return Surfaces(normal, gap, approach, slip)

    def scatter(self, target: Tensor, value: Tensor, sign: float) -> Tensor:
        """``target`` with ``(C, …)`` values added to i, and with a sign to a partner that is a particle."""
        target = target.index_add(0, self.first, value)
        return target.index_add(0, self.second, sign * value) if self.kind == PAIR else target

    def _apart(self, end: Tensor) -> Tensor:
        apart = end.index_select(0, self.second) - end.index_select(0, self.first)
        return minimum_image(apart, self.contacts.period)


def contact_groups(contacts: ContactList, device: torch.device | str) -> list[Group]:
    """The pairs, and the particles near each wall."""
    first, second = torch.from_numpy(contacts.pairs).to(device).unbind(1)
    groups = [Group(contacts, PAIR, first, second, slice(0, len(first)))]
    particle = torch.from_numpy(contacts.wall_particle).to(device)
    for index in range(len(contacts.walls.after)):
        low, high = contacts.wall.searchsorted([index, index + 1])
        near, span = particle[low:high], slice(len(first) + low, len(first) + high)
        groups.append(Group(contacts, WALL, near, near, span, index))
    return groups


def _answer(
    model: Surrogate, k: int, kind: int, seen: Surfaces, sums: Tensor, together: Tensor, spring: Tensor | None
) -> tuple[tuple[Tensor, ...], Tensor]:
    """What contacts of one kind answer in iteration ``k``, and the running sums of a and b, ``(C, 2)``.

    The answers, units a frame, are equal and opposite on the two: push τ − a n, turn n × τ, both once more for the
    velocity at the end of the frame alone, and messages to the channels, ``(C, channels)``.
    """
    normal, gap, slip = seen.normal, seen.gap, seen.slip
    slip_size = torch.sqrt((slip * slip).sum(1) + constants.SMALLEST_SLIP_SQUARED)
    numbers = torch.stack((seen.approach, slip_size, gap, sums[:, 0], sums[:, 1]), 1)
    nodes = gap.new_tensor(constants.RAMP_NODES)  # the gap as numbers that rise from 0 to 1 between neighbouring nodes
    ramps = ((gap[:, None] - nodes[:-1]) / (nodes[1:] - nodes[:-1])).clamp(0.0, 1.0)
    inputs = [ramps, constants.INPUT_SCALE * numbers.clamp(-INPUT_CLAMP, INPUT_CLAMP), together]
    if spring is not None:
        flat = spring - (spring * normal).sum(1, keepdim=True) * normal
        load = torch.sqrt((flat * flat).sum(1) + constants.SMALLEST_SLIP_SQUARED)
        along = (flat * slip).sum(1) / slip_size
        inputs.append(torch.stack((load, along), 1).clamp(-INPUT_CLAMP, INPUT_CLAMP))
    hidden = torch.relu(torch.cat(inputs, 1) @ model.hidden_weight[k, kind].T + model.hidden_bias[k, kind])
    outputs = hidden @ model.output_weight[k, kind].T + model.output_bias[k, kind]

    reach, width = model.fades[kind]
    outputs = outputs * ((reach - gap) / width).clamp(0.0, 1.0)[:, None]
    a, b, c = outputs[:, 0], outputs[:, 1], outputs[:, 2]
    a = a + model.stiffness[k, kind] * (2.0 if kind == WALL else 1.0) * torch.relu(-gap)
    tangential = slip * (b / slip_size + constants.VISCOUS_SHARE * c)[:, None]
    column = 3 + model.config.channels
    messages = outputs[:, 3:column]
    if spring is not None:
        tangential = tangential + outputs[:, column, None] * flat
        column += 1
    share = model.spin_share[k, kind]
    push, turn = tangential - a[:, None] * normal, share * torch.linalg.cross(normal, tangential)
    extra_push = extra_turn = torch.zeros_like(normal)
    if model.is_instantaneous:
        extra = slip * (outputs[:, column + 1] / slip_size)[:, None]
        extra_push = extra - outputs[:, column, None] * normal
        extra_turn = share * torch.linalg.cross(normal, extra)
    return (push, turn, extra_push, extra_turn, messages), sums + torch.stack((a, b), 1)
