"""Terms that look at contacts: how deep they are, and whether two spheres answer each other alike."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from gran_bench.config.registry import register_loss
from gran_bench.dem.outlet import taking_part
from gran_bench.losses.frame_ahead import FrameAhead, LossError
from gran_bench.neighbors import tree_pairs
from gran_bench.scene import Scene
from gran_bench.surrogate.step import minimum_image
from gran_bench.surrogate.walls import closest_point, frame_walls

SMALLEST_ACCELERATION = 1.0e-9  # d a frame², mean of a sphere: below it a bed counts as free of contact forces


@register_loss
def overlap(ahead: FrameAhead) -> Tensor:
    """Σ_contacts max(0, overlap − the DEM's own mean overlap of a contact) / N d, over pairs and walls.

    Contacts as soft as the DEM's cost nothing, and one that is too deep is not paid for by others that are shallow.
    NaN where a predicted position is not finite.
    """
    found = contact_overlaps(ahead.predicted.position, ahead.scene, ahead.time)
    excess = torch.relu(found - ahead.target.mean_overlap)
    return excess.sum() / len(ahead.predicted.position) / ahead.scene.filling.diameter


def contact_overlaps(position: Tensor, scene: Scene, time: float) -> Tensor:
    """Overlaps of the contacts of pairs and walls, ``(C,)`` m; differentiable in ``position`` ``(N, 3)``.

    Walls are where they are at the end of the frame that starts at ``time``, s. Spheres beyond an outlet touch
    nothing. A position that is not finite has no neighbours: the result is then one NaN, attached to the graph, so that
    the loss is seen to diverge where all other terms are.
    """
    if not torch.isfinite(position).all():
        return (position.sum() * math.nan).reshape(1)
    inside = taking_part(scene, position.detach().cpu().numpy())
    if inside is not None:
        position = position[torch.from_numpy(inside).to(position.device)]
    diameter, radius = scene.filling.diameter, scene.filling.radius
    found = tree_pairs(position.detach().cpu().double().numpy(), diameter, scene.period)
    pairs = torch.from_numpy(np.ascontiguousarray(found)).to(position.device)
    apart = minimum_image(position[pairs[:, 0]] - position[pairs[:, 1]], scene.period)
    overlaps = [diameter - torch.sqrt(apart.square().sum(dim=1) + 1e-24)]
    for shape in frame_walls(scene, time).after:
        overlap = radius - closest_point(shape, position)[0]
        overlaps.append(overlap[overlap > 0])
    return torch.cat(overlaps)


@register_loss
def momentum(ahead: FrameAhead) -> Tensor:
    """‖Σ m a_pp‖ / Σ ‖m a_pp‖: the share of the particle–particle accelerations that nobody answers.

    0 where action equals reaction, 1 where all push one way; the masses are equal and cancel. It looks at the model
    alone and needs no target. The sum under the line is at least 1e-9 d/Δt² a sphere, so that a bed out of contact
    costs 0.

    Raises:
        LossError: a model that does not tell pairs and walls apart, or whose contacts conserve momentum anyway.
    """
    pairs = ahead.predicted.pair_acceleration
    if pairs is None:
        raise LossError("loss.momentum > 0 needs a model with pair accelerations; set loss.momentum=0")
    moved = ahead.per_frame(pairs * ahead.scene.frame_interval)
    # The norm's own gradient is 0 at length 0.
    total = torch.linalg.vector_norm(moved, dim=1).sum()
    return torch.linalg.vector_norm(moved.sum(dim=0)) / total.clamp_min(SMALLEST_ACCELERATION * len(moved))
