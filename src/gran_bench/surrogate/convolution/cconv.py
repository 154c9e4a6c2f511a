"""The continuous convolution: one layer, any kernel basis, the geometry of a frame computed once.

(f∗g)(x) = Σ_{i ∈ N(x, R)} a(x_i, x) f_i g(x_i − x),  a = (1 − r²/R²)³,  g = Σ_b φ_b W_b

φ_b are the functions of a basis (`kernels.lattice.LatticeBasis` or
`kernels.radial.RadialBasis`), W_b the trained matrices. Of the basis, a pair of points
uses eight functions. They, and the window a, depend on the points alone:
`neighborhood.Neighborhood` holds them for all layers of a frame.

Source: Ummenhofer, Prantl, Thuerey & Koltun (2020), Lagrangian fluid simulation with continuous convolutions, ICLR.
"""

import math

import torch
from torch import Tensor, nn

from gran_bench.config import CconvModelConfig
from gran_bench.config.rules import checked
from gran_bench.surrogate.convolution.kernels.fused import convolve_fused
from gran_bench.surrogate.convolution.neighborhood import KernelBasis, Neighborhood


def convolve(features: Tensor, weight: Tensor, neighborhood: Neighborhood, precision: str = "float32") -> Tensor:
    """Σ_pairs Σ_b coefficient_b f_source W_b, in plain torch: the reference that every fast path must equal.

    Gathers A[q, b, :] = Σ_{i ∈ N(q)} φ_b a f_i, then multiplies by the kernel; with ``precision = bfloat16`` both are
    rounded to it before. Differentiable in everything, the positions behind ``coefficient`` included: ``(S, C_in)``
    features and ``(B, C_in, C_out)`` weights → ``(Q, C_out)``. Runs on any device.
    """
    size, channels_in, channels_out = weight.shape
    pairs = neighborhood
    slot = pairs.query * size + pairs.first
    gathered = features.new_zeros(pairs.query_count * size, channels_in)
    source_features = features.index_select(0, pairs.source)
    for corner, offset in enumerate(pairs.basis.offsets):
        weighted = source_features * pairs.coefficient[:, corner, None]
        gathered = gathered.index_add(0, slot + offset, weighted)
    factors = gathered.view(pairs.query_count, size * channels_in), weight.view(size * channels_in, channels_out)
    if precision == "bfloat16":
        factors = [factor.bfloat16() for factor in factors]
    return (factors[0] @ factors[1]).to(features.dtype)


def initial_bound(basis: KernelBasis, channels_in: int, neighbors: float) -> float:
    """Half-width of uniform first weights that turns unit features into outputs of about unit size.

    With n neighbours spread evenly over the ball and features that move as one, Σ_i a φ_b has the mean n⟨a φ_b⟩ and
    the variance n⟨(a φ_b)²⟩; weights of variance 1 / (C_in Σ_b (mean² + variance)) make the output's variance 1.
    """
    points = 2.0 * torch.quasirandom.SobolEngine(3).draw(8192, dtype=torch.float64) - 1.0
    points = points[(points * points).sum(-1) < 1.0]
    first, value = basis.evaluate(points * basis.radius)
    value = value * (1.0 - (points * points).sum(-1, keepdim=True)) ** 3
    mean, square = torch.zeros(2, basis.size, dtype=torch.float64)
    for corner, offset in enumerate(basis.offsets):
        mean.index_add_(0, first + offset, value[:, corner])
        square.index_add_(0, first + offset, value[:, corner] ** 2)
    scale = neighbors / len(points)
    return math.sqrt(3.0 / (channels_in * float(((mean * scale) ** 2 + square * scale).sum())))


class ContinuousConvolution(nn.Module):
    """A continuous convolution layer without bias; no neighbour is capped and nothing is normalised.

    Its ``weight`` is ``(B, C_in, C_out)``; for a lattice, ``view(k, k, k, C_in, C_out)`` is ordered z, y, x.

    Args:
        backend: ``fused`` (Numba, on CPU; the geometry counts as constant in the backward pass, because gradients
            through it matter little) or ``torch`` (the reference).
        neighbors: expected of a query, for the scale of the first weights only.
        precision: of the factors of its matrix products, ``float32`` or ``bfloat16``. Rounding them moves output and
            gradients by 0.3 % (RMS); it is faster where the processor multiplies bfloat16.

    Raises:
        ConfigError: another backend or precision.
    """

    def __init__(
        self,
        channels_in: int,
        channels_out: int,
        basis: KernelBasis,
        backend: str = "fused",
        neighbors: float = 50.0,
        precision: str = "float32",
    ) -> None:
        super().__init__()
        self.backend = checked(CconvModelConfig, "backend", backend)
        self.precision = checked(CconvModelConfig, "precision", precision)
        bound = initial_bound(basis, channels_in, neighbors)
        self.weight = nn.Parameter(torch.empty(basis.size, channels_in, channels_out).uniform_(-bound, bound))

    def forward(self, features: Tensor, neighborhood: Neighborhood) -> Tensor:
        """``(S, C_in)`` features of the sources → ``(Q, C_out)`` at the queries."""
        fused = self.backend == "fused" and features.device.type == "cpu"
        return (convolve_fused if fused else convolve)(features, self.weight, neighborhood, self.precision)
