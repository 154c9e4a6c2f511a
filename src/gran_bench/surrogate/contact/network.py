"""The contact network: a learned solver of contacts that moves spheres by one frame."""

import math

import torch
from torch import Tensor, nn

from gran_bench.config import ContactModelConfig
from gran_bench.config.choices import PAIR_FADE, check_radius, given_or
from gran_bench.config.consistency import check_model
from gran_bench.scene import Scene
from gran_bench.state import FloatArray
from gran_bench.surrogate.contact.constants import DIAMETER, RAMP_NODES, WALL_FADE
from gran_bench.surrogate.contact.geometry import find_contacts
from gran_bench.surrogate.contact.kernels.fused import fused_solve
from gran_bench.surrogate.contact.memory import ContactMemory, follow_memory, gather, springs_of
from gran_bench.surrogate.contact.solver import solve_contacts
from gran_bench.surrogate.step import FrameState, Surrogate, wrap


class ContactNetwork(Surrogate):
    """A learned solver of contacts, K iterations a frame.

    A ballistic guess of the displacement, D = v Δt + g Δt², gives the contacts. In each iteration a perceptron sees a
    contact's gap, approach, slip, the impulse gathered there and the channels h of its particles, all in d/50 a frame,
    and answers with a normal displacement a, a tangential one τ = slip (b/s + 0.3 c) and messages to the channels:

        D_i += ½ (τ − a n),  D_j −= ½ (τ − a n),  q_{i,j} += 1.25 σ n × τ,  with q = r ω Δt.

    The answer fades to zero at the edge of the reach. Then each particle may take back a learned share of gravity's
    step, times the fade of its nearest contact at the guess: nothing without a contact. Contacts conserve linear
    momentum exactly. At the end x + D, D/Δt, q/(r Δt).

    With ``memory``, each contact carries the tangential displacement ξ that its surfaces have gathered
    (:mod:`gran_bench.surrogate.contact.memory`); the perceptrons see it and may push along it: τ += e ξ.

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
        self.diameter = DIAMETER
        self.velocity_kind, self.is_instantaneous = config.velocity, config.velocity == "instantaneous"
        self.has_memory = config.memory
        check_model(config)
        d = scene.filling.diameter
        check_radius(config, d, scene.period)
        self.unit = d / DIAMETER  # m
        self.reaches = (  # m
            given_or(config.radius_m, config.radius_diameters, d),
            given_or(config.wall_reach_m, config.wall_reach_diameters, d),
        )
        # Of a pair and of a wall: the gap at which an answer has faded to nothing, and the width of its fading, units.
        radius, wall_reach = (reach / self.unit for reach in self.reaches)
        self.fades = (radius - DIAMETER, PAIR_FADE * DIAMETER), (wall_reach, WALL_FADE * wall_reach)

        iterations, hidden, channels = config.iterations, config.hidden, config.channels
        inputs = len(RAMP_NODES) - 1 + 5 + channels + 2 * config.memory
        outputs = 3 + channels + config.memory + 2 * self.is_instantaneous
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

    def memories(
        self, scene: Scene, times: FloatArray, positions: FloatArray, angular_velocities: FloatArray
    ) -> list[ContactMemory] | None:
        """The springs at each of F stored frames; exact where the first one is the settled state."""
        return list(follow_memory(scene, times, positions, angular_velocities)) if self.has_memory else None

    def advance(self, state: FrameState, scene: Scene, time: float) -> FrameState:
        interval, unit = scene.frame_interval, self.unit
        to_frame, to_spin = interval / unit, 0.5 * self.diameter * interval
        gravity = state.velocity.new_tensor(scene.gravity) * interval
        position, fall = state.position / unit, gravity * to_frame
        # The ballistic frame in SI; all that follows is what contacts change of it, and nothing where there are none.
        fallen = state.velocity + gravity
        carried = fallen - 0.5 * gravity if self.is_instantaneous else fallen
        guess, spin = carried * to_frame, state.angular_velocity * to_spin

        with torch.no_grad():
            end = wrap((position + guess) * unit, scene.period).cpu().numpy()
            start = state.position.detach().cpu().numpy()
            contacts = find_contacts(scene, time, end, *self.reaches, start, state.near)
        springs = springs_of(state.memory, contacts).to(position) if self.has_memory else None
        on_cpu = position.device.type == "cpu" and position.dtype == torch.float32
        solve = fused_solve if self.config.backend == "fused" and on_cpu else solve_contacts
        displacement, new_spin, extra, extra_spin = solve(self, contacts, position, guess, spin, fall, springs)
        moved, turned = displacement - guess, new_spin - spin
        if self.is_instantaneous:
            velocity, turned = fallen + (moved + extra) / to_frame, turned + extra_spin
        else:
            velocity = fallen + moved / to_frame
        after = FrameState(
            wrap(state.position + (interval * carried + unit * moved), scene.period),
            velocity,
            state.angular_velocity + turned / to_spin,
            near=contacts.near,
        )
        if self.has_memory:
            ends = ((s.position, s.angular_velocity) for s in (state, after))
            plain = ([tensor.detach().cpu().numpy() for tensor in pair] for pair in zip(*ends, strict=True))
            after.memory = gather(scene, contacts, springs.cpu().numpy(), *plain)
        return after


def _uniform(shape: tuple[int, ...], fan_in: int) -> Tensor:
    """Weights uniform in ±1/√fan_in, the usual start of a linear layer."""
    return torch.empty(shape).uniform_(-1.0, 1.0) / math.sqrt(fan_in)
