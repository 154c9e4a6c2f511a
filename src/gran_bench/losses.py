"""Loss terms of a window of frames ahead: each a mean over particles, dimensionless in d and Δt.

A term of weight zero is never computed. The weights of the frames multiply all terms but the spin's,
which has frame weights of its own (a spin error grows faster with the horizon than a position error).
"""

from __future__ import annotations

import math
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
        mean_overlap: the DEM's own mean overlap of a contact of this frame, pairs and walls together, m.
    """

    position: Tensor
    velocity: Tensor
    angular_velocity: Tensor
    mean_overlap: float = 0.0


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
    """Σ_contacts max(0, overlap − the DEM's own mean overlap of a contact) / N d, over pairs and walls.

    Contacts as soft as the DEM's cost nothing, and one that is too deep is not paid for by others that are shallow.
    NaN where a predicted position is not finite.
    """
    excess = torch.relu(contact_overlaps(predicted.position, scene) - target.mean_overlap)
    return excess.sum() / len(predicted.position) / scene.filling.diameter


def contact_overlaps(position: Tensor, scene: Scene) -> Tensor:
    """Overlaps of the contacts of pairs and walls, ``(C,)`` m; differentiable in ``position`` ``(N, 3)``.

    A position that is not finite has no neighbours: the result is then one NaN, attached to the graph, so that the
    loss is seen to diverge where all other terms are.
    """
    if not torch.isfinite(position).all():
        return (position.sum() * math.nan).reshape(1)
    diameter, radius = scene.filling.diameter, scene.filling.radius
    found = tree_pairs(position.detach().cpu().double().numpy(), diameter, scene.period)
    pairs = torch.from_numpy(np.ascontiguousarray(found)).to(position.device)
    apart = minimum_image(position[pairs[:, 0]] - position[pairs[:, 1]], scene.period)
    overlaps = [diameter - torch.sqrt(apart.square().sum(dim=1) + 1e-24)]
    for wall in scene.walls:
        from_point = position - position.new_tensor(wall.point)
        if isinstance(wall, Cylinder):
            axis = position.new_tensor(wall.axis)
            across = from_point - (from_point @ axis)[:, None] * axis
            gap = wall.radius - torch.sqrt(across.square().sum(dim=1) + 1e-24) - radius
        else:
            gap = from_point @ position.new_tensor(wall.normal) - radius
        overlaps.append(-gap[gap < 0])
    return torch.cat(overlaps)


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
