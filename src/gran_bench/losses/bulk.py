"""Terms that look at the bed as a whole: its flow, centre of mass, kinetic energy and speeds. Errors of single spheres
cancel in them, so that each leaves most of the motion open and wants a term of positions beside it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gran_bench.config.registry import register_loss
from gran_bench.losses.frame_ahead import FrameAhead, LossError, lengths
from gran_bench.scene import Scene

CELL = 0.1  # m, edge of the cells of the cross-section in `cell_displacement`
GYRATION = 0.4  # I / m r² of a solid sphere


@register_loss
def cell_displacement(ahead: FrameAhead) -> Tensor:
    """Σ_c n_c ‖⟨x̂ − x⟩_c‖ / N d over the cells c of the cross-section that the DEM's spheres lie in.

    Errors of single spheres average out within a cell; what stays is the error of the flow.
    """
    place = torch.floor(ahead.target.position[:, (0, 2)] / CELL).long()
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

    Rotation counts, on both sides alike, for a model that has spin; without it E_k is translational. Velocities are
    of the model's kind: means over a frame have less energy than those at its end, on both sides.

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
    found, true = lengths(ahead.predicted.velocity), lengths(ahead.target.velocity)
    return (torch.sort(found).values - torch.sort(true).values).abs().mean() / unit


def _gravity(scene: Scene, term: str) -> float:
    """‖g‖, m/s²."""
    size = math.hypot(*scene.gravity)
    if size == 0.0:
        raise LossError(f"loss.{term} > 0 is measured in units of gravity, and scene.gravity is 0; set loss.{term}=0")
    return size
