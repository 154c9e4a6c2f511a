"""The continuous convolution: one layer, any kernel basis, the geometry of a frame computed once.

(f∗g)(x) = Σ_{i ∈ N(x, R)} a(x_i, x) f_i g(x_i − x),  a = (1 − r²/R²)³,  g = Σ_b φ_b W_b

φ_b are the functions of a basis (:class:`~gran_bench.surrogate.kernels.lattice.LatticeBasis` or
:class:`~gran_bench.surrogate.kernels.radial.RadialBasis`), W_b the trained matrices. Of the basis, a pair of points
uses eight functions. They, and the window a, depend on the points alone: :class:`Neighborhood` holds them for all
layers of a frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor, nn

from gran_bench.surrogate.kernels.fused import convolve_fused

BACKENDS = ("fused", "torch")


class KernelBasis(Protocol):
    """What a layer needs of a basis; see LatticeBasis."""

    radius: float
    size: int
    offsets: tuple[int, ...]
    mirror: Tensor
    mirror_sign: Tensor

    def evaluate(self, relative: Tensor) -> tuple[Tensor, Tensor]:
        """First function ``(M,)`` and values ``(M, 8)`` for vectors ``(M, 3)``, m."""
        ...


@dataclass(frozen=True)
class Neighborhood:
    """Who sees whom in a frame, and with which weight: shared by every layer of a basis.

    Attributes:
        basis: of the kernel.
        row_start: ``(Q + 1,)`` int64; the pairs of query q are row_start[q] … row_start[q + 1].
        source: ``(M,)`` int64, the source of each pair.
        first: ``(M,)`` int64, first basis function of each pair.
        coefficient: ``(M, 8)`` window × basis function; differentiable in the positions unless they were detached.
        source_count: S.
        symmetric: queries are the sources, and with (q, i) the list holds (i, q) with the opposite vector. The
            transposed layer is then the same layer with a mirrored kernel, and its backward pass needs no other list.
    """

    basis: KernelBasis
    row_start: Tensor
    source: Tensor
    first: Tensor
    coefficient: Tensor
    source_count: int
    symmetric: bool = False

    @property
    def query_count(self) -> int:
        """Q."""
        return len(self.row_start) - 1

    @cached_property
    def query(self) -> Tensor:
        """``(M,)`` int64, the query of each pair."""
        rows = torch.arange(self.query_count, device=self.row_start.device)
        return torch.repeat_interleave(rows, self.row_start.diff())

    @cached_property
    def transposed(self) -> Neighborhood:
        """The same pairs listed by source, with queries in the sources' place (same vectors, kernel not mirrored)."""
        order = torch.argsort(self.source, stable=True)
        counts = torch.bincount(self.source, minlength=self.source_count)
        return replace(
            self,
            row_start=_starts(counts),
            source=self.query[order],
            first=self.first[order],
            coefficient=self.coefficient[order],
            source_count=self.query_count,
            symmetric=False,
        )

    def restricted(self, kept: Tensor) -> Neighborhood:
        """The pairs among some of the particles, renumbered; for queries that are the sources.

        Args:
            kept: ``(P,)`` int64, increasing.
        """
        place = torch.full((self.source_count,), -1, dtype=torch.int64, device=self.source.device)
        place[kept] = torch.arange(len(kept), device=kept.device)
        query, source = place[self.query], place[self.source]
        inside = torch.nonzero((query >= 0) & (source >= 0))[:, 0]
        return replace(
            self,
            row_start=_starts(torch.bincount(query[inside], minlength=len(kept))),
            source=source[inside],
            first=self.first[inside],
            coefficient=self.coefficient[inside],
            source_count=len(kept),
        )


def weigh_pairs(
    basis: KernelBasis,
    query: Tensor,
    source: Tensor,
    relative: Tensor,
    query_count: int,
    source_count: int,
    symmetric: bool = False,
) -> Neighborhood:
    """Window and basis functions of a list of pairs.

    Args:
        query: ``(M,)`` int64, sorted.
        source: ``(M,)`` int64.
        relative: ``(M, 3)`` source − query, m (minimum image where periodic); at most R long.
        symmetric: see :class:`Neighborhood`; the caller's promise.
    """
    window = (1.0 - (relative * relative).sum(-1) / basis.radius**2).clamp_min(0.0) ** 3
    first, value = basis.evaluate(relative)
    return Neighborhood(
        basis=basis,
        row_start=_starts(torch.bincount(query, minlength=query_count)),
        source=source,
        first=first,
        coefficient=window[:, None] * value,
        source_count=source_count,
        symmetric=symmetric,
    )


def _starts(counts: Tensor) -> Tensor:
    """``(Q + 1,)`` where each row starts, from the ``(Q,)`` lengths of the rows."""
    return torch.cat((counts.new_zeros(1), counts.cumsum(0)))


def convolve(features: Tensor, weight: Tensor, neighborhood: Neighborhood) -> Tensor:
    """Σ_pairs Σ_b coefficient_b f_source W_b, in plain torch: the reference that every fast path must equal.

    Gathers A[q, b, :] = Σ_{i ∈ N(q)} φ_b a f_i, then multiplies by the kernel. Differentiable in everything, the
    positions behind ``coefficient`` included.

    Args:
        features: ``(S, C_in)``.
        weight: ``(B, C_in, C_out)``.

    Returns:
        ``(Q, C_out)``.
    """
    size, channels_in, channels_out = weight.shape
    pairs = neighborhood
    slot = pairs.query * size + pairs.first
    gathered = features.new_zeros(pairs.query_count * size, channels_in)
    source_features = features[pairs.source]
    for corner, offset in enumerate(pairs.basis.offsets):
        weighted = source_features * pairs.coefficient[:, corner, None]
        gathered = gathered.index_add(0, slot + offset, weighted)
    return gathered.view(pairs.query_count, size * channels_in) @ weight.view(size * channels_in, channels_out)


def initial_bound(basis: KernelBasis, channels_in: int, neighbors: float) -> float:
    """Half-width of uniform first weights that turns unit features into outputs of about unit size.

    With n neighbours spread evenly over the ball and features that move as one, Σ_i a φ_b has the mean n⟨a φ_b⟩ and
    the variance n⟨(a φ_b)²⟩; weights of variance 1 / (C_in Σ_b (mean² + variance)) make the output's variance 1.

    Args:
        channels_in: C_in.
        neighbors: n.
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

    Args:
        channels_in: C_in.
        channels_out: C_out.
        basis: of the kernel.
        backend: ``fused`` (Numba, on CPU; the geometry counts as constant in the backward pass, because gradients
            through it matter little) or ``torch`` (the reference).
        neighbors: expected of a query, for the scale of the first weights only.

    Attributes:
        weight: ``(B, C_in, C_out)``; for a lattice, ``view(k, k, k, C_in, C_out)`` is ordered z, y, x.

    Raises:
        ValueError: another backend.
    """

    def __init__(
        self,
        channels_in: int,
        channels_out: int,
        basis: KernelBasis,
        backend: str = "fused",
        neighbors: float = 50.0,
    ) -> None:
        super().__init__()
        if backend not in BACKENDS:
            raise ValueError(f"model.backend={backend!r} is unknown; choose {' or '.join(BACKENDS)}")
        self.backend = backend
        bound = initial_bound(basis, channels_in, neighbors)
        self.weight = nn.Parameter(torch.empty(basis.size, channels_in, channels_out).uniform_(-bound, bound))

    def forward(self, features: Tensor, neighborhood: Neighborhood) -> Tensor:
        """``(S, C_in)`` features of the sources → ``(Q, C_out)`` at the queries."""
        fused = self.backend == "fused" and features.device.type == "cpu"
        return (convolve_fused if fused else convolve)(features, self.weight, neighborhood)
