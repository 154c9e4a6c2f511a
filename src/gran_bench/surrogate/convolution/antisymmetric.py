"""A continuous convolution that conserves momentum: what i gives j is what j gives i, with the opposite sign.

out_i = Σ_{j ∈ N(i)} a(x_ij) (f_i + f_j) g(x_j − x_i),  g(−x) = −g(x),  so that Σ_i out_i = 0

Source: Prantl, Ummenhofer, Koltun & Thuerey (2022), Guaranteed conservation of momentum for learning particle-based
fluid dynamics, NeurIPS 35.
"""

import torch
from torch import Tensor, nn

from gran_bench.surrogate.convolution.cconv import ContinuousConvolution, convolve
from gran_bench.surrogate.convolution.kernels.fused import convolve_fused
from gran_bench.surrogate.convolution.neighborhood import KernelBasis, Neighborhood


def antisymmetric(weight: Tensor, basis: KernelBasis) -> Tensor:
    """The part of a kernel, ``(B, C_in, C_out)``, that changes its sign with the vector: ½ (g(x) − g(−x))."""
    sign = basis.mirror_sign.to(weight)[:, None, None]
    return 0.5 * (weight - sign * weight.index_select(0, basis.mirror.to(weight.device)))


class AntisymmetricLayer(nn.Module):
    """The output of a particle branch as forces between pairs; neither bias nor a term of a particle alone.

    With φ_b the functions of the basis and W_b the antisymmetric kernel, the share of f_i is Σ_b s_ib (f_i W_b), where
    s_ib = Σ_j a φ_b is a convolution of ones. So the layer is two plain convolutions, and as fast where they are fused.

    Args:
        backend, neighbors: as for `ContinuousConvolution`.
    """

    def __init__(self, width_in: int, width_out: int, basis: KernelBasis, backend: str, neighbors: float) -> None:
        super().__init__()
        self.convolution = ContinuousConvolution(width_in, width_out, basis, backend, neighbors)

    def forward(self, features: Tensor, pairs: Neighborhood) -> Tensor:
        """``(N, C_in)`` features before their ReLU → ``(N, C_out)``; 0 for a particle without neighbours."""
        active, basis = torch.relu(features), pairs.basis
        fused = self.convolution.backend == "fused" and features.device.type == "cpu"
        summed = convolve_fused if fused else convolve
        kernel = antisymmetric(self.convolution.weight, basis)
        each = torch.eye(basis.size, dtype=active.dtype, device=active.device)[:, None, :]
        seen = summed(torch.ones_like(active[:, :1]), each, pairs)  # (N, B)
        own = torch.einsum("ni,bio->nbo", active, kernel)
        return summed(active, kernel, pairs) + (seen[:, :, None] * own).sum(dim=1)
