"""The continuous-convolution network: its two branches, its kernels and walls, and what it may skip."""

import copy
import math
from dataclasses import replace

import pytest
import torch

from gran_bench.config import BoundaryConfig, CconvModelConfig, SceneConfig
from gran_bench.scene import build_scene
from gran_bench.surrogate.convolution.neighborhood import particle_neighborhood
from gran_bench.surrogate.step import build_model

SMALL = {"width": 8, "layers": 3}
KERNELS = ("lattice", "radial")
KINDS = ("spheres", "analytic", "none")


def drum(count=150, periodic=False, length=0.4, rpm=30.0):
    config = SceneConfig(name="test")
    config.container.diameter, config.container.length = 0.5, length
    config.container.periodic_axis = periodic
    config.filling.count = count
    return build_scene(config).at_speed(rpm)


def bed(scene, seed=0):
    """A dense filling with random velocities, ``(N, 3)`` each."""
    position = torch.from_numpy(scene.fresh_filling(seed).position).float()
    generator = torch.Generator().manual_seed(seed)
    return position, 0.3 * torch.randn(position.shape, generator=generator)


def network(scene, boundary=None, seed=0, **changes):
    torch.manual_seed(seed)
    name = "radial" if changes.get("kernel") == "radial" else "ccnn"
    model = build_model(CconvModelConfig(name=name, **(SMALL | changes)), boundary or BoundaryConfig(), scene)
    # First outputs are a tenth of the usual size, and biases zero: neither may hide an error from these tests.
    with torch.no_grad():
        for name, weight in model.named_parameters():
            if weight.dim() == 1:
                weight.uniform_(-0.5, 0.5)
            if name.startswith(("pair_layers.2", "wall_layers.2")):
                weight.mul_(10.0)
    return model


def steps(model, scene, position, velocity, frames=2):
    state = model.begin(scene, position, velocity)
    for k in range(frames):
        state = model(state, scene, scene.start_time + k * scene.frame_interval)
    return state


def test_the_papers_network_has_the_parameters_that_its_layers_add_up_to():
    cells, half = 64, 32
    mix = lambda a, b: cells * a * b + a * b + b  # noqa: E731
    particle = cells * 4 * half + half + 3 * half + half + 2 * mix(64, 64) + mix(64, 3)
    wall = 2 * cells * 3 * half + 2 * half + 3 * half + half + mix(96, 64) + mix(64, 64) + mix(64, 3)
    model = build_model(CconvModelConfig(), BoundaryConfig(), drum())
    assert model.parameter_count == particle + wall == 1_244_134
    assert "1,244,134 parameters" in str(model)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("kind", KINDS)
def test_the_fused_and_the_torch_backend_give_the_same_frames_and_gradients(kernel, kind):
    """Gradients through time included; with positions held constant in both, they are the same sums."""
    scene = drum()
    # In float64: a ReLU whose input is a rounding error would differ in float32.
    position, velocity = (values.double() for values in bed(scene))
    fused = network(scene, BoundaryConfig(kind=kind), kernel=kernel, backend="fused").double()
    plain = network(scene, BoundaryConfig(kind=kind), kernel=kernel, backend="torch").double()
    plain.load_state_dict(fused.state_dict())
    gradients = []
    for model in (fused, plain):
        start = velocity.clone().requires_grad_()
        if model is plain:  # hold the geometry constant here too
            original = model.accelerations
            model.accelerations = lambda x, v, s, t, original=original: original(x.detach(), v, s, t)
        state = steps(model, scene, position, start)
        state.velocity.pow(2).mean().backward()
        gradients.append([state.position.detach(), start.grad, *(p.grad for p in model.parameters())])
    for a, b in zip(*gradients, strict=True):
        assert (a - b).norm() <= 1e-9 * b.norm()


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("kind", KINDS)
def test_float64_gradients_are_exact_through_positions_too(kernel, kind):
    scene = drum(count=6)
    position = (0.06 * torch.rand(6, 3, generator=torch.Generator().manual_seed(2))).double()
    position = position + torch.tensor([0.0, 0.1, -0.2], dtype=torch.float64)
    velocity = torch.randn(6, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    model = network(scene, BoundaryConfig(kind=kind), kernel=kernel, backend="torch", width=4).double()

    def acceleration(position, velocity):
        return model.acceleration(position, velocity, scene, 1.5)

    assert torch.autograd.gradcheck(acceleration, (position.requires_grad_(), velocity.requires_grad_()), atol=1e-4)


@pytest.mark.parametrize("kind", ["spheres", "analytic"])
def test_the_wall_branch_computed_for_near_particles_alone_equals_the_masked_one(kind):
    """Particles out of a wall's reach have no wall features; computing the rest alone changes nothing."""
    scene = drum(count=300)
    position, velocity = bed(scene)
    model = network(scene, BoundaryConfig(kind=kind), backend="torch")
    pairs = particle_neighborhood(model.pair_basis, position)
    wall = model._see_walls(position, velocity, scene, 1.5)
    assert 0 < len(wall.near) < len(position)
    alone = model._wall_branch(velocity[wall.near], pairs, wall)

    mask = torch.zeros(len(position), 1)
    mask[wall.near] = 1.0
    features = torch.zeros(len(position), 12)
    features[wall.near] = model._wall_input(velocity[wall.near], wall)
    for layer in model.wall_layers:
        features = mask * layer(features, pairs)
    assert torch.allclose(alone, features[wall.near], rtol=1e-5, atol=1e-5)


def test_far_from_all_walls_the_wall_branch_is_skipped_with_the_same_result():
    scene = drum(count=20)
    position = 0.05 * torch.rand(20, 3, generator=torch.Generator().manual_seed(0))
    velocity = bed(scene)[1]
    model = network(scene)
    without = copy.deepcopy(model)
    without.has_walls = False
    assert torch.equal(
        model.acceleration(position, velocity, scene, 1.5), without.acceleration(position, velocity, scene, 1.5)
    )


def test_still_walls_are_given_no_velocity_with_the_same_result():
    scene = drum(rpm=0.0)
    position, velocity = bed(scene)
    model = network(scene)
    assert not scene.needs.wall_motion
    wall = model._see_walls(position, velocity, scene, 1.5)
    assert not wall.velocity.any()
    features = model._wall_input(velocity[wall.near], wall)
    assert torch.equal(features, model._wall_input(velocity[wall.near], replace(wall, moves=True)))


def test_a_scene_without_walls_makes_no_wall_branch():
    scene = replace(drum(), walls=())
    model = network(scene)
    assert not any(name.startswith("wall") for name, _ in model.named_parameters())
    assert torch.isfinite(steps(model, scene, *bed(drum())).position).all()


@pytest.mark.parametrize("normal", [True, False])
@pytest.mark.parametrize("velocity", [True, False])
@pytest.mark.parametrize("kind", ["spheres", "analytic"])
def test_boundary_features_can_be_switched_off(normal, velocity, kind):
    """The wall's speed reaches the network through its velocities (and the slip), and through nothing else."""
    boundary = BoundaryConfig(kind=kind, normal=normal, velocity=velocity)
    model = network(drum(), boundary)
    slow, fast = (steps(model, drum(rpm=rpm), *bed(drum())).velocity for rpm in (20.0, 40.0))
    assert torch.equal(slow, fast) is not velocity


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_order_of_the_particles_does_not_matter(kernel):
    scene = drum()
    position, velocity = bed(scene)
    order = torch.randperm(len(position), generator=torch.Generator().manual_seed(5))
    model = network(scene, kernel=kernel)
    with torch.no_grad():
        straight = steps(model, scene, position, velocity).position[order]
        shuffled = steps(model, scene, position[order], velocity[order]).position
    assert torch.allclose(straight, shuffled, atol=1e-6)


@pytest.mark.parametrize("kind", ["spheres", "analytic"])
@pytest.mark.parametrize("length", [0.4, 0.2])
def test_a_periodic_bed_shifted_along_its_axis_moves_the_same(kind, length):
    """Wall spheres turn with the rows, so a shift by two of their rows leaves them where they are."""
    scene = drum(count=100, periodic=True, length=length)
    position, velocity = bed(scene)
    shift = torch.tensor([0.0, 2 * 0.025 * 3, 0.0])
    model = network(scene, BoundaryConfig(kind=kind))
    with torch.no_grad():
        here = steps(model, scene, position, velocity)
        there = steps(model, scene, position + shift, velocity)
    assert there.position[:, 1].abs().max() <= 0.5 * length
    assert torch.allclose(here.velocity, there.velocity, atol=1e-5)


@pytest.mark.parametrize("residual", [True, False])
def test_the_residual_is_a_choice_and_adds_no_parameters(residual):
    scene = drum()
    model, other = network(scene, residual=residual), network(scene, residual=not residual)
    assert model.parameter_count == other.parameter_count
    frames = [steps(m, scene, *bed(scene)).velocity for m in (model, other)]
    assert not torch.allclose(*frames)


def test_without_the_constant_input_a_bed_at_rest_sends_no_signal():
    scene = replace(drum(), gravity=(0.0, 0.0, 0.0))
    position = bed(scene)[0]
    spread = {}
    for constant in (True, False):
        model = network(scene, BoundaryConfig(kind="none"), constant_input=constant, layers=1)
        model.pair_layers[0].convolution.weight.data.zero_()
        spread[constant] = model.acceleration(position, torch.zeros_like(position), scene, 1.5).std(dim=0).max()
    assert spread[False] < 1e-6 < spread[True]


def test_one_unit_of_output_is_the_output_scale_in_diameters_a_frame_squared():
    scene = replace(drum(), gravity=(0.0, 0.0, 0.0))
    model = network(scene, BoundaryConfig(kind="none"), output_scale_diameters=0.04)
    for weight in model.parameters():
        weight.data.zero_()
    model.pair_layers[-1].linear.bias.data.fill_(1.0)
    position, velocity = bed(scene)
    state = steps(model, scene, position, 0.0 * velocity, frames=1)
    assert torch.allclose(state.position - position, torch.full_like(position, 2e-3), atol=1e-7)


def test_a_copy_shares_nothing_and_repeats_bit_for_bit():
    scene = drum()
    model = network(scene)
    twin = copy.deepcopy(model)
    position, velocity = bed(scene)
    assert torch.equal(
        steps(model, scene, position, velocity).position, steps(twin, scene, position, velocity).position
    )
    next(twin.parameters()).data.add_(1.0)
    assert not torch.equal(next(twin.parameters()), next(model.parameters()))


@pytest.mark.parametrize(
    ("where", "change"),
    [
        ("model.kernel=cubic", {"kernel": "cubic"}),
        ("model.width=7", {"width": 7}),
        ("model.layers=0", {"layers": 0}),
        ("model.radius_m=0.05", {"radius_m": 0.05}),
        ("model.kernel_size=1", {"kernel_size": 1}),
        ("model.output_scale_diameters=0", {"output_scale_diameters": 0.0}),
        ("model.update=euler", {"update": "euler"}),
        ("model.backend=gpu", {"backend": "gpu"}),
        ("model.name=gnn", {"name": "gnn"}),
    ],
)
def test_impossible_models_are_refused_by_key_and_value(where, change):
    with pytest.raises(ValueError, match=where.replace(".", r"\.")):
        build_model(CconvModelConfig(**change), BoundaryConfig(), drum())


@pytest.mark.parametrize(
    ("where", "boundary"),
    [
        ("boundary.kind=mesh", {"kind": "mesh"}),
        ("boundary.kind=own", {"kind": "own"}),
        ("boundary.spacing=-1", {"spacing": -1.0}),
    ],
)
def test_impossible_boundaries_are_refused_by_key_and_value(where, boundary):
    with pytest.raises(ValueError, match=where.replace(".", r"\.")):
        build_model(CconvModelConfig(), BoundaryConfig(**boundary), drum())


def test_a_diverged_state_gives_nan_and_no_crash():
    scene = drum()
    position, velocity = bed(scene)
    model = network(scene)
    state = model.begin(scene, position, velocity)
    state.velocity[3] = math.inf
    assert model(state, scene, scene.start_time).velocity.isnan().all()
    position, velocity = bed(scene)
    velocity[3] = 1e9  # finite, far out: neighbours of nobody
    assert steps(network(scene), scene, position, velocity, frames=1).position.isfinite().all()
