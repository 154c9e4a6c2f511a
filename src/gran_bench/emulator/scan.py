"""Driven decaying oscillations, frame after frame: h_t = λ_t h_{t−1} + (1 − |λ_t|) u_t, compiled, with its gradient."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor


@numba.njit(error_model="numpy", cache=True, nogil=True, fastmath=True)
def _forward(size: np.ndarray, cosine: np.ndarray, sine: np.ndarray, drive: np.ndarray, state: np.ndarray) -> None:
    modes = size.shape[2]
    for run in range(size.shape[0]):
        for k in range(2 * modes):
            state[run, 0, k] = drive[run, 0, k] * (1.0 - size[run, 0, k % modes])
        for frame in range(1, size.shape[1]):
            for k in range(modes):
                share = size[run, frame, k]
                real, imaginary = share * cosine[run, frame, k], share * sine[run, frame, k]
                x, y = state[run, frame - 1, k], state[run, frame - 1, modes + k]
                gain = 1.0 - share
                state[run, frame, k] = real * x - imaginary * y + gain * drive[run, frame, k]
                state[run, frame, modes + k] = real * y + imaginary * x + gain * drive[run, frame, modes + k]


@numba.njit(error_model="numpy", cache=True, nogil=True, fastmath=True)
def _backward(
    size: np.ndarray, cosine: np.ndarray, sine: np.ndarray, drive: np.ndarray, state: np.ndarray, slope: np.ndarray,
    carry: np.ndarray, of_size: np.ndarray, of_angle: np.ndarray, of_drive: np.ndarray,
) -> None:  # fmt: skip
    """From the slope at each state to those at |λ|, arg λ and u; ``carry`` ``(2K,)`` is room to work in."""
    modes, last = size.shape[2], size.shape[1] - 1
    for run in range(size.shape[0]):
        carry[:] = 0.0
        for frame in range(last, -1, -1):
            for k in range(modes):
                a, b = slope[run, frame, k] + carry[k], slope[run, frame, modes + k] + carry[modes + k]
                share, c, s = size[run, frame, k], cosine[run, frame, k], sine[run, frame, k]
                of_drive[run, frame, k], of_drive[run, frame, modes + k] = a * (1.0 - share), b * (1.0 - share)
                of_size[run, frame, k] = -(a * drive[run, frame, k] + b * drive[run, frame, modes + k])
                of_angle[run, frame, k] = 0.0
                if frame > 0:
                    x, y = state[run, frame - 1, k], state[run, frame - 1, modes + k]
                    along, across = a * x + b * y, b * x - a * y
                    of_size[run, frame, k] += along * c + across * s
                    of_angle[run, frame, k] = share * (across * c - along * s)
                carry[k], carry[modes + k] = share * (c * a + s * b), share * (c * b - s * a)


class DrivenModes(torch.autograd.Function):
    """States of K modes, ``(B, F, 2K)`` with real parts first; `driven_by_frames` is the reference and says the rest.

    λ_t = e^{(−r + iα) γ_t} with the logarithm of the pace γ ``(B, F, K)``, the rate r and the angle α of a frame,
    ``(K,)`` each, and the drive u ``(B, F, 2K)``.
    """

    @staticmethod
    def forward(ctx: Any, log_pace: Tensor, drive: Tensor, rate: Tensor, angle: Tensor) -> Tensor:
        pace, drive = torch.exp(log_pace.detach()).contiguous(), drive.detach().contiguous()
        size, turned = torch.exp(-pace * rate.detach()), pace * angle.detach()
        kept = size, torch.cos(turned), torch.sin(turned), drive, torch.empty_like(drive)
        _forward(*(each.numpy() for each in kept))
        ctx.save_for_backward(*kept, pace, rate.detach(), angle.detach())
        return kept[-1]

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        *kept, pace, rate, angle = ctx.saved_tensors
        size, drive = kept[0], kept[3]
        carry = drive.new_empty(drive.shape[-1])
        of_size, of_angle, of_drive = torch.empty_like(size), torch.empty_like(size), torch.empty_like(drive)
        given = *kept, slope.contiguous(), carry, of_size, of_angle, of_drive
        _backward(*(each.numpy() for each in given))
        # ∂/∂ ln γ has γ |λ| and γ in common with the two constants of a mode.
        of_size, of_angle = of_size * size * pace, of_angle * pace
        return of_angle * angle - of_size * rate, of_drive, -of_size.sum(dim=(0, 1)), of_angle.sum(dim=(0, 1))


def driven_by_frames(log_pace: Tensor, drive: Tensor, rate: Tensor, angle: Tensor) -> Tensor:
    """The same by PyTorch, to read and to test against."""
    factor = torch.exp(torch.complex(-rate, angle) * torch.exp(log_pace))
    gain, (real, imaginary) = 1.0 - factor.abs(), drive.chunk(2, dim=-1)
    force = torch.complex(real * gain, imaginary * gain)
    states = [force[:, 0]]
    for frame in range(1, force.shape[1]):
        states.append(factor[:, frame] * states[-1] + force[:, frame])
    state = torch.stack(states, dim=1)
    return torch.cat([state.real, state.imag], dim=-1)
