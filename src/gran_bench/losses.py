"""Loss terms of a window of frames ahead: each a mean over particles, dimensionless in d and Δt.

A term of weight zero is never computed. The weights of the frames multiply all terms but the spin's,
which has frame weights of its own (a spin error grows faster with the horizon than a position error).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from gran_bench.config import LossConfig
from gran_bench.neighbors import tree_pairs
from gran_bench.scene import Cylinder, Scene
from gran_bench.surrogate.step import FrameState, minimum_image

CELL = 0.1  # m, edge of the cells of the cross-section in `cell_displacement`


class LossError(ValueError):
    """A loss that cannot be computed for this model; the message says which key to change."""


@dataclass(frozen=True)
class Target:
    """What the DEM says about one frame ahead.

    Attributes:
        position: ``(N, 3)`` m.
        velocity: ``(N, 3)`` m/s, of the same kind (mean or instantaneous) as the model's.
        angular_velocity: ``(N, 3)`` rad/s.
        overlap_per_particle: the DEM's own sum of pair and wall overlaps of this frame divided by N, m.
    """

    position: Tensor
    velocity: Tensor
    angular_velocity: Tensor
    overlap_per_particle: float = 0.0


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


def _mean_length(vectors: Tensor) -> Tensor:
    """Mean Euclidean length, with a finite gradient at zero length."""
    return torch.sqrt(vectors.square().sum(dim=1) + 1e-24).mean()


def position_l2(predicted: FrameState, target: Target, scene: Scene) -> Tensor:
    """Mean ‖x̂ − x‖ / d (the paper's eq. 3)."""
    return _mean_length(minimum_image(predicted.position - target.position, scene.period)) / scene.filling.diameter


def position_mse(predicted: FrameState, target: Target, scene: Scene) -> Tensor:
    """Mean ‖x̂ − x‖² / d²."""
    error = minimum_image(predicted.position - target.position, scene.period)
    return error.square().sum(dim=1).mean() / scene.filling.diameter**2


def velocity(predicted: FrameState, target: Target, scene: Scene) -> Tensor:
    """Mean ‖v̂ − v‖ Δt / d."""
    return _mean_length(predicted.velocity - target.velocity) * scene.frame_interval / scene.filling.diameter


def spin(predicted: FrameState, target: Target, scene: Scene) -> Tensor:
    """Mean ‖ω̂ − ω‖ r Δt / d."""
    if predicted.angular_velocity is None:
        raise LossError("loss.spin > 0 needs a model with spin; set loss.spin=0 or choose model=contact")
    error = _mean_length(predicted.angular_velocity - target.angular_velocity)
    return error * scene.filling.radius * scene.frame_interval / scene.filling.diameter


def overlap(predicted: FrameState, target: Target, scene: Scene) -> Tensor:
    """(Σ overlaps of pairs and walls − the DEM's own, if positive) / N d.

    The sum over contacts is compared with the DEM's sum at the same frame, so that soft contacts that the
    DEM itself has cost nothing.
    """
    total = total_overlap(predicted.position, scene)
    excess = torch.relu(total / len(predicted.position) - target.overlap_per_particle)
    return excess / scene.filling.diameter


def total_overlap(position: Tensor, scene: Scene) -> Tensor:
    """Sum of all pair and wall overlaps, m; differentiable in ``position`` ``(N, 3)``."""
    diameter, radius = scene.filling.diameter, scene.filling.radius
    found = tree_pairs(position.detach().cpu().double().numpy(), diameter, scene.period)
    pairs = torch.from_numpy(np.ascontiguousarray(found)).to(position.device)
    apart = minimum_image(position[pairs[:, 0]] - position[pairs[:, 1]], scene.period)
    total = torch.relu(diameter - torch.sqrt(apart.square().sum(dim=1) + 1e-24)).sum()
    for wall in scene.walls:
        from_point = position - position.new_tensor(wall.point)
        if isinstance(wall, Cylinder):
            axis = position.new_tensor(wall.axis)
            across = from_point - (from_point @ axis)[:, None] * axis
            gap = wall.radius - torch.sqrt(across.square().sum(dim=1) + 1e-24) - radius
        else:
            gap = from_point @ position.new_tensor(wall.normal) - radius
        total = total + torch.relu(-gap).sum()
    return total


def cell_displacement(predicted: FrameState, target: Target, scene: Scene) -> Tensor:
    """Σ_c n_c ‖⟨x̂ − x⟩_c‖ / N d over the cells c of the cross-section that the DEM's spheres lie in.

    Errors of single spheres average out within a cell; what stays is the error of the flow.
    """
    place = torch.floor(target.position[:, (0, 2)] / CELL).long()
    place -= place.amin(dim=0)
    cell = place[:, 0] * (place[:, 1].max() + 1) + place[:, 1]
    error = minimum_image(predicted.position - target.position, scene.period)
    summed = error.new_zeros(int(cell.max()) + 1, 3).index_add(0, cell, error)
    lengths = torch.sqrt(summed.square().sum(dim=1) + 1e-24)
    return lengths.sum() / len(error) / scene.filling.diameter


TERMS: dict[str, Callable[[FrameState, Target, Scene], Tensor]] = {
    "position_l2": position_l2,
    "position_mse": position_mse,
    "velocity": velocity,
    "spin": spin,
    "overlap": overlap,
    "cell_displacement": cell_displacement,
}


class WindowLoss:
    """The weighted sum over the frames ahead, L = Σ_k w_k Σ_terms weight · term(k) (the paper's eq. 4).

    Args:
        config: weights of the terms and shape of the frame weights.

    Raises:
        LossError: no term has a positive weight.
    """

    def __init__(self, config: LossConfig) -> None:
        known = {f.name for f in fields(config)}
        self.config = config
        self.weights = {name: getattr(config, name) for name in TERMS if name in known and getattr(config, name) > 0}
        if not self.weights:
            raise LossError(f"loss has no term with a positive weight; set one of {', '.join(TERMS)}")

    def weight_of(self, name: str, frame: int, frames: int) -> float:
        """Weight of a term at frame ``frame`` (1 … F) of ``frames``."""
        kind = self.config.spin_frame_weights if name == "spin" else self.config.frame_weights
        return self.weights[name] * frame_weights(kind, frames, self.config.discount)[frame - 1]

    def terms(self, predicted: FrameState, target: Target, scene: Scene, frame: int, frames: int) -> dict[str, Tensor]:
        """Weighted terms of one frame by name; their sum is the frame's share of the loss."""
        return {
            name: self.weight_of(name, frame, frames) * TERMS[name](predicted, target, scene) for name in self.weights
        }
