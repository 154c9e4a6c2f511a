"""What a loss looks at, one frame ahead of a model and of the DEM, and what it makes of a window of such frames."""

from dataclasses import dataclass

import torch
from torch import Tensor

from gran_bench.config import LossConfig
from gran_bench.config.choices import loss_terms, weighed_terms
from gran_bench.config.registry import LOSS_TERMS
from gran_bench.scene import Scene
from gran_bench.surrogate.step import FrameState, minimum_image


class LossError(ValueError):
    """A loss that cannot be computed for this model or scene; the message says which key to change."""


@dataclass(frozen=True)
class Target:
    """What the DEM says about one frame ahead."""

    position: Tensor  # (N, 3) m
    velocity: Tensor  # (N, 3) m/s, of the same kind (mean or instantaneous) as the model's
    angular_velocity: Tensor  # (N, 3) rad/s
    velocity_before: Tensor  # (N, 3) m/s, of that kind, one frame earlier; without the training noise
    mean_overlap: float = 0.0  # m, of a contact of this frame, pairs and walls together


@dataclass(frozen=True)
class FrameAhead:
    """A predicted frame, the state that the model made it from, and the truth."""

    before: FrameState  # at the frame's start, as the model was given it: with the training noise, or predicted itself
    predicted: FrameState  # at its end
    target: Target  # the same instant in the DEM
    scene: Scene
    time: float  # s, of the frame's start

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


def frame_weights(kind: str, frames: int, discount: float = 0.8) -> list[float]:
    """Weights w₁ … w_F of the frames ahead.

    Args:
        kind: ``uniform`` 1; ``discounted`` γᵏ⁻¹; ``inverse`` 1/k; ``rising`` k/F.
        frames: F.
        discount: γ.

    Raises:
        LossError: an unknown kind.
    """
    shapes = {
        "uniform": lambda k: 1.0,
        "discounted": lambda k: discount ** (k - 1),
        "inverse": lambda k: 1.0 / k,
        "rising": lambda k: k / frames,
    }
    if kind not in shapes:
        raise LossError(f"loss.frame_weights={kind!r} is unknown; choose one of {', '.join(shapes)}")
    return [shapes[kind](k) for k in range(1, frames + 1)]


class WindowLoss:
    """The weighted sum over the frames ahead, L = Σ_k w_k Σ_terms weight · term(k) (the paper's eq. 4).

    Args:
        config: weights of the terms and shape of the frame weights.

    Raises:
        LossError: no term has a positive weight.
    """

    def __init__(self, config: LossConfig) -> None:
        self.config = config
        # In the order of the keys, in which the terms are added.
        self.weights = {name: getattr(config, name) for name in weighed_terms(config)}
        if not self.weights:
            raise LossError(f"loss has no term with a positive weight; set one of {', '.join(loss_terms())}")

    def terms(self, ahead: FrameAhead, frame: int, frames: int) -> dict[str, Tensor]:
        """Weighted terms of frame ``frame`` (1 … F) by name; their sum is the frame's share of the loss.

        A term of weight zero is never computed. The spin has frame weights of its own: its error grows faster with the
        horizon than one of positions.
        """
        config, found = self.config, {}
        for name, weight in self.weights.items():
            kind = config.spin_frame_weights if name == "spin" else config.frame_weights
            found[name] = weight * frame_weights(kind, frames, config.discount)[frame - 1] * LOSS_TERMS[name](ahead)
        return found
