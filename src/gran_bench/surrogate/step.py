"""A surrogate: the state that it carries through a frame, gravity → network → Newton, and how a config makes one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from gran_bench.config import BoundaryConfig, CconvModelConfig, TrainConfig
from gran_bench.config.registry import MODELS
from gran_bench.config.rules import Section, checked
from gran_bench.dem.outlet import taking_part
from gran_bench.scene import Scene
from gran_bench.state import FloatArray
from gran_bench.surrogate.trained_for import TrainedFor


@dataclass
class FrameState:
    """What a surrogate carries from frame to frame."""

    position: Tensor  # (N, 3) m; y lies in [−L/2, L/2) where the scene is periodic
    velocity: Tensor  # (N, 3) m/s, of the model's velocity_kind
    angular_velocity: Tensor | None = None  # (N, 3) rad/s, or None for a model that has no spin
    memory: object | None = None  # whatever else a model keeps of the past; its `renumbered` follows spheres that leave
    # (N, 3) m/s², what particles gave each other in the frame that ends here; None where it is not told from walls'
    pair_acceleration: Tensor | None = None
    near: object | None = None  # pairs that a model has listed, for it to look among in the next frame

    def of_each(self, change: Callable[[Tensor], Tensor]) -> FrameState:
        """The same state with each of its tensors changed."""
        values = vars(self).items()
        return FrameState(**{name: change(value) if isinstance(value, Tensor) else value for name, value in values})

    def detached(self) -> FrameState:
        """The same state, cut off from the frames that made it."""
        return self.of_each(Tensor.detach)


class Surrogate(nn.Module):
    """A learned map from one frame to the next, at any number of particles."""

    velocity_kind: str = "mean"  # over the frame that ends at the state, or instantaneous
    uses_spin: bool = False  # whether angular velocities are part of the state
    has_memory: bool = False  # whether the state carries a memory of earlier frames
    trained_for: TrainedFor | None = None  # what it was made for, which a rollout compares

    def begin(
        self,
        scene: Scene,
        position: Tensor,
        velocity: Tensor,
        angular_velocity: Tensor | None = None,
        previous_position: Tensor | None = None,
        memory: object | None = None,
    ) -> FrameState:
        """The state to start from.

        A model of mean velocities starts from (xⁿ − xⁿ⁻¹)/Δt. The settled state has no xⁿ⁻¹: there, and for a model
        of instantaneous velocities, the stored velocity is taken.

        Args:
            position, velocity: ``(N, 3)`` m and m/s, as stored.
            angular_velocity: ``(N, 3)`` rad/s; needed by a model that uses spin.
            previous_position: ``(N, 3)`` m, a frame earlier.
            memory: of the start frame, as :meth:`memories` gives it; None at the settled state.

        Raises:
            ValueError: a model of spin that is given none, or a value that is not ``(N, 3)`` or not finite.
        """
        if self.uses_spin and angular_velocity is None:
            raise ValueError(f"{type(self).__name__} carries spin; give angular_velocity (N, 3) in rad/s to begin()")
        given = {"position": position, "velocity": velocity, "angular_velocity": angular_velocity}
        for name, values in given.items():
            if values is not None and values.shape != (len(position), 3):
                raise ValueError(f"{name} has shape {tuple(values.shape)}; give begin() one of ({len(position)}, 3)")
            if values is not None and not torch.isfinite(values).all():
                raise ValueError(f"{name} is not finite; give begin() finite values, a model can make nothing of it")
        if self.velocity_kind == "mean" and previous_position is not None:
            velocity = minimum_image(position - previous_position, scene.period) / scene.frame_interval
        spin, memory = angular_velocity if self.uses_spin else None, memory if self.has_memory else None
        return FrameState(position, velocity, spin, memory)

    def memories(
        self, scene: Scene, times: FloatArray, positions: FloatArray, angular_velocities: FloatArray
    ) -> list[object] | None:
        """What the model remembers at each of F stored frames (s, m, rad/s), from the settled one on; or None."""
        return None

    def forward(self, state: FrameState, scene: Scene, time: float) -> FrameState:
        """The state one frame later, from ``time`` to ``time + scene.frame_interval`` (s); differentiable.

        A sphere whose centre is beyond the scene's outlet keeps its last state and touches nothing, as in the DEM.
        """
        inside = taking_part(scene, state.position.detach().cpu().numpy())
        if inside.all():
            return self.advance(state, scene, time)
        return _rejoined(state, inside, lambda part: self.advance(part, scene, time)) if inside.any() else state

    def advance(self, state: FrameState, scene: Scene, time: float) -> FrameState:
        """:meth:`forward` of spheres that all take part."""
        raise NotImplementedError

    @property
    def parameter_count(self) -> int:
        """Number of trained weights."""
        return sum(p.numel() for p in self.parameters() if p.requires_grad)

    def __str__(self) -> str:
        return f"{type(self).__name__}, {self.parameter_count:,} parameters"


class NewtonSurrogate(Surrogate):
    """A surrogate whose network gives the acceleration of contacts; gravity and Newton's law do the rest.

    v* = vⁿ + g Δt;  a = network(x*, v*);  vⁿ⁺¹ = v* + a Δt.

    * ``update = mean``: x* = xⁿ + Δt v*, xⁿ⁺¹ = xⁿ + Δt vⁿ⁺¹; velocities are means over a frame.
    * ``update = trapezoid``: x* = xⁿ + Δt (vⁿ + v*)/2, xⁿ⁺¹ = xⁿ + Δt (vⁿ + vⁿ⁺¹)/2; velocities are instantaneous.

    Args:
        update: ``mean`` or ``trapezoid``.

    Raises:
        ConfigError: another update.
    """

    def __init__(self, update: str = "mean") -> None:
        super().__init__()
        self.update = checked(CconvModelConfig, "update", update)
        self.velocity_kind = "mean" if update == "mean" else "instantaneous"

    def acceleration(self, position: Tensor, velocity: Tensor, scene: Scene, time: float) -> Tensor:
        """Acceleration of contacts over the frame from ``time``, s, at x* (m) and v* (m/s): ``(N, 3)`` m/s²."""
        raise NotImplementedError

    def accelerations(
        self, position: Tensor, velocity: Tensor, scene: Scene, time: float
    ) -> tuple[Tensor, Tensor | None]:
        """:meth:`acceleration`, and the part of it that particles give each other, None where it is not told apart."""
        return self.acceleration(position, velocity, scene, time), None

    def advance(self, state: FrameState, scene: Scene, time: float) -> FrameState:
        interval, before = scene.frame_interval, state.velocity

        def moved(velocity: Tensor) -> Tensor:
            travel = velocity if self.update == "mean" else 0.5 * (before + velocity)
            return wrap(state.position + interval * travel, scene.period)

        predicted = before + before.new_tensor(scene.gravity) * interval if scene.needs.gravity else before
        guess = moved(predicted)
        if torch.isfinite(guess).all() and torch.isfinite(predicted).all():
            acceleration, of_pairs = self.accelerations(guess, predicted, scene, time)
            velocity = predicted + interval * acceleration
        else:  # neighbours of nowhere do not exist: the failure shows
            velocity = of_pairs = torch.full_like(predicted, torch.nan)
        return FrameState(moved(velocity), velocity, pair_acceleration=of_pairs)


def _rejoined(state: FrameState, inside: np.ndarray, advance: Callable[[FrameState], FrameState]) -> FrameState:
    """The whole state after the spheres that are ``inside``, ``(N,)`` bool, were moved on; the others as they were."""
    number = np.flatnonzero(inside)
    rows = torch.from_numpy(number).to(state.position.device)
    part, memory = state.of_each(lambda values: values.index_select(0, rows)), state.memory
    if memory is not None:
        part.memory = memory.renumbered(np.where(inside, np.cumsum(inside) - 1, -1), len(number))
    part.pair_acceleration = None
    after = advance(part)
    if after.memory is not None:
        after.memory = after.memory.renumbered(number, len(inside))
    state = replace(state, pair_acceleration=torch.zeros_like(state.position))
    for name, values in vars(state).items():
        moved = getattr(after, name)
        if isinstance(moved, Tensor) and isinstance(values, Tensor):
            setattr(after, name, values.index_copy(0, rows, moved))
    return after


def build_model(model: Section, boundary: BoundaryConfig, scene: Scene, speeds_rpm: Sequence[float] = ()) -> Surrogate:
    """The surrogate that a config names, with fresh weights from torch's global generator.

    Args:
        model: its ``name`` is a registered one: ``ccnn``, ``radial`` (a continuous-convolution network with the lattice
            or the radial kernel), ``contact``, ``gns`` (a graph network), or a plugin's.
        boundary: how a model sees the walls that has no way of its own.
        scene: that the model is made for; a rollout in another one is held against it.
        speeds_rpm: of the drum in the training cases, rpm.

    Raises:
        ConfigError: no model's config, or values that do not fit together or to the scene's spheres.
    """
    checked(TrainConfig, "model", model)
    make = MODELS[model.name]  # imports the model's module: a model that is not used costs no import
    built = make(model, scene) if make.own_walls else make(model, boundary, scene)
    built.trained_for = TrainedFor(scene, tuple(speeds_rpm))
    return built


def wrap(position: Tensor, period: float) -> Tensor:
    """Positions ``(..., 3)`` with y in [−L/2, L/2), as the DEM stores them; unchanged where the period L is 0."""
    if period <= 0.0:
        return position
    turns = torch.floor(position.detach()[..., 1] / period + 0.5)
    return position - turns[..., None] * position.new_tensor((0.0, period, 0.0))


def minimum_image(vector: Tensor, period: float) -> Tensor:
    """The shortest periodic image of a difference, ``(..., 3)`` m: :func:`wrap`, read as a difference."""
    return wrap(vector, period)
