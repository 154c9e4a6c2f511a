"""The contact network: a learned solver of contacts that moves spheres by one frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from gran_bench.config import ContactModelConfig
from gran_bench.scene import Scene
from gran_bench.state import FloatArray
from gran_bench.surrogate.contact_geometry import (
    MILLIMETRE,
    ContactList,
    Surfaces,
    find_contacts,
    pair_surfaces,
    wall_displacement_matrix,
    wall_surfaces,
)
from gran_bench.surrogate.contact_memory import ContactMemory, follow_memory, springs_of, update_memory
from gran_bench.surrogate.step import FrameState, Surrogate, wrap

RAMP_NODES = (-4.0, -1.5, -0.6, -0.2, 0.2, 0.6, 1.5, 4.0, 10.0)  # mm; the gap's ramps run from node to node
INPUT_CLAMP = 8.0  # mm a frame; a perceptron never sees more
INPUT_SCALE = 0.3
CHANNEL_CLAMP = 5.0
SMALLEST_SLIP_SQUARED = 1.0e-4  # mm², keeps the direction of slip differentiable at rest
PAIR_FADE = 0.1  # of a diameter, the last part of the reach, over which a pair's answer fades
WALL_FADE = 0.5  # of the wall's reach
FUSED_SIZES = (16, 4)  # hidden units and channels that the fused kernel is compiled for
PAIR, WALL = 0, 1  # kinds of contact, each with its own weights
SPIN_RESPONSE = 1.25  # ½ m r²/I of a solid sphere: surface speed that a unit of tangential displacement brings


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


class ContactNetwork(Surrogate):
    """A learned solver of contacts, K iterations a frame.

    A ballistic guess of the displacement, D = v Δt + g Δt², gives the contacts. In each iteration a perceptron sees a
    contact's gap, approach, slip, the impulse gathered there and the channels h of its particles, all in mm a frame,
    and answers with a normal displacement a, a tangential one τ = slip (b/s + 0.3 c) and messages to the channels:

        D_i += ½ (τ − a n),  D_j −= ½ (τ − a n),  q_{i,j} += 1.25 σ n × τ,  with q = r ω Δt.

    The answer fades to zero at the edge of the reach. Then each particle may take back a learned share of gravity's
    step. Contacts conserve linear momentum exactly. At the end x + D, D/Δt, q/(r Δt).

    With ``memory``, each contact carries the tangential displacement ξ that its surfaces have gathered
    (:mod:`gran_bench.surrogate.contact_memory`); the perceptrons see it and may push along it: τ += e ξ.

    With ``velocity = instantaneous`` the state's velocity is the one at the frame's end, the guess is
    D = v Δt + ½ g Δt², and two more outputs tell velocity and displacement apart: V = v Δt + g Δt² plus all that
    contacts add to D plus f a_v, f b_v, where the extra parts act on V alone.

    Args:
        config: of the model; ``backend = fused`` is for float32 on the CPU, elsewhere plain torch takes its place.
        scene: any scene with spheres of the size that the model is for.

    Raises:
        ValueError: a reach that no contact fits in, an unknown ``velocity`` or ``backend``, or sizes that the fused
            kernel is not compiled for.
    """

    uses_spin = True

    def __init__(self, config: ContactModelConfig, scene: Scene) -> None:
        super().__init__()
        self.config = config
        self.diameter = scene.filling.diameter / MILLIMETRE
        self.velocity_kind = config.velocity
        self.has_memory = config.memory
        _check(config, scene)

        iterations, hidden, channels = config.iterations, config.hidden, config.channels
        inputs = len(RAMP_NODES) - 1 + 5 + channels + 2 * config.memory
        outputs = 3 + channels + config.memory + 2 * self._is_instantaneous
        self.hidden_weight = nn.Parameter(_uniform((iterations, 2, hidden, inputs), inputs))
        self.hidden_bias = nn.Parameter(_uniform((iterations, 2, hidden), inputs))
        output_weight = _uniform((iterations, 2, outputs, hidden), hidden)
        output_weight *= 0.1
        output_weight[:, :, 3 : 3 + channels] *= 3.0  # messages start louder than displacements
        self.output_weight = nn.Parameter(output_weight)
        self.output_bias = nn.Parameter(torch.zeros(iterations, 2, outputs))
        self.stiffness = nn.Parameter(torch.full((iterations, 2), 0.5))  # κ, share of an overlap that is pushed out
        self.spin_share = nn.Parameter(torch.full((iterations, 2), 0.5))  # σ
        mix_weight = _uniform((iterations, channels + 1, channels), channels)
        mix_weight *= 0.3
        mix_weight[:, channels] /= 3.0
        self.mix_weight = nn.Parameter(mix_weight)
        self.mix_bias = nn.Parameter(torch.zeros(iterations, channels + 1))

    @property
    def _is_instantaneous(self) -> bool:
        return self.config.velocity == "instantaneous"

    def fade(self, kind: int) -> tuple[float, float]:
        """Gap at which an answer has faded to nothing, and the width over which it fades, mm."""
        if kind == PAIR:
            return self.config.radius / MILLIMETRE - self.diameter, PAIR_FADE * self.diameter
        return self.config.wall_reach / MILLIMETRE, WALL_FADE * self.config.wall_reach / MILLIMETRE

    def begin(
        self,
        scene: Scene,
        position: Tensor,
        velocity: Tensor,
        angular_velocity: Tensor | None = None,
        previous_position: Tensor | None = None,
        memory: ContactMemory | None = None,
    ) -> FrameState:
        """The state to start from; ``memory`` is that of the start frame, none at the settled state."""
        state = super().begin(scene, position, velocity, angular_velocity, previous_position)
        if self.has_memory:
            state.memory = ContactMemory.empty() if memory is None else memory
        return state

    def memories(
        self, scene: Scene, times: FloatArray, positions: FloatArray, angular_velocities: FloatArray
    ) -> list[ContactMemory] | None:
        """The springs at each of F stored frames; exact where the first one is the settled state."""
        return list(follow_memory(scene, times, positions, angular_velocities)) if self.has_memory else None

    def forward(self, state: FrameState, scene: Scene, time: float) -> FrameState:
        interval = scene.frame_interval
        to_frame, to_spin = interval / MILLIMETRE, 0.5 * self.diameter * interval
        position = state.position / MILLIMETRE
        fall = position.new_tensor(scene.gravity) * interval * to_frame
        velocity = state.velocity * to_frame + fall
        guess = velocity - 0.5 * fall if self._is_instantaneous else velocity
        spin = state.angular_velocity * to_spin

        with torch.no_grad():
            end = wrap((position + guess) * MILLIMETRE, scene.period).cpu().numpy()
            contacts = find_contacts(scene, end, self.config.radius, self.config.wall_reach)
        springs = springs_of(state.memory, contacts, len(position)).to(position) if self.has_memory else None

        if self.config.backend == "fused" and position.device.type == "cpu" and position.dtype == torch.float32:
            from gran_bench.surrogate.kernels.contact_fused import fused_solve

            solve = fused_solve
        else:
            solve = solve_contacts
        displacement, new_spin, extra, extra_spin = solve(
            self, scene, time, contacts, position, guess, spin, fall, springs
        )
        if self._is_instantaneous:
            velocity = velocity + (displacement - guess) + extra
            last_spin = new_spin + extra_spin
        else:
            velocity, last_spin = displacement, new_spin
        after = FrameState(
            wrap((position + displacement) * MILLIMETRE, scene.period), velocity / to_frame, last_spin / to_spin
        )
        if self.has_memory:
            after.memory = update_memory(scene, time, state, after, contacts, springs)
        return after


def solve_contacts(
    model: ContactNetwork,
    scene: Scene,
    time: float,
    contacts: ContactList,
    position: Tensor,
    displacement: Tensor,
    spin: Tensor,
    fall: Tensor,
    springs: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """All iterations of a frame in plain torch: the readable reference of the fused kernel.

    Args:
        position: ``(N, 3)`` at the start of the frame, mm.
        displacement: ``(N, 3)`` ballistic guess D, mm a frame.
        spin: ``(N, 3)`` q, mm a frame.
        fall: ``(3,)`` g Δt², mm a frame.
        springs: ``(M + W, 3)`` mm, of each contact, or None.

    Returns:
        D and q at the end, and what acts on the velocity alone (translation, spin); each ``(N, 3)`` mm a frame.
    """
    config, channels_count = model.config, model.config.channels
    groups = _contact_groups(contacts, scene, time, position.device)
    channels = position.new_zeros(len(position), channels_count)
    extra, extra_spin = torch.zeros_like(position), torch.zeros_like(position)
    taken_back = 0.5 * fall if config.velocity == "instantaneous" else fall
    sums = [position.new_zeros(len(group.first), 2) for group in groups]
    for k in range(config.iterations):
        end = position + displacement
        moves = []
        for index, group in enumerate(groups):
            surfaces = group.surfaces(end, displacement, spin, model.diameter, scene.period / MILLIMETRE)
            together = channels[group.first] + channels[group.second]
            spring = None if springs is None else springs[group.span]
            answer, sums[index] = _answer(model, k, group.kind, surfaces, sums[index], together, spring)
            moves.append(answer)
        for group, answer in zip(groups, moves, strict=True):
            displacement = group.scatter(displacement, 0.5 * answer.push, -1.0)
            extra = group.scatter(extra, 0.5 * answer.extra_push, -1.0)
            spin = group.scatter(spin, SPIN_RESPONSE * answer.turn, 1.0)
            extra_spin = group.scatter(extra_spin, SPIN_RESPONSE * answer.extra_turn, 1.0)
            channels = group.scatter(channels, answer.messages, 1.0)
        limited = channels.clamp(-CHANNEL_CLAMP, CHANNEL_CLAMP)
        share = limited @ model.mix_weight[k, channels_count]
        displacement = displacement + share[:, None] * taken_back
        extra = extra + share[:, None] * (fall - taken_back)
        mixed = limited @ model.mix_weight[k, :channels_count].T + model.mix_bias[k, :channels_count]
        channels = channels + 0.5 * torch.relu(mixed)
    return displacement, spin, extra, extra_spin


@dataclass
class _Group:
    """Contacts of one kind: all pairs, or all particles near one wall (then ``second`` is ``first``)."""

    kind: int
    first: Tensor
    second: Tensor
    span: slice  # among all contacts of the frame
    wall: object = None
    motion: object = None

    def surfaces(self, end: Tensor, displacement: Tensor, spin: Tensor, diameter: float, period: float) -> Surfaces:
        if self.kind == PAIR:
            pairs = torch.stack((self.first, self.second), 1)
            return pair_surfaces(pairs, end, displacement, spin, diameter, period)
        near = self.first
        return wall_surfaces(self.wall, self.motion, end[near], displacement[near], spin[near], 0.5 * diameter)

    def scatter(self, target: Tensor, value: Tensor, sign: float) -> Tensor:
        target = target.index_add(0, self.first, value)
        return target.index_add(0, self.second, sign * value) if self.kind == PAIR else target


def _contact_groups(contacts: ContactList, scene: Scene, time: float, device: torch.device) -> list[_Group]:
    first, second = torch.from_numpy(contacts.pairs).to(device).unbind(1)
    groups = [_Group(PAIR, first, second, slice(0, len(first)))]
    particle = torch.from_numpy(contacts.wall_particle).to(device)
    for index, wall in enumerate(scene.walls):
        low, high = contacts.wall.searchsorted([index, index + 1])
        near, span = particle[low:high], slice(len(first) + low, len(first) + high)
        groups.append(_Group(WALL, near, near, span, wall, wall_displacement_matrix(scene, wall, time)))
    return groups


def _answer(
    model: ContactNetwork,
    k: int,
    kind: int,
    surfaces: Surfaces,
    sums: Tensor,
    together: Tensor,
    spring: Tensor | None,
) -> tuple[Answer, Tensor]:
    """What contacts of one kind answer in iteration ``k``, and the running sums of a and b, ``(C, 2)``."""
    channels_count = model.config.channels
    normal, gap, slip = surfaces.normal, surfaces.gap, surfaces.slip
    slip_size = torch.sqrt((slip * slip).sum(1) + SMALLEST_SLIP_SQUARED)
    seen = torch.stack((surfaces.approach, slip_size, gap, sums[:, 0], sums[:, 1]), 1)
    inputs = [_ramps(gap), INPUT_SCALE * seen.clamp(-INPUT_CLAMP, INPUT_CLAMP), together]
    if spring is not None:
        flat = spring - (spring * normal).sum(1, keepdim=True) * normal
        load = torch.sqrt((flat * flat).sum(1) + SMALLEST_SLIP_SQUARED)
        along = (flat * slip).sum(1) / slip_size
        inputs.append(torch.stack((load, along), 1).clamp(-INPUT_CLAMP, INPUT_CLAMP))
    hidden = torch.relu(torch.cat(inputs, 1) @ model.hidden_weight[k, kind].T + model.hidden_bias[k, kind])
    outputs = hidden @ model.output_weight[k, kind].T + model.output_bias[k, kind]

    reach, width = model.fade(kind)
    outputs = outputs * ((reach - gap) / width).clamp(0.0, 1.0)[:, None]
    a, b, c = outputs[:, 0], outputs[:, 1], outputs[:, 2]
    strength = model.stiffness[k, kind] * (2.0 if kind == WALL else 1.0)
    a = a + strength * torch.relu(-gap)
    tangential = slip * (b / slip_size + 0.3 * c)[:, None]
    column = 3 + channels_count
    if spring is not None:
        tangential = tangential + outputs[:, column, None] * flat
        column += 1
    share = model.spin_share[k, kind]
    answer = Answer(
        push=tangential - a[:, None] * normal,
        turn=share * torch.linalg.cross(normal, tangential),
        extra_push=torch.zeros_like(normal),
        extra_turn=torch.zeros_like(normal),
        messages=outputs[:, 3 : 3 + channels_count],
    )
    if model.config.velocity == "instantaneous":
        extra = slip * (outputs[:, column + 1] / slip_size)[:, None]
        answer.extra_push = extra - outputs[:, column, None] * normal
        answer.extra_turn = share * torch.linalg.cross(normal, extra)
    return answer, sums + torch.stack((a, b), 1)


def _ramps(gap: Tensor) -> Tensor:
    """The gap as eight numbers that rise from 0 to 1 between neighbouring nodes, ``(C, 8)``."""
    nodes = gap.new_tensor(RAMP_NODES)
    return ((gap[:, None] - nodes[:-1]) / (nodes[1:] - nodes[:-1])).clamp(0.0, 1.0)


def _uniform(shape: tuple[int, ...], fan_in: int) -> Tensor:
    """Weights uniform in ±1/√fan_in, the usual start of a linear layer."""
    return torch.empty(shape).uniform_(-1.0, 1.0) / math.sqrt(fan_in)


def _check(config: ContactModelConfig, scene: Scene) -> None:
    diameter = scene.filling.diameter
    if config.radius <= (1.0 + PAIR_FADE) * diameter:
        raise ValueError(
            f"model.radius={config.radius:g} m leaves no room for a contact to fade; "
            f"choose more than {(1.0 + PAIR_FADE) * diameter:g} m, {1.0 + PAIR_FADE:g} diameters"
        )
    for key, legal in (("velocity", ("mean", "instantaneous")), ("backend", ("fused", "torch"))):
        value = getattr(config, key)
        if value not in legal:
            raise ValueError(f"model.{key}={value!r} is unknown; choose {' or '.join(legal)}")
    if config.backend == "fused" and (config.hidden, config.channels) != FUSED_SIZES:
        raise ValueError(
            f"model.hidden={config.hidden} with model.channels={config.channels} is not what model.backend=fused is "
            f"compiled for; choose {FUSED_SIZES[0]} and {FUSED_SIZES[1]}, or model.backend=torch"
        )
