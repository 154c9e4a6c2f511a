"""The continuous convolution: equal to the reference layer of the field, differentiable, and the same on every path."""

from pathlib import Path

import numpy as np
import pytest
import torch
from beds import every_neighbor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_iter

from gran_bench.surrogate.convolution.cconv import ContinuousConvolution, convolve
from gran_bench.surrogate.convolution.kernels import fused
from gran_bench.surrogate.convolution.kernels.fused import convolve_fused
from gran_bench.surrogate.convolution.kernels.lattice import LatticeBasis, ball_to_cube
from gran_bench.surrogate.convolution.kernels.radial import RadialBasis
from gran_bench.surrogate.convolution.neighborhood import particle_neighborhood, weigh_pairs

REFERENCE = Path(__file__).parent / "reference"
DIAMETER, RADIUS = 0.05, 0.1125
BASES = {
    "lattice": LatticeBasis(RADIUS, 4),
    "lattice of 3": LatticeBasis(RADIUS, 3),
    "radial": RadialBasis.around_contact(DIAMETER, RADIUS),
}


def neighborhood(query, source, basis, exclude_self, dtype=torch.float32):
    """Pairs of two point sets, weighed; the positions may carry gradients."""
    q, s = every_neighbor(query.detach().double().numpy(), source.detach().double().numpy(), basis.radius)
    keep = (q != s) if exclude_self else np.ones(len(q), bool)
    q, s = torch.from_numpy(q[keep]), torch.from_numpy(s[keep])
    relative = source.to(dtype)[s] - query.to(dtype)[q]
    return weigh_pairs(basis, q, s, relative, len(query), len(source), symmetric=exclude_self)


def points(count, seed, width=0.3):
    return torch.from_numpy(np.random.default_rng(seed).uniform(0.0, width, (count, 3)))


def relative_rms(found, expected):
    found = found.detach()
    return float(((found - expected).pow(2).mean() / expected.pow(2).mean()).sqrt())


@pytest.mark.parametrize("case", ["particles", "wall"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_lattice_layer_equals_open3d_in_output_and_both_gradients(case, dtype):
    data = {k: torch.from_numpy(np.asarray(v)) for k, v in np.load(REFERENCE / f"open3d_cconv_{case}.npz").items()}
    basis = LatticeBasis(float(data["radius"]), 4)
    pairs = neighborhood(data["query_position"], data["source_position"], basis, bool(data["exclude_self"]), dtype)
    features = data["features"].to(dtype).requires_grad_()
    kernel = data["kernel_zyx_in_out"].to(dtype).flatten(0, 2).requires_grad_()
    output = convolve(features, kernel, pairs)
    output.backward(data["output_gradient"].to(dtype))
    assert len(pairs.source) == int(data["neighbours"])
    assert relative_rms(output, data["output"]) < 2e-6
    assert relative_rms(features.grad, data["feature_gradient"]) < 2e-6
    assert relative_rms(kernel.grad, data["kernel_gradient"].flatten(0, 2)) < 2e-6


@pytest.mark.parametrize("name", BASES)
def test_gradients_in_features_kernel_and_positions_are_exact(name):
    basis = BASES[name]
    position = points(7, seed=3, width=0.12).requires_grad_()
    features = torch.randn(7, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    kernel = torch.randn(basis.size, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))

    def layer(position, features, kernel):
        return convolve(features, kernel, neighborhood(position, position, basis, True, torch.float64))

    assert torch.autograd.gradcheck(layer, (position, features, kernel.requires_grad_()))


@pytest.mark.parametrize("name", BASES)
def test_a_mirrored_vector_uses_the_mirrored_functions(name):
    basis = BASES[name]
    vectors = (points(200, seed=5, width=2.0) - 1.0) * (0.55 * RADIUS)

    def functions(relative):
        first, value = basis.evaluate(relative)
        dense = torch.zeros(len(relative), basis.size, dtype=value.dtype)
        return dense.scatter_add(1, first[:, None] + torch.tensor(basis.offsets), value)

    mirrored = functions(-vectors)
    assert torch.allclose(functions(vectors), mirrored[:, basis.mirror] * basis.mirror_sign, atol=1e-12)


@pytest.mark.parametrize("name", ["lattice", "lattice of 3"])
def test_lattice_functions_sum_to_one_and_the_cubes_corner_is_a_node(name):
    basis = BASES[name]
    vectors = (points(300, seed=6, width=2.0) - 1.0) * (0.577 * RADIUS)
    assert torch.allclose(basis.evaluate(vectors)[1].sum(1), torch.ones(300, dtype=torch.float64))
    pole = torch.tensor([[0.0, 0.0, RADIUS], [0.0, 0.0, 0.0]], dtype=torch.float64)
    assert ball_to_cube(pole / RADIUS).tolist() == [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]


def test_the_ball_maps_onto_the_whole_cube_and_keeps_volumes():
    """Evenly spread points of the ball fill 4³ equal boxes of the cube evenly."""
    ball = 2.0 * torch.quasirandom.SobolEngine(3).draw(2**17, dtype=torch.float64) - 1.0
    ball = ball[ball.norm(dim=1) <= 1.0]
    cube = ball_to_cube(ball)
    assert cube.abs().max() <= 1.0 + 1e-12
    box = ((cube + 1.0) * 2.0).floor().clamp(0, 3).long() @ torch.tensor([1, 4, 16])
    counts = torch.bincount(box, minlength=64).double()
    assert (counts / counts.mean() - 1.0).abs().max() < 0.02


def test_radial_hats_peak_at_their_nodes_and_stay_flat_inside_the_first():
    basis = RadialBasis((0.02, 0.05, 0.1))
    along_x = torch.tensor([[0.01, 0.0, 0.0], [0.05, 0.0, 0.0], [0.075, 0.0, 0.0]], dtype=torch.float64)
    first, value = basis.evaluate(along_x)
    assert first.tolist() == [0, 4, 4]
    expected = [[1, 1, 0, 0, 0, 0, 0, 0], [1, 1, 0, 0, 0, 0, 0, 0], [0.5, 0.5, 0, 0, 0.5, 0.5, 0, 0]]
    assert torch.allclose(value, torch.tensor(expected, dtype=torch.float64))


def test_radial_nodes_surround_the_contact_of_particles_and_of_walls():
    of_pairs = RadialBasis.around_contact(DIAMETER, RADIUS)
    of_walls = RadialBasis.around_contact(DIAMETER, RADIUS, contact=0.5 * DIAMETER)
    assert np.allclose(of_pairs.nodes, [0.04, 0.0475, 0.051, 0.056, 0.07, 0.09, RADIUS])
    assert np.allclose(of_walls.nodes, [0.015, 0.0225, 0.026, 0.031, 0.045, 0.065, RADIUS])
    assert of_pairs.size == 28


def test_no_neighbour_is_capped():
    """A thousand sources in one ball all count."""
    source = points(1000, seed=1, width=0.06)
    query = torch.full((1, 3), 0.03, dtype=torch.float64)
    pairs = neighborhood(query, source, BASES["lattice"], False, torch.float64)
    kernel = torch.ones(64, 1, 1, dtype=torch.float64)
    total = convolve(torch.ones(1000, 1, dtype=torch.float64), kernel, pairs)
    window = (1.0 - (source - query).pow(2).sum(1) / RADIUS**2) ** 3
    assert torch.allclose(total, window.sum().reshape(1, 1))


@pytest.mark.parametrize("name", BASES)
def test_first_weights_turn_unit_features_into_unit_outputs(name):
    torch.manual_seed(0)
    position = points(2000, seed=2, width=0.5)
    pairs = neighborhood(position, position, BASES[name], True)
    neighbors = len(pairs.source) / 2000
    layer = ContinuousConvolution(16, 200, BASES[name], "torch", neighbors)
    inside = ((position > RADIUS) & (position < 0.5 - RADIUS)).all(dim=1)
    output = layer(torch.ones(2000, 16), pairs)[inside]
    assert 0.5 < float(output.detach().std()) < 2.0


def test_particles_without_neighbours_give_zero():
    position = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    pairs = neighborhood(position, position, BASES["radial"], True)
    assert torch.equal(convolve(torch.ones(2, 3), torch.ones(28, 3, 2), pairs), torch.zeros(2, 2))


def test_an_unknown_backend_is_refused_by_name():
    with pytest.raises(ValueError, match=r"model\.backend=cuda"):
        ContinuousConvolution(1, 1, BASES["lattice"], "cuda")


@pytest.fixture(params=[1, 2])
def threads(request):
    """Runs a test with so many of torch's threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def outputs_and_gradients(convolution, pairs, basis, dtype, features_trained=True, channels=(5, 7)):
    """Output, feature gradient and kernel gradient of one pass over fixed random features."""
    generator = torch.Generator().manual_seed(11)
    features = torch.randn(pairs.source_count, channels[0], generator=generator, dtype=dtype)
    kernel = torch.randn(basis.size, *channels, generator=generator, dtype=dtype).requires_grad_()
    output = convolution(features.requires_grad_(features_trained), kernel, pairs)
    output.backward(torch.randn(output.shape, generator=generator, dtype=dtype))
    gradients = (features.grad, kernel.grad) if features_trained else (kernel.grad,)
    return output.detach(), *gradients


@pytest.mark.parametrize("name", BASES)
@pytest.mark.parametrize("symmetric", [True, False], ids=["symmetric", "two sets"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("features_trained", [True, False])
def test_the_fused_path_equals_the_reference(name, symmetric, dtype, features_trained, threads):
    query = points(400, seed=1)
    source = query if symmetric else points(300, seed=2)
    pairs = neighborhood(query, source, BASES[name], symmetric, dtype)
    arguments = (pairs, BASES[name], dtype, features_trained)
    for fast, reference in zip(
        outputs_and_gradients(convolve_fused, *arguments), outputs_and_gradients(convolve, *arguments), strict=True
    ):
        assert relative_rms(fast, reference) < (2e-6 if dtype == torch.float32 else 1e-13)


@pytest.mark.parametrize("case", ["particles", "wall"])
def test_the_fused_path_equals_open3d(case):
    data = {k: torch.from_numpy(np.asarray(v)) for k, v in np.load(REFERENCE / f"open3d_cconv_{case}.npz").items()}
    basis = LatticeBasis(float(data["radius"]), 4)
    pairs = neighborhood(data["query_position"], data["source_position"], basis, bool(data["exclude_self"]))
    features, kernel = data["features"].requires_grad_(), data["kernel_zyx_in_out"].flatten(0, 2).requires_grad_()
    output = convolve_fused(features, kernel, pairs)
    output.backward(data["output_gradient"])
    assert relative_rms(output, data["output"]) < 2e-6
    assert relative_rms(features.grad, data["feature_gradient"]) < 2e-6
    assert relative_rms(kernel.grad, data["kernel_gradient"].flatten(0, 2)) < 2e-6


def test_without_onednn_the_fused_path_multiplies_with_the_blas(monkeypatch):
    position = points(300, seed=4)
    pairs = neighborhood(position, position, BASES["lattice"], True)
    arguments = (convolve_fused, pairs, BASES["lattice"], torch.float32)
    chosen = outputs_and_gradients(*arguments)

    def missing(left, right):
        raise RuntimeError("no such operator in this build")

    monkeypatch.setattr(fused, "_blas_is_wide", lambda: False)
    monkeypatch.setattr(fused, "_onednn_product", missing)
    monkeypatch.setattr(fused, "_product", fused._choose_product())
    assert fused._product is torch.mm
    for a, b in zip(outputs_and_gradients(*arguments), chosen, strict=True):
        assert relative_rms(a, b) < 2e-6


def test_onednn_multiplies_as_the_blas_does(monkeypatch):
    position = points(300, seed=4)
    pairs = neighborhood(position, position, BASES["lattice"], True)
    results = []
    for wide in (True, False):
        monkeypatch.setattr(fused, "_blas_is_wide", lambda wide=wide: wide)
        monkeypatch.setattr(fused, "_product", fused._choose_product())
        results.append(outputs_and_gradients(convolve_fused, pairs, BASES["lattice"], torch.float32))
    assert fused._product is fused._onednn_product
    for a, b in zip(*results, strict=True):
        assert relative_rms(a, b) < 2e-6


def test_the_fused_path_repeats_bit_for_bit(threads):
    position = points(700, seed=4)
    pairs = neighborhood(position, position, BASES["lattice"], True)
    first, again = (
        outputs_and_gradients(convolve_fused, pairs, BASES["lattice"], torch.float32, channels=(16, 24))
        for _ in range(2)
    )
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


def test_the_fused_path_copes_with_no_pairs_and_with_no_particles():
    basis = BASES["lattice"]
    for count in (0, 3):
        far = torch.arange(3.0 * count, dtype=torch.float64).view(count, 3)
        output, of_features, of_kernel = outputs_and_gradients(
            convolve_fused, neighborhood(far, far, basis, True), basis, torch.float32
        )
        assert output.shape == (count, 7)
        assert not output.any()
        assert not of_features.any()
        assert not of_kernel.any()


def test_pairs_among_some_particles_are_those_of_a_search_among_them():
    position, basis = points(300, seed=7), BASES["lattice"]
    kept = torch.arange(0, 300, 2)
    among = neighborhood(position, position, basis, True).restricted(kept)
    searched = neighborhood(position[kept], position[kept], basis, True)
    assert torch.equal(among.row_start, searched.row_start)
    assert torch.equal(among.source, searched.source)
    assert torch.equal(among.coefficient, searched.coefficient)


def rounded(convolution):
    """A convolution with its factors in bfloat16."""
    return lambda features, weight, pairs: convolution(features, weight, pairs, "bfloat16")


@pytest.mark.parametrize("name", BASES)
@pytest.mark.parametrize("symmetric", [True, False], ids=["symmetric", "two sets"])
@pytest.mark.parametrize("features_trained", [True, False])
@pytest.mark.parametrize("convolution", [convolve_fused, convolve], ids=["fused", "torch"])
def test_bfloat16_moves_outputs_and_gradients_by_no_more_than_is_said(
    name, symmetric, features_trained, convolution, threads
):
    query = points(400, seed=1)
    source = query if symmetric else points(300, seed=2)
    pairs = neighborhood(query, source, BASES[name], symmetric)
    arguments = (pairs, BASES[name], torch.float32, features_trained, (32, 24))
    exact = outputs_and_gradients(convolve, *arguments)
    found = outputs_and_gradients(rounded(convolution), *arguments)
    again = outputs_and_gradients(rounded(convolution), *arguments)
    for values, expected, repeated in zip(found, exact, again, strict=True):
        assert values.dtype == torch.float32
        assert 1e-4 < relative_rms(values, expected) < 4e-3
        assert torch.equal(values, repeated)


def test_both_bfloat16_paths_give_the_same_outputs():
    """They round the same sums; only where those differ by float32's rounding may a factor fall to the other side."""
    position = points(400, seed=1)
    pairs = neighborhood(position, position, BASES["lattice"], True)
    arguments = (pairs, BASES["lattice"], torch.float32, True, (32, 24))
    fused_output, plain_output = (
        outputs_and_gradients(rounded(convolution), *arguments)[0] for convolution in (convolve_fused, convolve)
    )
    assert relative_rms(fused_output, plain_output) < 1e-3
    assert float((fused_output == plain_output).float().mean()) > 0.9


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("convolution", [convolve_fused, convolve], ids=["fused", "torch"])
def test_permuted_particles_give_permuted_results(convolution, precision):
    position, order = points(500, seed=9), torch.randperm(500, generator=torch.Generator().manual_seed(2))
    features = torch.randn(500, 8, generator=torch.Generator().manual_seed(3))
    kernel = torch.randn(64, 8, 8, generator=torch.Generator().manual_seed(4))
    results = []
    for place, given in ((position, features), (position[order], features[order])):
        given, weight = given.clone().requires_grad_(), kernel.clone().requires_grad_()
        output = convolution(given, weight, neighborhood(place, place, BASES["lattice"], True), precision)
        output.pow(2).sum().backward()
        results.append((output.detach(), given.grad, weight.grad))
    (output, of_features, of_kernel), permuted = results
    for found, expected in zip(permuted, (output[order], of_features[order], of_kernel), strict=True):
        assert relative_rms(found, expected) < (2e-6 if precision == "float32" else 3e-3)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_what_is_not_a_number_stays_none(precision):
    position = points(200, seed=4)
    pairs = neighborhood(position, position, BASES["lattice"], True)
    features = torch.ones(200, 8)
    features[7] = torch.nan
    output = convolve_fused(features, torch.ones(64, 8, 8), pairs, precision)
    sees = torch.unique(pairs.query[pairs.source == 7])
    assert output[sees].isnan().all()
    assert output.isnan().any(dim=1).sum() == len(sees) > 0


def test_features_of_every_width_are_gathered_whole(threads):
    """Vectors of 64, 16, 4 and 1 share the work."""
    position = points(150, seed=5)
    pairs = neighborhood(position, position, BASES["radial"], True)
    for width in (1, 3, 4, 16, 23, 64, 87, 149):
        arguments = (pairs, BASES["radial"], torch.float32, True, (width, 3))
        for fast, reference in zip(
            outputs_and_gradients(convolve_fused, *arguments), outputs_and_gradients(convolve, *arguments), strict=True
        ):
            assert relative_rms(fast, reference) < 2e-6


def test_gradients_of_the_fused_path_are_exact():
    position = points(7, seed=3, width=0.12)
    pairs = neighborhood(position, position, BASES["lattice"], True, torch.float64)
    features = torch.randn(7, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    kernel = torch.randn(64, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    assert torch.autograd.gradcheck(lambda f, k: convolve_fused(f, k, pairs), (features, kernel))


class Largest(TorchDispatchMode):
    """The most bytes that an operation gives in memory of its own."""

    bytes = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        before, after = (
            {t.untyped_storage().data_ptr(): t.untyped_storage().nbytes() for t in tree_iter(x) if torch.is_tensor(t)}
            for x in ((args, kwargs), result)
        )
        self.bytes = max([self.bytes, *(size for memory, size in after.items() if memory not in before)])
        return result


@pytest.mark.parametrize("threads", [1], indirect=True)
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_the_fused_path_never_holds_what_all_particles_gather(precision, threads):
    """Its largest tensor is a block's buffer, the kernel or the features, however many particles there are."""
    pairs = particle_neighborhood(BASES["lattice"], points(6000, seed=1, width=1.2).float())
    features = torch.randn(6000, 16, requires_grad=True)
    kernel = torch.randn(64, 16, 16, requires_grad=True)
    with Largest() as largest:
        convolve_fused(features, kernel, pairs, precision).sum().backward()
    assert fused._BUFFER_BYTES // 4 <= largest.bytes <= fused._BUFFER_BYTES
    assert 8 * largest.bytes < 6000 * 64 * 16 * 4


def test_an_unknown_precision_is_refused_by_name():
    with pytest.raises(ValueError, match=r"model\.precision=float16.*float32 or bfloat16"):
        ContinuousConvolution(1, 1, BASES["lattice"], precision="float16")


def test_the_blas_multiplies_where_it_takes_the_widest_vectors(monkeypatch):
    monkeypatch.setattr(fused, "_blas_is_wide", lambda: True)
    assert fused._choose_product() is torch.mm
