"""Accelerations of two branches over a static boundary: the CCNN without its wall velocities, and nothing else."""

import pytest
import torch
from test_ccnn import bed, drum, steps

from gran_bench.config import BoundaryConfig, CconvModelConfig, XuShen2022Config
from gran_bench.config.rules import ConfigError
from gran_bench.surrogate.step import build_model

STATIC = BoundaryConfig(velocity=False)


def network(config=XuShen2022Config, boundary=STATIC, scene=None, **changes):
    """A small one whose outputs are as large as its inputs, and whose biases are not zero."""
    torch.manual_seed(0)
    model = build_model(config(**({"width": 8} | changes)), boundary, scene or drum())
    with torch.no_grad():
        for weight in (w for w in model.parameters() if w.dim() == 1):
            weight.uniform_(-0.5, 0.5)
        for layers in (model.pair_layers, model.wall_layers):
            for weight in layers[-1].parameters():
                weight.mul_(10.0)
    return model


@pytest.mark.parametrize("update", ["mean", "trapezoid"])
def test_it_is_the_ccnn_without_the_velocities_of_walls(update):
    scene, start = drum(), bed(drum())
    model, ccnn = network(update=update), network(CconvModelConfig, update=update)
    assert torch.equal(steps(model, scene, *start).position, steps(ccnn, scene, *start).position)
    moving = network(CconvModelConfig, BoundaryConfig(), update=update)
    left_out = {name for name in moving.state_dict() if name not in model.state_dict()}
    assert left_out == {"wall_velocity.weight"}


def test_it_moves_particles_by_newtons_law():
    """v' = v + (g + a) Δt, x' = x + v' Δt, with a of the particles and of the wall at the ballistic guess."""
    scene, model = drum(), network().double()
    position, velocity = (values.double() for values in bed(scene))
    predicted = velocity + velocity.new_tensor(scene.gravity) * 0.01
    total, of_pairs = model.accelerations(position + 0.01 * predicted, predicted, scene, 1.5)
    after = model(model.begin(scene, position, velocity), scene, 1.5)
    assert torch.allclose(after.velocity, predicted + 0.01 * total, atol=1e-12)
    assert torch.allclose(after.position, position + 0.01 * after.velocity, atol=1e-12)
    assert torch.equal(after.pair_acceleration, of_pairs)
    beside_walls = (total - of_pairs).norm(dim=1) > 0
    assert 0 < beside_walls.sum() < len(position)


def test_the_order_of_the_particles_does_not_matter():
    scene, model = drum(), network()
    position, velocity = bed(scene)
    order = torch.randperm(len(position), generator=torch.Generator().manual_seed(5))
    with torch.no_grad():
        straight = steps(model, scene, position, velocity).position[order]
        shuffled = steps(model, scene, position[order], velocity[order]).position
    assert torch.allclose(straight, shuffled, atol=1e-6)


def test_a_static_boundary_does_not_tell_how_fast_a_drum_turns():
    model, start = network(), bed(drum())
    assert torch.equal(steps(model, drum(rpm=0.0), *start).velocity, steps(model, drum(rpm=60.0), *start).velocity)


def test_walls_that_move_are_refused_by_key_and_value():
    with pytest.raises(ConfigError, match=r"boundary\.velocity=true: model=xu_shen2022 has a static boundary"):
        build_model(XuShen2022Config(), BoundaryConfig(), drum())
