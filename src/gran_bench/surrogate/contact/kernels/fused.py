"""All iterations of the contact network in one jitted call, forward and adjoint (CPU, float32, one thread).

The same function as :func:`gran_bench.surrogate.contact.solver.solve_contacts`, as one node of the autograd graph.
:mod:`gran_bench.surrogate.contact.kernels.frame` does the work; this file packs a frame for it.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from gran_bench.surrogate.contact.constants import CHANNELS, HIDDEN
from gran_bench.surrogate.contact.geometry import ContactList
from gran_bench.surrogate.contact.kernels.block import INPUTS
from gran_bench.surrogate.contact.kernels.frame import frame_adjoint, frame_forward
from gran_bench.surrogate.contact.kernels.kinematics import ROW
from gran_bench.surrogate.contact.weights import ContactWeights
from gran_bench.surrogate.walls import FrameWalls


def fused_solve(
    weights: ContactWeights,
    period: float,
    walls: FrameWalls,
    contacts: ContactList,
    position: Tensor,
    displacement: Tensor,
    spin: Tensor,
    fall: Tensor,
    nearness: Tensor,
    springs: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The fused form of :func:`gran_bench.surrogate.contact.solver.solve_contacts`; same arguments, same results."""
    count = len(contacts.pairs) + len(contacts.wall)
    taken_back = 0.5 * fall if weights.instantaneous else fall
    frame = (
        contacts.pairs,
        contacts.wall_particle,
        contacts.wall.searchsorted(np.arange(len(walls.after) + 1)),
        np.hstack((walls.after, walls.turn.reshape(-1, 9), walls.shift)).astype(np.float32),
        np.zeros((count, 3), np.float32) if springs is None else springs.numpy(),
        np.array([*weights.fades[0], *weights.fades[1], weights.diameter], np.float32),
        np.float32(period),
        np.stack([taken_back.numpy(), (fall - taken_back).numpy()]),
    )
    return _FusedContacts.apply(frame, position, displacement, spin, nearness, *_full_weights(weights))


def _full_weights(weights: ContactWeights) -> tuple[Tensor, ...]:
    """The model's weights in the kernel's one form, with zeros where the model has no memory or velocity output."""
    hidden_weight, output_weight, output_bias = weights.hidden_weight, weights.output_weight, weights.output_bias
    if not weights.memory:
        hidden_weight = pad(hidden_weight, (0, 2))
        # e comes before a_v and b_v
        cut = 3 + CHANNELS
        head, tail = output_weight[:, :, :cut], output_weight[:, :, cut:]
        output_weight = torch.cat((pad(head, (0, 0, 0, 1)), tail), 2)
        output_bias = torch.cat((pad(output_bias[:, :, :cut], (0, 1)), output_bias[:, :, cut:]), 2)
    if not weights.instantaneous:
        output_weight, output_bias = pad(output_weight, (0, 0, 0, 2)), pad(output_bias, (0, 2))
    return (
        hidden_weight,
        weights.hidden_bias,
        output_weight,
        output_bias,
        weights.stiffness,
        weights.spin_share,
        weights.mix_weight,
        weights.mix_bias,
    )


class _FusedContacts(torch.autograd.Function):
    """(x, D, q, nearness, weights) → (D, q, extra translation, extra spin), all in mm and mm per frame."""

    @staticmethod
    def forward(ctx, frame, position, displacement, spin, nearness, *weights):
        weights = tuple(w.detach().contiguous().numpy() for w in weights)
        weights = tuple(w.reshape(*w.shape[:2], -1) if w.ndim == 4 else w for w in weights)
        inputs = tuple(t.detach().contiguous().numpy() for t in (position, displacement, spin, nearness))
        needed = any(ctx.needs_input_grad)
        iterations, count = len(weights[0]), len(frame[4])
        kept = iterations if needed else 1
        states = np.empty((kept, len(inputs[0]), ROW), np.float32)
        messages = np.empty((kept, len(inputs[0]), CHANNELS), np.float32)
        sums = np.empty((kept, 2, count), np.float32)
        outcome = np.empty((4, len(inputs[0]), 3), np.float32)
        frame_forward(*frame, *inputs, *weights, states, messages, sums, outcome)
        ctx.frame, ctx.nearness, ctx.weights, ctx.kept = frame, inputs[3], weights, (states, messages, sums)
        return tuple(torch.from_numpy(outcome).unbind(0))

    @staticmethod
    def backward(ctx, *gradients):
        move, turned, extra, extra_spin = (g.numpy() for g in gradients)
        results = tuple(np.zeros(w.shape, np.float32) for w in ctx.weights)
        channels = np.zeros((len(move), CHANNELS), np.float32)
        adjoint = np.concatenate((move, turned, channels, extra, extra_spin), axis=1)
        position, nearness = np.zeros_like(move), np.zeros(len(move), np.float32)
        frame_adjoint(*ctx.frame, ctx.nearness, *ctx.weights, *ctx.kept, adjoint, position, nearness, *results)
        shapes = {0: (INPUTS,), 2: (HIDDEN,)}
        results = [
            torch.from_numpy(r.reshape(*r.shape[:2], -1, *shapes[k]) if k in shapes else r)
            for k, r in enumerate(results)
        ]
        moved = torch.from_numpy(adjoint)
        inputs = torch.from_numpy(position), moved[:, 0:3], moved[:, 3:6], torch.from_numpy(nearness)
        return None, *inputs, *results
