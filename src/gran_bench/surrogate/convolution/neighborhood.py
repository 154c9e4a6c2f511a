"""Who sees whom in a frame, and with which weight: the geometry that all layers of a network share."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numba import njit
from torch import Tensor

from gran_bench.neighbors import cell_neighbors, list_pairs
from gran_bench.surrogate.convolution.kernels.lattice import LatticeBasis
from gran_bench.surrogate.convolution.kernels.radial import RadialBasis

# Rows are taken with index_select throughout: on a CPU, indexing with brackets takes twenty times as long.


KernelBasis = LatticeBasis | RadialBasis  # all that a layer may have


@dataclass(frozen=True)
class Neighborhood:
    """Who sees whom in a frame, and with which weight: shared by every layer of a basis.

    The transposed layer of a symmetric list is the same layer with a mirrored kernel: it needs no list of its own.
    """

    basis: KernelBasis  # of the kernel
    row_start: Tensor  # (Q + 1,) int64; the pairs of query q are row_start[q] … row_start[q + 1]
    source: Tensor  # (M,) int64, the source of each pair
    first: Tensor  # (M,) int64, first basis function of each pair
    coefficient: Tensor  # (M, 8) window × basis function; differentiable in positions that were not detached
    window: Tensor  # (M,) (1 − r²/R²)³
    source_count: int  # S
    symmetric: bool = False  # queries are the sources, and with (q, i) the list holds (i, q) with the opposite vector

    @property
    def query_count(self) -> int:
        """Q."""
        return len(self.row_start) - 1

    @cached_property
    def query(self) -> Tensor:
        """``(M,)`` int64, the query of each pair."""
        rows = torch.arange(self.query_count, device=self.row_start.device)
        return torch.repeat_interleave(rows, self.row_start.diff())

    def nearness(self, touching: float) -> Tensor:
        """How near each query's nearest source is, ``(Q,)``: see :func:`nearness`; 0 where it has none."""
        largest = self.window.new_zeros(self.query_count).scatter_reduce(0, self.query, self.window, "amax")
        return _share_of_full(largest, touching, self.basis.radius)

    @cached_property
    def transposed(self) -> Neighborhood:
        """The same pairs listed by source, with queries in the sources' place (same vectors, kernel not mirrored)."""
        order = torch.argsort(self.source, stable=True)
        turned = replace(self._chosen(order, self.source, self.query, self.source_count), symmetric=False)
        return replace(turned, source_count=self.query_count)

    def restricted(self, kept: Tensor) -> Neighborhood:
        """The pairs among the particles ``kept``, ``(P,)`` int64, renumbered; for queries that are the sources."""
        place = torch.full((self.source_count,), -1, dtype=torch.int64, device=self.source.device)
        place[kept] = torch.arange(len(kept), device=kept.device)
        query, source = place.index_select(0, self.query), place.index_select(0, self.source)
        inside = torch.nonzero((query >= 0) & (source >= 0))[:, 0]
        return self._chosen(inside, query, source, len(kept))

    def _chosen(self, pairs: Tensor, query: Tensor, source: Tensor, count: int) -> Neighborhood:
        """Some of the pairs in their order, under other numbers of their ``count`` queries and as many sources."""
        return replace(
            self,
            row_start=_starts(torch.bincount(query.index_select(0, pairs), minlength=count)),
            source=source.index_select(0, pairs),
            first=self.first.index_select(0, pairs),
            coefficient=self.coefficient.index_select(0, pairs),
            window=self.window.index_select(0, pairs),
            source_count=count,
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
    """The neighbourhood of M pairs: sorted queries, sources, and ``(M, 3)`` source − query, m, at most R long."""
    starts = _starts(torch.bincount(query, minlength=query_count))
    return Neighborhood(basis, starts, source, *_weigh(basis, relative), source_count, symmetric)


def particle_neighborhood(basis: KernelBasis, position: Tensor, period: float = 0.0) -> Neighborhood:
    """Particles within R of each other, themselves excluded, weighed once for all layers of a frame.

    Each pair is listed from both sides; the basis is evaluated on one side and mirrored to the other.

    Args:
        position: ``(N, 3)`` m; detach it to hold the geometry constant.
        period: of the y axis, m; 0 for none. Where it is shorter than 2 R, a particle may be seen through both sides.
    """
    count = len(position)
    if period > 0.0:
        points, particle = [position], [torch.arange(count, device=position.device)]
        for image in range(1, math.ceil(basis.radius / period) + 1):  # those that are seen beyond the period's ends
            for shift in (-image * period, image * period):
                moved = position + position.new_tensor((0.0, shift, 0.0))
                near = torch.nonzero(moved.detach()[:, 1].abs() <= 0.5 * period + basis.radius)[:, 0]
                points.append(moved[near])
                particle.append(near)
        points, particle = torch.cat(points), torch.cat(particle)
        queries, sources = (p.detach().double().cpu().numpy() for p in (position, points))
        query, image = (torch.from_numpy(i).to(position.device) for i in cell_neighbors(queries, sources, basis.radius))
        others = image != query
        query, image = query[others], image[others]
        relative = points.index_select(0, image) - position.index_select(0, query)
        return weigh_pairs(basis, query, particle[image], relative, count, count, symmetric=True)
    sphere = np.zeros((count, 4))
    sphere[:, :3] = position.detach().cpu().numpy()
    pair = [side.astype(np.int64) for side in list_pairs(sphere, basis.radius, 0.0)]
    lists = (torch.from_numpy(a).to(position.device) for a in (*pair, *_both_sides(*pair, count)))
    one, other, row_start, source, entry = lists
    first, coefficient, window = _weigh(basis, position.index_select(0, other) - position.index_select(0, one))
    mirrored_first, mirrored = basis.turned(first, coefficient)
    first, coefficient, window = (
        torch.cat(sides).index_select(0, entry)
        for sides in ((first, mirrored_first), (coefficient, mirrored), (window, window))
    )
    return Neighborhood(basis, row_start, source, first, coefficient, window, count, symmetric=True)


@njit(cache=True, nogil=True)
def _both_sides(one, other, count):
    """A full list by rows from M pairs of particles.

    Returns ``(N + 1,)`` row starts, ``(2M,)`` sources and ``(2M,)`` entries: m where the row's particle is the pair's
    first, M + m where it is its second.
    """
    row_start, length = np.zeros(count + 1, np.int64), len(one)
    for m in range(length):
        row_start[one[m] + 1] += 1
        row_start[other[m] + 1] += 1
    for i in range(count):
        row_start[i + 1] += row_start[i]
    fill = row_start[:-1].copy()
    source, entry = np.empty(2 * length, np.int64), np.empty(2 * length, np.int64)
    for m in range(length):
        i, j = one[m], other[m]
        source[fill[i]], entry[fill[i]] = j, m
        source[fill[j]], entry[fill[j]] = i, length + m
        fill[i] += 1
        fill[j] += 1
    return row_start, source, entry


def nearness(distance: Tensor, touching: float, radius: float) -> Tensor:
    """What a body at a distance counts: 1 as far as half-way from ``touching`` to R, from there falling to 0 at R."""
    return _share_of_full(_window(distance.clamp_min(0.0) ** 2, radius), touching, radius)


def _share_of_full(window: Tensor, touching: float, radius: float) -> Tensor:
    half_way = 0.5 * (touching + radius)
    return (window / (1.0 - (half_way / radius) ** 2) ** 3).clamp(max=1.0)


def _window(squared: Tensor, radius: float) -> Tensor:
    """(1 − r²/R²)³, 0 beyond R."""
    return (1.0 - squared / radius**2).clamp_min(0.0) ** 3


def _weigh(basis: KernelBasis, relative: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """First basis function ``(M,)``, window × value ``(M, 8)`` and window ``(M,)`` of each vector."""
    x, y, z = relative.unbind(-1)
    window = _window(x * x + y * y + z * z, basis.radius)
    first, value = basis.evaluate(relative)
    return first, window[:, None] * value, window


def _starts(counts: Tensor) -> Tensor:
    """``(Q + 1,)`` where each row starts, from the ``(Q,)`` lengths of the rows."""
    return torch.cat((counts.new_zeros(1), counts.cumsum(0)))
