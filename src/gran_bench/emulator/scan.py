"""The recurrence h_t = λ_t h_{t−1} + x_t of complex modes, frame after frame, compiled, with its gradient."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor


@numba.njit(error_model="numpy", cache=True, nogil=True)
def _forward(factor: np.ndarray, force: np.ndarray, state: np.ndarray) -> None:
    for run in range(force.shape[0]):
        state[run, 0] = force[run, 0]
        for frame in range(1, force.shape[1]):
            for mode in range(force.shape[2]):
                before = state[run, frame - 1, mode]
                state[run, frame, mode] = factor[run, frame, mode] * before + force[run, frame, mode]


@numba.njit(error_model="numpy", cache=True, nogil=True)
def _backward(
    factor: np.ndarray, state: np.ndarray, slope: np.ndarray, of_force: np.ndarray, of_factor: np.ndarray
) -> None:
    last = slope.shape[1] - 1
    for run in range(slope.shape[0]):
        for frame in range(last, -1, -1):
            for mode in range(slope.shape[2]):
                found = slope[run, frame, mode]
                if frame < last:
                    found += np.conj(factor[run, frame + 1, mode]) * of_force[run, frame + 1, mode]
                of_force[run, frame, mode] = found
                if frame > 0:
                    of_factor[run, frame, mode] = found * np.conj(state[run, frame - 1, mode])


class Scan(torch.autograd.Function):
    """h_t = λ_t h_{t−1} + x_t of λ and x ``(B, F, K)``, complex, from h_0 = x_0; `scan_by_frames` is the reference."""

    @staticmethod
    def forward(ctx: Any, factor: Tensor, force: Tensor) -> Tensor:
        factor, force = (value.detach().resolve_conj().contiguous() for value in (factor, force))
        state = torch.empty_like(force)
        _forward(factor.numpy(), force.numpy(), state.numpy())
        ctx.save_for_backward(factor, state)
        return state

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, Tensor]:
        factor, state = ctx.saved_tensors
        of_force, of_factor = torch.empty_like(state), torch.zeros_like(state)
        slope = slope.resolve_conj().contiguous()
        _backward(factor.numpy(), state.numpy(), slope.numpy(), of_force.numpy(), of_factor.numpy())
        return of_factor, of_force


def scan_by_frames(factor: Tensor, force: Tensor) -> Tensor:
    """The same by PyTorch, to read and to test against."""
    states = [force[:, 0]]
    for frame in range(1, force.shape[1]):
        states.append(factor[:, frame] * states[-1] + force[:, frame])
    return torch.stack(states, dim=1)
