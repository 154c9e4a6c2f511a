"""One frame ahead as a model has it and as the DEM has it: what every term of a loss looks at."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gran_bench.scene import Scene
from gran_bench.surrogate.step import FrameState, minimum_image


class LossError(ValueError):
    """A loss that cannot be computed for this model or scene; the message says which key to change."""


@dataclass(frozen=True)
class Target:
    """What the DEM says about one frame ahead.

    Attributes:
        position: ``(N, 3)`` m.
        velocity: ``(N, 3)`` m/s, of the same kind (mean or instantaneous) as the model's.
        angular_velocity: ``(N, 3)`` rad/s.
        velocity_before: ``(N, 3)`` m/s, of that kind, one frame earlier; without the training noise.
        mean_overlap: the DEM's own mean overlap of a contact of this frame, pairs and walls together, m.
    """

    position: Tensor
    velocity: Tensor
    angular_velocity: Tensor
    velocity_before: Tensor
    mean_overlap: float = 0.0


@dataclass(frozen=True)
class FrameAhead:
    """A predicted frame, the state that the model made it from, and the truth.

    Attributes:
        before: state at the frame's start, as the model was given it: predicted itself from the second frame ahead
            on, with the training noise at the first.
        predicted: state at the frame's end.
        target: the same instant in the DEM.
        scene: gives d, Δt, gravity, walls and the period.
        time: of the frame's start, s.
    """

    before: FrameState
    predicted: FrameState
    target: Target
    scene: Scene
    time: float

    @property
    def position_error(self) -> Tensor:
        """x̂ − x, the short way around where the scene is periodic, ``(N, 3)`` in d."""
        apart = minimum_image(self.predicted.position - self.target.position, self.scene.period)
        return apart / self.scene.filling.diameter

    def per_frame(self, velocity: Tensor) -> Tensor:
        """A velocity (m/s) as a displacement, in d a frame: v Δt / d."""
        return velocity * self.scene.frame_interval / self.scene.filling.diameter


def lengths(vectors: Tensor) -> Tensor:
    """Euclidean lengths of ``(..., 3)`` vectors, with a finite gradient at zero length."""
    return torch.sqrt(vectors.square().sum(dim=-1) + 1e-24)
