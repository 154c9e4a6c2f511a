"""The antisymmetric output of a particle branch: pairs conserve momentum, whatever the weights."""

from dataclasses import replace

import pytest
import torch

from gran_bench.compose import checked_config, compose
from gran_bench.config import BoundaryConfig, CconvModelConfig, SceneConfig, TrainConfig
from gran_bench.config.reading import validate
from gran_bench.scene import build_scene
from gran_bench.surrogate.convolution.antisymmetric import AntisymmetricLayer, antisymmetric
from gran_bench.surrogate.convolution.kernels.lattice import LatticeBasis
from gran_bench.surrogate.convolution.kernels.radial import RadialBasis
from gran_bench.surrogate.convolution.neighborhood import particle_neighborhood
from gran_bench.surrogate.step import build_model

RADIUS = 0.1125  # m
BASES = {"lattice": LatticeBasis(RADIUS, 4), "radial": RadialBasis.around_contact(0.05, RADIUS)}


def cloud(count=60, seed=0):
    """Spheres with a dozen neighbours each, ``(N, 3)`` m, in a period of 0.3 m."""
    return 0.3 * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 0.15


def layer(basis, backend="torch"):
    torch.manual_seed(0)
    return AntisymmetricLayer(8, 3, basis, backend, 12.0).double()


@pytest.mark.parametrize("period", [0.0, 0.3])
@pytest.mark.parametrize("basis", BASES.values(), ids=BASES)
def test_the_layer_is_the_sum_over_pairs_of_symmetric_features_and_an_odd_kernel(basis, period):
    position, features = cloud(), torch.randn(60, 8, dtype=torch.float64)
    pairs, built = particle_neighborhood(basis, position, period), layer(basis)
    kernel, active = antisymmetric(built.convolution.weight, basis), torch.relu(features)
    expected = torch.zeros(60, 3, dtype=torch.float64)
    for p, (i, j) in enumerate(zip(pairs.query.tolist(), pairs.source.tolist(), strict=True)):
        for corner, offset in enumerate(basis.offsets):
            expected[i] += pairs.coefficient[p, corner] * (active[i] + active[j]) @ kernel[pairs.first[p] + offset]
    found = built(features, pairs)
    assert torch.allclose(found, expected, rtol=1e-9, atol=1e-9)
    assert found.norm(dim=1).mean() > 0.1
    assert found.sum(dim=0).norm() < 1e-12 * found.norm(dim=1).sum()


@pytest.mark.parametrize("basis", BASES.values(), ids=BASES)
def test_the_kernel_changes_its_sign_with_the_vector(basis):
    vector = cloud(40, seed=1) * 0.4
    kernel = antisymmetric(torch.randn(basis.size, 2, 3, dtype=torch.float64), basis)
    values = []
    for one in (vector, -vector):
        first, value = basis.evaluate(one)
        rows = first[:, None] + torch.tensor(basis.offsets)
        values.append((value[:, :, None, None] * kernel[rows]).sum(dim=1))
    assert torch.allclose(values[0], -values[1], atol=1e-12)
    assert values[0].abs().max() > 0.1


@pytest.mark.parametrize("basis", BASES.values(), ids=BASES)
def test_the_fused_layer_gives_the_output_and_the_gradients_of_the_readable_one(basis):
    position, features, found = cloud(), torch.randn(60, 8, dtype=torch.float64), []
    pairs = particle_neighborhood(basis, position)
    for backend in ("fused", "torch"):
        built, given = layer(basis, backend), features.clone().requires_grad_()
        output = built(given, pairs)
        output.square().sum().backward()
        found.append((output, given.grad, built.convolution.weight.grad))
    for one, other in zip(*found, strict=True):
        assert torch.allclose(one, other, rtol=1e-9, atol=1e-9)


def network(scene, kernel, pair_branch, **changes):
    torch.manual_seed(0)
    name = {"lattice": "ccnn"}.get(kernel, kernel)
    config = CconvModelConfig(name=name, kernel=kernel, width=8, pair_branch=pair_branch, **changes)
    model = build_model(config, BoundaryConfig(kind="none"), scene)
    with torch.no_grad():
        for weight in model.parameters():
            weight += 0.1 * torch.randn_like(weight)
    return model


def space(periodic=False):
    config = SceneConfig(name="test")
    config.container.diameter, config.container.length, config.container.periodic_axis = 0.5, 0.4, periodic
    config.filling.count = 150
    return replace(build_scene(config), gravity=(0.0, 0.0, 0.0), walls=(), drum_radius=None)


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("backend", ["fused", "torch"])
@pytest.mark.parametrize("kernel", ["lattice", "radial"])
def test_without_walls_and_gravity_momentum_is_conserved_and_a_plain_branch_does_not(kernel, backend, periodic):
    scene = space(periodic)
    position = torch.from_numpy(scene.fresh_filling(0).position).float()
    velocity = 0.3 * torch.randn(position.shape, generator=torch.Generator().manual_seed(0))
    gained = {}
    for branch in ("plain", "antisymmetric"):
        model = network(scene, kernel, branch, backend=backend)
        state = model.begin(scene, position, velocity)
        with torch.no_grad():
            for k in range(5):
                state = model(state, scene, 1.5 + 0.01 * k)
        change = state.velocity.double() - velocity.double()
        assert change.norm(dim=1).mean() > 1e-3
        gained[branch] = (change.sum(dim=0).norm() / change.norm(dim=1).sum()).item()
    assert gained["antisymmetric"] < 1e-5  # rounding in float32
    assert gained["plain"] > 1e-2


def test_the_pair_part_alone_balances_beside_walls():
    scene = build_scene(SceneConfig(name="drum")).at_speed(30.0)
    position = torch.from_numpy(scene.fresh_filling(0).position[:300]).float()
    position[:, 2] -= position[:, 2].min() + 0.2
    torch.manual_seed(0)
    model = build_model(CconvModelConfig(width=8, pair_branch="antisymmetric"), BoundaryConfig(), scene)
    whole, of_pairs = model.accelerations(position, torch.randn(300, 3), scene, 1.5)
    assert of_pairs.sum(dim=0).norm() < 1e-5 * of_pairs.norm(dim=1).sum()
    assert not torch.allclose(whole, of_pairs)


def test_a_loss_of_momentum_has_nothing_to_teach_it():
    words = ["model=radial", "model.pair_branch=antisymmetric"]
    validate(checked_config(compose("train", words), TrainConfig))
    with pytest.raises(ValueError, match=r"^loss\.momentum=0\.1 .*model\.pair_branch=antisymmetric.*loss\.momentum=0"):
        validate(checked_config(compose("train", [*words, "loss=with_momentum"]), TrainConfig))
