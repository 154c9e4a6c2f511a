"""All iterations of the contact network in one jitted call, forward and adjoint (CPU, float32, one thread).

The same function as :func:`gran_bench.surrogate.contact.solver.solve_contacts`, as one node of the autograd graph.
:mod:`gran_bench.surrogate.contact.kernels.frame` does the work; this file packs a frame for it.
"""

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from gran_bench.surrogate.contact.constants import CHANNELS, HIDDEN
from gran_bench.surrogate.contact.geometry import ContactList
from gran_bench.surrogate.contact.kernels.block import INPUTS
from gran_bench.surrogate.contact.kernels.frame import frame_adjoint, frame_forward
from gran_bench.surrogate.contact.kernels.lanes import LANES, WIDTH
from gran_bench.surrogate.contact.kernels.particles import CHANNEL
from gran_bench.surrogate.step import Surrogate


def fused_solve(
    model: Surrogate,
    contacts: ContactList,
    position: Tensor,
    displacement: Tensor,
    spin: Tensor,
    fall: Tensor,
    springs: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The fused form of :func:`gran_bench.surrogate.contact.solver.solve_contacts`; same arguments, same results."""
    walls, count = contacts.walls, len(contacts.pairs) + len(contacts.wall)
    taken_back = 0.5 * fall if model.is_instantaneous else fall
    # A wall's partner is the row after the last particle's.
    near = np.stack((contacts.wall_particle, np.full(len(contacts.wall), contacts.count)), 1)
    ends = len(contacts.pairs) + contacts.wall.searchsorted(np.arange(len(walls.after) + 1))
    frame = (
        np.concatenate((contacts.pairs, near)),
        np.concatenate(([0], ends)),
        np.hstack((walls.after, walls.turn.reshape(-1, 9), walls.shift)).astype(np.float32),
        np.zeros((count, 3), np.float32) if springs is None else springs.numpy(),
        np.array([*model.fades[0], *model.fades[1], model.diameter], np.float32),
        np.float32(contacts.period),
        np.stack([taken_back.numpy(), (fall - taken_back).numpy()]),
    )
    return _FusedContacts.apply(frame, position, displacement, spin, *_full_weights(model))


def _full_weights(model: Surrogate) -> tuple[Tensor, ...]:
    """The model's weights in the kernel's one form, with zeros where the model has no memory or velocity output."""
    hidden_weight, output_weight, output_bias = model.hidden_weight, model.output_weight, model.output_bias
    if not model.has_memory:
        hidden_weight = pad(hidden_weight, (0, 2))
        # e comes before a_v and b_v
        cut = 3 + CHANNELS
        head, tail = output_weight[:, :, :cut], output_weight[:, :, cut:]
        output_weight = torch.cat((pad(head, (0, 0, 0, 1)), tail), 2)
        output_bias = torch.cat((pad(output_bias[:, :, :cut], (0, 1)), output_bias[:, :, cut:]), 2)
    if not model.is_instantaneous:
        output_weight, output_bias = pad(output_weight, (0, 0, 0, 2)), pad(output_bias, (0, 2))
    others = model.stiffness, model.spin_share, model.mix_weight, model.mix_bias
    return hidden_weight, model.hidden_bias, output_weight, output_bias, *others


class _FusedContacts(torch.autograd.Function):
    """(x, D, q, weights) → (D, q, extra translation, extra spin), in d/50 and d/50 a frame."""

    @staticmethod
    def forward(ctx, frame, position, displacement, spin, *weights):
        ctx.shapes = [w.shape for w in weights]
        weights = tuple(w.detach().contiguous().numpy() for w in weights)
        weights = tuple(w.reshape(*w.shape[:2], -1) if w.ndim == 4 else w for w in weights)
        inputs = tuple(t.detach().contiguous().numpy() for t in (position, displacement, spin))
        count, kept = len(position), len(weights[0]) if any(ctx.needs_input_grad) else 1
        rows = LANES * (count // LANES + 1)
        states = np.empty((kept, rows, WIDTH), np.float32)
        messages = np.empty((kept, CHANNELS, rows), np.float32)
        sums = np.empty((kept, 2, len(frame[0]) + LANES), np.float32)
        nearest = np.empty(rows, np.float32), np.empty(rows, np.int64)
        outcome = np.empty((4, count, 3), np.float32)
        frame_forward(*frame, *inputs, *weights, states, messages, sums, *nearest, outcome)
        ctx.frame, ctx.weights, ctx.kept = (*frame, inputs[0]), weights, (states, messages, sums, *nearest)
        return tuple(torch.from_numpy(outcome).unbind(0))

    @staticmethod
    def backward(ctx, *gradients):
        move, turned, extra, extra_spin = (g.numpy() for g in gradients)
        count = len(move)
        results = [np.zeros(w.shape, np.float32) for w in ctx.weights]
        adjoint, before = np.zeros((2, *ctx.kept[0].shape[1:]), np.float32)
        adjoint[:count, :CHANNEL] = before[:count, :CHANNEL] = np.hstack((move, turned))
        before[:count, CHANNEL + CHANNELS :] = np.hstack((extra, extra_spin))
        frame_adjoint(*ctx.frame, *ctx.weights, *ctx.kept, before, adjoint, *results)
        # The kernel has the units of an input side by side.
        results[0] = results[0].reshape(*results[0].shape[:2], INPUTS, HIDDEN).swapaxes(2, 3)
        results = [torch.from_numpy(r.reshape(shape)) for r, shape in zip(results, ctx.shapes, strict=True)]
        moved = torch.from_numpy(adjoint[:count])
        position = CHANNEL + CHANNELS
        return None, moved[:, position : position + 3], moved[:, 0:3], moved[:, 3:6], *results
