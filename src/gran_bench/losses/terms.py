"""Terms of a loss: of every sphere, of the bed as a whole, of contacts.

Errors of single spheres cancel in the terms of the bed, so that each leaves most of the motion open and wants a term of
positions beside it.
"""

import math

import numpy as np
import torch
from torch import Tensor

from gran_bench.config.registry import register_loss
from gran_bench.dem.outlet import taking_part
from gran_bench.losses.frame_ahead import FrameAhead, LossError, lengths
from gran_bench.neighbors import tree_pairs
from gran_bench.scene import Scene
from gran_bench.surrogate.step import minimum_image
from gran_bench.surrogate.walls import closest_point, frame_walls

HUBER_WIDTH = 0.01  # δ, particle diameters
CELL_DIAMETERS = 2.0  # edge of the cells of the cross-section in `cell_displacement`
GYRATION = 0.4  # I / m r² of a solid sphere
SMALLEST_ACCELERATION = 1.0e-9  # d a frame², mean of a sphere: below it a bed counts as free of contact forces


@register_loss
def position_l2(ahead: FrameAhead) -> Tensor:
    """Mean ‖x̂ − x‖ / d (the paper's eq. 3)."""
    return lengths(ahead.position_error).mean()


@register_loss
def position_mse(ahead: FrameAhead) -> Tensor:
    """Mean ‖x̂ − x‖² / d²."""
    return ahead.position_error.square().sum(dim=1).mean()


@register_loss
def huber(ahead: FrameAhead) -> Tensor:
    """Mean h(e) of e = ‖x̂ − x‖ / d: h = e²/2δ up to δ = 0.01, e − δ/2 beyond.

    Huber's function over δ, so that it grows as `position_l2` does where errors are large.

    Source: Huber (1964), Robust estimation of a location parameter, Annals of Mathematical Statistics 35.
    """
    squared = ahead.position_error.square().sum(dim=1)
    near = squared <= HUBER_WIDTH**2
    far_length = torch.sqrt(torch.where(near, torch.ones_like(squared), squared))
    return torch.where(near, squared / (2.0 * HUBER_WIDTH), far_length - 0.5 * HUBER_WIDTH).mean()


@register_loss
def velocity(ahead: FrameAhead) -> Tensor:
    """Mean ‖v̂ − v‖ Δt / d."""
    return lengths(ahead.per_frame(ahead.predicted.velocity - ahead.target.velocity)).mean()


@register_loss
def acceleration(ahead: FrameAhead) -> Tensor:
    """Mean ‖â − a‖ Δt² / d of one frame, with â = (v̂ⁿ⁺¹ − v̂ⁿ)/Δt and a = (vⁿ⁺¹ − vⁿ)/Δt.

    v̂ⁿ is what the model started the frame from, noise and earlier errors included: a model is held to the DEM's
    acceleration, not to putting right what came before. At the first frame without noise the term equals `velocity`.
    """
    gained = ahead.predicted.velocity - ahead.before.velocity
    wanted = ahead.target.velocity - ahead.target.velocity_before
    return lengths(ahead.per_frame(gained - wanted)).mean()


@register_loss
def spin(ahead: FrameAhead) -> Tensor:
    """Mean ‖ω̂ − ω‖ r Δt / d.

    Raises:
        LossError: a model without spin.
    """
    if ahead.predicted.angular_velocity is None:
        raise LossError("loss.spin > 0 needs a model with spin; set loss.spin=0 or choose model=contact")
    error = ahead.predicted.angular_velocity - ahead.target.angular_velocity
    return lengths(ahead.per_frame(error * ahead.scene.filling.radius)).mean()


@register_loss
def cell_displacement(ahead: FrameAhead) -> Tensor:
    """Σ_c n_c ‖⟨x̂ − x⟩_c‖ / N d over the cells c of the cross-section that the DEM's spheres lie in.

    Errors of single spheres average out within a cell; what stays is the error of the flow.
    """
    edge = CELL_DIAMETERS * ahead.scene.filling.diameter
    place = torch.floor(ahead.target.position[:, (0, 2)] / edge).long()
    place -= place.amin(dim=0)
    cell = place[:, 0] * (place[:, 1].max() + 1) + place[:, 1]
    error = ahead.position_error
    summed = error.new_zeros(int(cell.max()) + 1, 3).index_add(0, cell, error)
    return lengths(summed).sum() / len(error)


@register_loss
def center_of_mass(ahead: FrameAhead) -> Tensor:
    """‖⟨x̂ − x⟩‖ / d over all spheres, which are of one mass."""
    return lengths(ahead.position_error.mean(dim=0))


@register_loss
def energy(ahead: FrameAhead) -> Tensor:
    """|Ê_k − E_k| / max(E_k, N m g d), with E_k = Σ ½ m v² + Σ ½ I ω² and I = ⅖ m r² of a solid sphere.

    Without spin E_k is translational, on both sides. Velocities are of the model's kind.

    Raises:
        LossError: a scene without gravity, whose bed at rest has no energy to compare with.
    """
    floor = _gravity(ahead.scene, "energy") * ahead.scene.filling.diameter
    spins = ahead.predicted.angular_velocity is not None
    found = _specific_energy(ahead.predicted.velocity, ahead.predicted.angular_velocity, ahead.scene)
    true = _specific_energy(ahead.target.velocity, ahead.target.angular_velocity if spins else None, ahead.scene)
    return (found - true).abs() / true.clamp_min(floor)


def _specific_energy(velocity: Tensor, angular_velocity: Tensor | None, scene: Scene) -> Tensor:
    """Kinetic energy of a sphere over its mass, mean over spheres, m²/s²."""
    squared = velocity.square().sum(dim=1)
    if angular_velocity is not None:
        squared = squared + GYRATION * scene.filling.radius**2 * angular_velocity.square().sum(dim=1)
    return 0.5 * squared.mean()


@register_loss
def speed_distribution(ahead: FrameAhead) -> Tensor:
    """Wasserstein-1 distance of the speeds, Σ_i |ŝ_(i) − s_(i)| / N √(g d) with both sorted.

    Raises:
        LossError: a scene without gravity, which has no such speed.
    """
    unit = math.sqrt(_gravity(ahead.scene, "speed_distribution") * ahead.scene.filling.diameter)
    found, true = lengths(ahead.predicted.velocity / unit), lengths(ahead.target.velocity / unit)
    return (torch.sort(found).values - torch.sort(true).values).abs().mean()


def _gravity(scene: Scene, term: str) -> float:
    """‖g‖, m/s²."""
    size = math.hypot(*scene.gravity)
    if size == 0.0:
        raise LossError(f"loss.{term} > 0 is measured in units of gravity, and scene.gravity is 0; set loss.{term}=0")
    return size


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
    nothing. One NaN, attached to the graph, where a position is not finite and so has no neighbours.
    """
    if not torch.isfinite(position).all():
        return (position.sum() * math.nan).reshape(1)
    inside = taking_part(scene, position.detach().cpu().numpy())
    if not inside.all():
        position = position[torch.from_numpy(inside).to(position.device)]
    diameter, radius = scene.filling.diameter, scene.filling.radius
    found = tree_pairs(position.detach().cpu().double().numpy(), diameter, scene.period)
    pairs = torch.from_numpy(np.ascontiguousarray(found)).to(position.device)
    apart = minimum_image(position[pairs[:, 0]] - position[pairs[:, 1]], scene.period)
    overlaps = [diameter - torch.sqrt(apart.square().sum(dim=1) + (2e-11 * diameter) ** 2)]
    for shape in frame_walls(scene, time).after:
        overlap = radius - closest_point(shape, position)[0]
        overlaps.append(overlap[overlap > 0])
    return torch.cat(overlaps)


@register_loss
def momentum(ahead: FrameAhead) -> Tensor:
    """‖Σ m a_pp‖ / Σ ‖m a_pp‖: the share of the particle–particle accelerations that nobody answers.

    0 where action equals reaction, 1 where all push one way; the masses are equal and cancel. The sum under the line
    is at least 1e-9 d/Δt² a sphere, so that a bed out of contact costs 0.

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
