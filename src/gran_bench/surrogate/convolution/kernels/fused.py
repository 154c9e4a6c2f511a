"""The fast CPU path of the continuous convolution: gather in Numba, multiply by a matrix, block by block.

A block of queries gathers A[q, b, :] = Σ_i φ_b a f_i into a buffer that stays in cache and is multiplied by the kernel
there. The backward pass stores nothing: with G[i, b, :] = Σ_q φ_b a ∂L/∂out_q, gathered over the transposed list,

∂L/∂f_i = Σ_b G[i, b, :] W_bᵀ,  ∂L/∂W_b = Σ_i f_i ⊗ G[i, b, :].

For a symmetric list the transposed list is the list itself with every vector turned round, so that φ_b becomes
±φ of the mirrored function: G is gathered over the same list, and the kernel is mirrored instead.

The geometry counts as constant. Sums run in an order that depends on the number of threads alone, so that results
repeat bit for bit.
"""

import itertools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
import torch
from numba import njit, uint64
from torch import Tensor
from torch.autograd.function import once_differentiable

from gran_bench.surrogate.convolution.neighborhood import Neighborhood

# A block's buffer: about what the second-level cache of a core holds. Rows beyond the bound gain nothing.
_BUFFER_BYTES = 1 << 21
_MOST_ROWS = 256


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def _gather(begin, end, row_start, source, first, coefficient, offsets, features, gathered):
    """A[q − begin, b, :] = Σ_pairs coefficient · features of the source, for the queries of one block.

    Corners c and c + 4 lie on two layers of the lattice (or two hats) and are written in one loop: at 64 channels and
    4³ nodes they are 4096 bytes apart, and a processor that compares the low address bits would make the second wait
    for the first. Unsigned indices spare the compiler the wrap-around of negative ones.
    """
    channels = features.shape[1]
    for q in range(begin, end):
        row = gathered[uint64(q - begin)]
        row[:] = 0.0
        for p in range(row_start[uint64(q)], row_start[uint64(q + 1)]):
            feature = features[uint64(source[uint64(p)])]
            base = uint64(first[uint64(p)])
            for corner in range(4):
                near, far = coefficient[uint64(p), uint64(corner)], coefficient[uint64(p), uint64(corner + 4)]
                near_row = row[base + uint64(offsets[uint64(corner)])]
                far_row = row[base + uint64(offsets[uint64(corner + 4)])]
                for k in range(channels):
                    near_row[k] += near * feature[k]
                    far_row[k] += far * feature[k]


def _onednn_product(left: Tensor, right: Tensor) -> Tensor:
    """``left @ right`` by oneDNN, whose generated code is twice as fast where the BLAS avoids the widest vectors."""
    if left.dtype != torch.float32:
        return torch.mm(left, right)
    return torch.ops.mkldnn._linear_pointwise(left, right.t(), None, "none", [], "")


def _choose_product() -> Callable[[Tensor, Tensor], Tensor]:
    """oneDNN's product where this build of torch has it and it agrees with the BLAS; else the BLAS."""
    left, right = torch.linspace(-1.0, 1.0, 35).view(5, 7), torch.linspace(-2.0, 1.0, 21).view(7, 3)
    try:
        agrees = torch.allclose(_onednn_product(left, right), left @ right, rtol=1e-5, atol=1e-6)
    except (AttributeError, RuntimeError):  # the operator is no part of torch's public interface
        agrees = False
    return _onednn_product if agrees else torch.mm


_product = _choose_product()


@cache
def _helpers(count: int) -> ThreadPoolExecutor:
    """Threads beside the calling one; they only ever run the gather, which needs no lock of Python's."""
    return ThreadPoolExecutor(count, thread_name_prefix="gather")


def _gathered_blocks(pairs: Neighborhood, features: Tensor) -> Iterator[tuple[int, int, Tensor]]:
    """First row, last row and gathered features ``(rows, B · C)`` of each block, in one reused buffer."""
    size, channels = pairs.basis.size, features.shape[1]
    threads = torch.get_num_threads()
    room = max(8, min(_MOST_ROWS, _BUFFER_BYTES // (features.element_size() * size * channels)))
    rows = min(room * threads, max(1, pairs.query_count))
    buffer = torch.empty(rows, size, channels, dtype=features.dtype)
    values, target = features.numpy(), buffer.numpy()
    lists = (pairs.row_start.numpy(), pairs.source.numpy(), pairs.first.numpy())
    coefficient = pairs.coefficient.detach().numpy()
    offsets = np.asarray(pairs.basis.offsets, np.uint32)

    def gather(begin: int, end: int, into: np.ndarray) -> None:
        _gather(begin, end, *lists, coefficient, offsets, values, into)

    for begin in range(0, pairs.query_count, rows):
        end = min(begin + rows, pairs.query_count)
        cuts = [begin + (end - begin) * t // threads for t in range(threads + 1)]
        waiting = [
            _helpers(threads - 1).submit(gather, a, b, target[a - begin : b - begin])
            for a, b in itertools.pairwise(cuts[1:])
        ]
        gather(cuts[0], cuts[1], target[: cuts[1] - begin])
        for share in waiting:
            share.result()
        yield begin, end, buffer[: end - begin].view(end - begin, size * channels)


class _FusedConvolution(torch.autograd.Function):
    """Σ_pairs Σ_b coefficient_b f_source W_b with the gradients of features and kernel."""

    @staticmethod
    def forward(ctx, features: Tensor, weight: Tensor, pairs: Neighborhood) -> Tensor:
        ctx.save_for_backward(features, weight)
        ctx.pairs = pairs
        size, channels_in, channels_out = weight.shape
        kernel = weight.detach().reshape(size * channels_in, channels_out)
        output = features.new_empty(pairs.query_count, channels_out)
        for begin, end, gathered in _gathered_blocks(pairs, features.detach().contiguous()):
            output[begin:end] = _product(gathered, kernel)
        return output

    @staticmethod
    @once_differentiable
    def backward(ctx, output_gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        features, weight = ctx.saved_tensors
        pairs, output_gradient = ctx.pairs, output_gradient.contiguous()
        size, channels_in, channels_out = weight.shape
        if not ctx.needs_input_grad[0]:  # ∂L/∂W is all that is left where the features are constant
            total = features.new_zeros(channels_out, size * channels_in)
            for begin, end, gathered in _gathered_blocks(pairs, features.contiguous()):
                total += _product(output_gradient[begin:end].t(), gathered)
            return None, total.view(channels_out, size, channels_in).permute(1, 2, 0), None
        mirror, sign = pairs.basis.mirror, pairs.basis.mirror_sign.to(weight.dtype)[:, None, None]
        kernel = weight[mirror] * sign if pairs.symmetric else weight
        kernel = kernel.transpose(1, 2).reshape(size * channels_out, channels_in)
        feature_gradient = torch.empty_like(features)
        total = features.new_zeros(channels_in, size * channels_out)
        for begin, end, gathered in _gathered_blocks(pairs if pairs.symmetric else pairs.transposed, output_gradient):
            feature_gradient[begin:end] = _product(gathered, kernel)
            total += _product(features[begin:end].t(), gathered)
        kernel_gradient = total.view(channels_in, size, channels_out).transpose(0, 1)
        return feature_gradient, kernel_gradient[mirror] * sign if pairs.symmetric else kernel_gradient, None


def convolve_fused(features: Tensor, weight: Tensor, pairs: Neighborhood) -> Tensor:
    """:func:`~gran_bench.surrogate.convolution.cconv.convolve` on a CPU in float32 or 64, the geometry constant."""
    return _FusedConvolution.apply(features, weight, pairs)
