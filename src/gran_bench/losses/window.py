"""The loss of a window of frames ahead: terms, each dimensionless in d and Δt, weighted by frame and added.

A term of weight zero is never computed. The weights of the frames multiply all terms but the spin's,
which has frame weights of its own (a spin error grows faster with the horizon than a position error).
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from gran_bench.config import LossConfig
from gran_bench.config.choices import loss_terms, weighed_terms
from gran_bench.config.registry import LOSS_TERMS
from gran_bench.losses.frame_ahead import FrameAhead, LossError


def frame_weights(kind: str, frames: int, discount: float = 0.8) -> list[float]:
    """Weights w₁ … w_F of the frames ahead.

    Args:
        kind: ``uniform`` 1; ``discounted`` γᵏ⁻¹; ``inverse`` 1/k; ``rising`` k/F.
        frames: F.
        discount: γ.

    Raises:
        LossError: an unknown kind.
    """
    shapes: dict[str, Callable[[int], float]] = {
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

    def weight_of(self, name: str, frame: int, frames: int) -> float:
        """Weight of a term at frame ``frame`` (1 … F) of ``frames``."""
        kind = self.config.spin_frame_weights if name == "spin" else self.config.frame_weights
        return self.weights[name] * frame_weights(kind, frames, self.config.discount)[frame - 1]

    def terms(self, ahead: FrameAhead, frame: int, frames: int) -> dict[str, Tensor]:
        """Weighted terms of frame ``frame`` (1 … F) by name; their sum is the frame's share of the loss."""
        return {name: self.weight_of(name, frame, frames) * LOSS_TERMS[name](ahead) for name in self.weights}
