"""The geometry of a frame: every pair within reach, from both sides, through a periodic seam too."""

import numpy as np
import pytest
import torch
from beds import every_neighbor

from gran_bench.neighbors import cell_neighbors
from gran_bench.surrogate.convolution.kernels.lattice import LatticeBasis
from gran_bench.surrogate.convolution.kernels.radial import RadialBasis
from gran_bench.surrogate.convolution.neighborhood import particle_neighborhood, weigh_pairs

RADIUS = 0.1125
BASES = {"lattice": LatticeBasis(RADIUS, 4), "radial": RadialBasis.around_contact(0.05, RADIUS)}


def cloud(count, width, seed=0):
    return torch.from_numpy((np.random.default_rng(seed).random((count, 3)) - 0.5) * width)


def dense(pairs):
    """The operator as a matrix ``(Q · B, S)``: the same for lists in any order."""
    matrix = torch.zeros(pairs.query_count * pairs.basis.size, pairs.source_count, dtype=pairs.coefficient.dtype)
    row = pairs.query * pairs.basis.size + pairs.first
    for corner, offset in enumerate(pairs.basis.offsets):
        matrix.index_put_((row + offset, pairs.source), pairs.coefficient[:, corner], accumulate=True)
    return matrix


@pytest.mark.parametrize("name", BASES)
def test_both_sides_of_a_pair_equal_the_direct_evaluation(name):
    position = cloud(200, 0.4)
    query, source = (torch.from_numpy(i) for i in every_neighbor(position.numpy(), position.numpy(), RADIUS))
    query, source = query[query != source], source[query != source]
    direct = weigh_pairs(BASES[name], query, source, position[source] - position[query], 200, 200)
    assert torch.allclose(dense(particle_neighborhood(BASES[name], position)), dense(direct), atol=1e-12)


@pytest.mark.parametrize("period", [0.2, 0.5])
def test_a_periodic_list_sees_every_image_within_reach(period):
    """Also where the period is shorter than two reaches, so that a particle is seen through both sides."""
    position = cloud(120, 1.0) * torch.tensor([0.3, period, 0.3], dtype=torch.float64)
    pairs = particle_neighborhood(BASES["lattice"], position, period)
    images = torch.cat([position + torch.tensor([0.0, k * period, 0.0], dtype=torch.float64) for k in (0, -1, 1)])
    query, image = (torch.from_numpy(i) for i in every_neighbor(position.numpy(), images.numpy(), RADIUS))
    query, image = query[query != image], image[query != image]
    relative = images[image] - position[query]
    direct = weigh_pairs(BASES["lattice"], query, image % 120, relative, 120, 120)
    assert len(pairs.source) == len(query)
    assert torch.allclose(dense(pairs), dense(direct), atol=1e-12)


@pytest.mark.parametrize("period", [0.0, 0.4])
def test_the_cell_list_finds_every_neighbour(period):
    query, source = cloud(300, 0.4, seed=1).numpy(), cloud(500, 0.4, seed=2).numpy()
    cells = cell_neighbors(query, source, RADIUS, period)
    order = np.lexsort(cells[::-1])
    assert np.all(np.diff(cells[0]) >= 0)
    for found, expected in zip(cells, every_neighbor(query, source, RADIUS, period), strict=True):
        assert np.array_equal(found[order], expected)


def test_the_transposed_list_is_the_transposed_operator():
    query, source, basis = cloud(60, 0.3, seed=3), cloud(80, 0.3, seed=4), BASES["radial"]
    q, s = (torch.from_numpy(i) for i in every_neighbor(query.numpy(), source.numpy(), RADIUS))
    pairs = weigh_pairs(basis, q, s, source[s] - query[q], 60, 80)
    there = dense(pairs).view(60, basis.size, 80)
    back = dense(pairs.transposed).view(80, basis.size, 60)
    assert torch.equal(back, there.permute(2, 1, 0))


def test_lonely_and_missing_particles_have_empty_lists():
    for count in (0, 1, 2):
        far = torch.arange(3.0 * count, dtype=torch.float64).view(count, 3)
        pairs = particle_neighborhood(BASES["lattice"], far)
        assert pairs.query_count == count
        assert len(pairs.source) == 0
