"""Terms that follow every sphere: errors of position, velocity, acceleration and spin, each a mean over spheres."""

from __future__ import annotations

import torch
from torch import Tensor

from gran_bench.config.registry import register_loss
from gran_bench.losses.frame_ahead import FrameAhead, LossError, lengths

HUBER_WIDTH = 0.01  # δ, particle diameters


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

    Huber's function over δ, so that it grows as `position_l2` does where errors are large, and its weight and the
    clip of the gradient mean the same. Within δ (0.5 mm of 50 mm spheres) the gradient falls to zero with the error.

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

    Both are whole accelerations; gravity is the same in the two, so this is the error of the contact acceleration as
    well. v̂ⁿ is what the model started the frame from. Its error, inherited from earlier frames or put there as noise,
    is not counted again: a model is held to the DEM's acceleration, not to putting right what came before. At the
    first frame without noise the term equals `velocity`.
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
