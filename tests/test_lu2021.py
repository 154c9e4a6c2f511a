"""One network that predicts positions over a static boundary: what it sees, what it cannot, and free flight."""

import pytest
import torch
from test_ccnn import bed, drum, steps

from gran_bench.config import BoundaryConfig, Lu2021Config
from gran_bench.config.rules import ConfigError
from gran_bench.surrogate.step import build_model

STATIC = BoundaryConfig(velocity=False)


def network(scene, boundary=STATIC, **changes):
    """A small one whose outputs are as large as its inputs, and whose biases are not zero."""
    torch.manual_seed(0)
    model = build_model(Lu2021Config(**({"width": 8} | changes)), boundary, scene)
    with torch.no_grad():
        for weight in (w for w in model.parameters() if w.dim() == 1):
            weight.uniform_(-0.5, 0.5)
        for weight in model.layers[-1].parameters():
            weight.mul_(10.0)
    return model


@pytest.mark.parametrize("kernel", ["lattice", "radial"])
@pytest.mark.parametrize("kind", ["spheres", "none"])
def test_the_fused_and_the_torch_backend_give_the_same_frames_and_gradients(kernel, kind):
    """With positions held constant in both, they are the same sums."""
    scene, boundary = drum(), BoundaryConfig(kind=kind, velocity=kind == "none")
    position, velocity = (values.double() for values in bed(scene))
    fused, plain = (network(scene, boundary, kernel=kernel, backend=backend).double() for backend in ("fused", "torch"))
    plain.load_state_dict(fused.state_dict())
    plain_correction = plain.correction
    plain.correction = lambda x, v, s, t: plain_correction(x.detach(), v, s, t)
    gradients = []
    for model in (fused, plain):
        start = velocity.clone().requires_grad_()
        state = steps(model, scene, position, start)
        state.velocity.pow(2).mean().backward()
        gradients.append([state.position.detach(), start.grad, *(p.grad for p in model.parameters())])
    for a, b in zip(*gradients, strict=True):
        assert b.norm() > 0
        assert (a - b).norm() <= 1e-9 * b.norm()


def test_float64_gradients_are_exact_through_positions_too():
    scene = drum(count=6)
    generator = torch.Generator().manual_seed(2)
    position = 0.06 * torch.rand(6, 3, generator=generator, dtype=torch.float64)
    position = position + torch.tensor([0.0, 0.1, -0.2], dtype=torch.float64)
    velocity = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    model = network(scene, backend="torch", width=4).double()

    def corrected(position, velocity):
        return 1e3 * model.correction(position, velocity, scene, 1.5)

    assert torch.autograd.gradcheck(corrected, (position.requires_grad_(), velocity.requires_grad_()), atol=1e-4)


def test_the_order_of_the_particles_does_not_matter():
    scene = drum()
    position, velocity = bed(scene)
    order = torch.randperm(len(position), generator=torch.Generator().manual_seed(5))
    model = network(scene)
    with torch.no_grad():
        straight = steps(model, scene, position, velocity).position[order]
        shuffled = steps(model, scene, position[order], velocity[order]).position
    assert torch.allclose(straight, shuffled, atol=1e-6)


def test_the_velocity_is_the_difference_of_two_positions():
    scene = drum()
    position, velocity = (values.double() for values in bed(scene))
    model = network(scene).double()
    state = model(model.begin(scene, position, velocity), scene, 1.5)
    assert model.velocity_kind == "mean"
    assert torch.allclose(state.velocity, (state.position - position) / scene.frame_interval, atol=1e-12)
    assert not torch.allclose(state.velocity, velocity + velocity.new_tensor(scene.gravity) * 0.01, atol=1e-3)


def test_a_static_boundary_does_not_tell_how_fast_a_drum_turns_and_yet_tells_where_it_is():
    position, velocity = bed(drum())
    model = network(drum())
    slow, fast, none = (
        steps(one, drum(rpm=rpm), position, velocity).velocity
        for one, rpm in ((model, 0.0), (model, 60.0), (network(drum(), BoundaryConfig(kind="none")), 60.0))
    )
    assert torch.equal(slow, fast)
    assert not torch.allclose(slow, none)
    near_wall = torch.tensor([[0.0, 0.0, -0.22]])
    still = torch.zeros(1, 3)
    pushed = model.correction(near_wall, still, drum(), 1.5)
    assert pushed.norm() > 1e-4
    bare = network(drum(), BoundaryConfig(velocity=False, normal=False))
    assert bare.parameter_count == model.parameter_count - 2 * 64 * 4  # of 3 components a constant is left
    assert not torch.equal(bare.correction(near_wall, still, drum(), 1.5), pushed)


def test_it_has_the_parameters_that_its_layers_add_up_to():
    cells, half = 64, 32
    mix = lambda a, b: cells * a * b + a * b + b  # noqa: E731
    first = cells * 4 * half + half + 3 * half + half + cells * 3 * half + half
    model = build_model(Lu2021Config(width=64), STATIC, drum())
    assert model.parameter_count == first + mix(96, 64) + mix(64, 64) + mix(64, 3)


@pytest.mark.parametrize(
    ("words", "boundary"),
    [
        (r"boundary\.velocity=true: model=lu2021 has a static boundary.*spheres_normal", BoundaryConfig()),
        (r"boundary\.kind=analytic: .* static points; choose spheres", BoundaryConfig(kind="analytic", velocity=False)),
    ],
)
def test_walls_that_move_are_refused_by_key_and_value(words, boundary):
    with pytest.raises(ConfigError, match=words):
        build_model(Lu2021Config(), boundary, drum())


@pytest.mark.parametrize(
    ("where", "change"),
    [("model.width=7", {"width": 7}), ("model.radius_m=0.05", {"radius_m": 0.05}), ("model.layers=0", {"layers": 0})],
)
def test_impossible_sizes_are_refused_by_key_and_value(where, change):
    with pytest.raises(ConfigError, match=where.replace(".", r"\.")):
        build_model(Lu2021Config(**change), STATIC, drum())


def test_a_diverged_state_gives_nan_and_no_crash():
    scene = drum()
    model = network(scene)
    state = model.begin(scene, *bed(scene))
    state.velocity[3] = torch.inf
    after = model(state, scene, scene.start_time)
    assert after.velocity.isnan().all()
    assert after.position.isnan().all()
