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
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gran_bench.surrogate.convolution.kernels.gather import gather, gather_rounded
from gran_bench.surrogate.convolution.neighborhood import Neighborhood

# A block's buffer: about what the second-level cache of a core holds. Rows beyond the bound gain nothing.
_BUFFER_BYTES = 1 << 21
_MOST_ROWS = 256


def _onednn_product(left: Tensor, right: Tensor) -> Tensor:
    """``left @ right`` by oneDNN, whose generated code is twice as fast where the BLAS avoids the widest vectors."""
    if left.dtype != torch.float32:
        return torch.mm(left, right)
    return torch.ops.mkldnn._linear_pointwise(left, right.t(), None, "none", [], "")


def _blas_is_wide() -> bool:
    """Whether torch's BLAS takes the widest vectors of this processor: MKL does on Intel's alone."""
    processor = Path("/proc/cpuinfo")
    return torch.backends.mkl.is_available() and processor.exists() and "GenuineIntel" in processor.read_text()


def _choose_product() -> Callable[[Tensor, Tensor], Tensor]:
    """oneDNN's product where the BLAS is slow, this build of torch has it and the two agree; else the BLAS."""
    if _blas_is_wide():
        return torch.mm
    left, right = torch.linspace(-1.0, 1.0, 35).view(5, 7), torch.linspace(-2.0, 1.0, 21).view(7, 3)
    try:
        agrees = torch.allclose(_onednn_product(left, right), left @ right, rtol=1e-5, atol=1e-6)
    except (AttributeError, RuntimeError):  # the operator is no part of torch's public interface
        agrees = False
    return _onednn_product if agrees else torch.mm


_product = _choose_product()


def _add_product(total: Tensor, left: Tensor, right: Tensor) -> None:
    """``total += left @ right``; the sum over blocks is never rounded to bfloat16."""
    if _product is torch.mm and left.dtype == total.dtype:
        total.addmm_(left, right)
    else:
        total += _product(left, right)


@cache
def _helpers(count: int) -> ThreadPoolExecutor:
    """Threads beside the calling one; they only ever run the gather, which needs no lock of Python's."""
    return ThreadPoolExecutor(count, thread_name_prefix="gather")


def _gathered_blocks(pairs: Neighborhood, features: Tensor, dtype: torch.dtype) -> Iterator[tuple[int, int, Tensor]]:
    """First row, last row and gathered features ``(rows, B · C)`` of each block, in one reused buffer."""
    size, channels = pairs.basis.size, features.shape[1]
    threads = torch.get_num_threads()
    room = max(8, min(_MOST_ROWS, _BUFFER_BYTES // (dtype.itemsize * size * channels)))
    rows = min(room * threads, max(1, pairs.query_count))
    buffer = torch.empty(rows, size * channels, dtype=dtype)
    values, rounded = features.numpy(), dtype == torch.bfloat16
    target = buffer.view(torch.uint16).numpy() if rounded else buffer.numpy()
    lists = (pairs.row_start.numpy(), pairs.source.numpy(), pairs.first.numpy())
    coefficient = pairs.coefficient.detach().numpy()
    offsets = np.asarray(pairs.basis.offsets, np.uint32)

    def gather_share(begin: int, end: int, into: np.ndarray) -> None:
        (gather_rounded if rounded else gather)(begin, end, *lists, coefficient, offsets, values, into)

    for begin in range(0, pairs.query_count, rows):
        end = min(begin + rows, pairs.query_count)
        cuts = [begin + (end - begin) * t // threads for t in range(threads + 1)]
        waiting = [
            _helpers(threads - 1).submit(gather_share, a, b, target[a - begin : b - begin])
            for a, b in itertools.pairwise(cuts[1:])
        ]
        gather_share(cuts[0], cuts[1], target[: cuts[1] - begin])
        for share in waiting:
            share.result()
        yield begin, end, buffer[: end - begin]


class _FusedConvolution(torch.autograd.Function):
    """Σ_pairs Σ_b coefficient_b f_source W_b with the gradients of features and kernel; factors in ``dtype``."""

    @staticmethod
    def forward(ctx, features: Tensor, weight: Tensor, pairs: Neighborhood, dtype: torch.dtype) -> Tensor:
        ctx.save_for_backward(features, weight)
        ctx.pairs, ctx.dtype = pairs, dtype
        size, channels_in, channels_out = weight.shape
        kernel = weight.detach().reshape(size * channels_in, channels_out).to(dtype)
        output = features.new_empty(pairs.query_count, channels_out)
        for begin, end, gathered in _gathered_blocks(pairs, features.detach().contiguous(), dtype):
            output[begin:end] = _product(gathered, kernel)
        return output

    @staticmethod
    @once_differentiable
    def backward(ctx, output_gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        features, weight = ctx.saved_tensors
        pairs, dtype, output_gradient = ctx.pairs, ctx.dtype, output_gradient.contiguous()
        size, channels_in, channels_out = weight.shape
        if not ctx.needs_input_grad[0]:  # ∂L/∂W is all that is left where the features are constant
            total = features.new_zeros(channels_out, size * channels_in)
            factor = output_gradient.to(dtype)
            for begin, end, gathered in _gathered_blocks(pairs, features.contiguous(), dtype):
                _add_product(total, factor[begin:end].t(), gathered)
            return None, total.view(channels_out, size, channels_in).permute(1, 2, 0), None, None
        turned = pairs if pairs.symmetric else pairs.transposed
        kernel = _mirrored(weight, pairs).transpose(1, 2).reshape(size * channels_out, channels_in).to(dtype)
        feature_gradient = torch.empty_like(features)
        total, factor = features.new_zeros(channels_in, size * channels_out), features.to(dtype)
        for begin, end, gathered in _gathered_blocks(turned, output_gradient, dtype):
            feature_gradient[begin:end] = _product(gathered, kernel)
            _add_product(total, factor[begin:end].t(), gathered)
        kernel_gradient = total.view(channels_in, size, channels_out).transpose(0, 1)
        return feature_gradient, _mirrored(kernel_gradient, pairs), None, None


def _mirrored(weight: Tensor, pairs: Neighborhood) -> Tensor:
    """The kernel ``(B, C, C')`` of the list turned round; as it is where the list is transposed itself."""
    if not pairs.symmetric:
        return weight
    return weight.index_select(0, pairs.basis.mirror) * pairs.basis.mirror_sign.to(weight.dtype)[:, None, None]


def convolve_fused(features: Tensor, weight: Tensor, pairs: Neighborhood, precision: str = "float32") -> Tensor:
    """:func:`~gran_bench.surrogate.convolution.cconv.convolve` on a CPU in float32 or 64, the geometry constant."""
    dtype = torch.bfloat16 if precision == "bfloat16" else features.dtype
    return _FusedConvolution.apply(features, weight, pairs, dtype)
