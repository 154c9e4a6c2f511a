"""The graph network: its edges and wall nodes, what its map does not depend on, and that it learns."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from torch.nn import functional

from gran_bench.compose import checked_config, compose
from gran_bench.config import BoundaryConfig, GnsConfig, SceneConfig, TrainConfig
from gran_bench.config.reading import validate
from gran_bench.dataset import Windows, ensure_cases, split_cases
from gran_bench.dataset.case_file import read_case
from gran_bench.run.experiment import make_model
from gran_bench.scene import Plane, Translation, build_scene
from gran_bench.surrogate.checkpoint import ModelCard, load_model, save_model
from gran_bench.surrogate.graph.edges import frame_graph
from gran_bench.surrogate.graph.messages import EdgeUpdate
from gran_bench.surrogate.graph.network import GraphNetwork
from gran_bench.surrogate.step import build_model, minimum_image
from gran_bench.trainer import Trainer

D, REACH = 0.05, 0.075  # m


def drum(count=150, periodic=False, rpm=30.0):
    config = SceneConfig(name="test")
    config.container.diameter, config.container.length = 0.5, 0.4
    config.container.periodic_axis = periodic
    config.filling.count = count
    return build_scene(config).at_speed(rpm)


def bed(scene, seed=0):
    """A dense filling with random velocities, ``(N, 3)`` each."""
    position = torch.from_numpy(scene.fresh_filling(seed).position)
    return position, 0.3 * torch.randn(position.shape, generator=torch.Generator().manual_seed(seed)).double()


def network(scene, **changes) -> GraphNetwork:
    """A small network in float64 whose every weight and bias is far from zero."""
    torch.manual_seed(0)
    model = build_model(GnsConfig(**({"width": 8} | changes)), BoundaryConfig(kind="own"), scene).double()
    with torch.no_grad():
        for weight in model.parameters():
            weight += 0.2 * torch.randn_like(weight)
    return model


@pytest.mark.parametrize("periodic", [False, True])
def test_edges_join_all_particles_within_reach_either_way_and_are_sorted_by_receiver(periodic):
    scene = replace(drum(periodic=periodic), walls=())
    position, velocity = bed(scene)
    graph = frame_graph(position, velocity, scene, 1.5, REACH)
    apart = minimum_image((position[None] - position[:, None]).reshape(-1, 3), scene.period)
    near = (apart.norm(dim=1) < REACH).reshape(len(position), -1) & ~torch.eye(len(position), dtype=bool)
    assert torch.equal(torch.nonzero(near), torch.stack((graph.receiver, graph.sender), dim=1)[_order(graph)])
    assert (graph.receiver.diff() >= 0).all()
    across = (position[graph.sender] - position[graph.receiver]).abs()[:, 1] > 0.2
    assert across.any() == periodic
    assert torch.allclose(graph.gap, graph.relative.norm(dim=1) - 1.0)
    assert graph.fade[graph.gap < 0.25].eq(1.0).all()
    assert (graph.fade[graph.gap > 0.26] < 1.0).all()


def _order(graph):
    return torch.from_numpy(np.lexsort((graph.sender.numpy(), graph.receiver.numpy())))


def test_a_wall_in_reach_is_a_node_with_its_normal_and_the_velocity_of_its_material():
    scene = drum()
    low, far = [0.0, 0.05, -0.25 + 0.6 * D], [0.0, 0.05, 0.0]
    corner = [-0.25 + 0.5 * D, 0.2 - 0.7 * D, 0.0]
    position = torch.tensor([low, far, corner], dtype=torch.float64)
    graph = frame_graph(position, torch.zeros_like(position), scene, 2.0, REACH)
    assert graph.receiver.tolist() == [0, 2, 2]  # the corner sees the barrel and an end cap
    assert graph.sender.tolist() == [3, 4, 5]
    expected = torch.tensor([[0.0, 0.0, -0.6], [-0.5, 0.0, 0.0], [0.0, 0.7, 0.0]], dtype=torch.float64)
    assert torch.allclose(graph.relative, expected)
    assert torch.allclose(graph.gap, torch.tensor([0.1, 0.0, 0.2], dtype=torch.float64))
    assert torch.allclose(graph.normal, -functional.normalize(expected))
    omega = np.pi  # rad/s about +y: ω × x
    assert torch.allclose(graph.velocity[0], torch.tensor([-0.25 * omega, 0.0, 0.0], dtype=torch.float64))
    assert torch.allclose(graph.velocity[1], torch.tensor([0.0, 0.0, 0.25 * omega], dtype=torch.float64))


def test_a_sphere_beside_a_moving_wall_gets_the_input_of_one_beside_any_wall_of_that_pace():
    """A belt and a turning drum, where their materials move alike: the sphere is answered alike."""
    drum_scene = drum()
    model = network(drum_scene)
    pace = (-0.25 * np.pi, 0.0, 0.0)
    belt = Plane((0.0, 0.0, -0.25), (0.0, 0.0, 1.0), motion=Translation((0.0, 1.0), (pace, pace)))
    position = torch.tensor([[0.0, 0.05, -0.25 + 0.48 * D]], dtype=torch.float64)
    velocity = torch.tensor([[0.3, -0.1, 0.2]], dtype=torch.float64)

    def answer(scene):
        return model.acceleration(position, velocity, scene, 2.0)

    on_belt = answer(replace(drum_scene, walls=(belt,), drum_radius=None))
    at_rest = replace(belt, motion=None, turns=False)
    assert torch.allclose(answer(drum_scene), on_belt, rtol=1e-9)
    assert not torch.allclose(answer(replace(drum_scene, walls=(at_rest,), drum_radius=None)), on_belt, rtol=1e-3)
    assert answer(replace(drum_scene, walls=(), drum_radius=None)).eq(0.0).all()


def test_the_split_first_layer_is_the_perceptron_of_edge_sender_and_receiver():
    torch.manual_seed(0)
    scene = drum()
    position, velocity = bed(scene)
    graph, update = frame_graph(position, velocity, scene, 1.5, REACH), EdgeUpdate(8, 2).double()
    edge, particle, wall = (
        torch.randn(len(rows), 8, dtype=torch.float64) for rows in (graph.gap, position, graph.normal)
    )
    after, summed = update(edge, particle, wall, graph)
    nodes = torch.cat((particle, wall))
    seen = torch.cat((edge, nodes[graph.sender], nodes[graph.receiver]), dim=1)
    message = update.norm(update.rest(update.first(seen)))
    assert torch.allclose(after, edge + message)
    for i in (0, 70, 149):
        mine = graph.receiver == i
        assert mine.any()
        assert torch.allclose(summed[i], (graph.fade[mine, None] * message[mine]).sum(dim=0))


@pytest.mark.parametrize("periodic", [False, True])
def test_other_numbers_of_the_spheres_change_nothing(periodic):
    scene = drum(periodic=periodic)
    position, velocity = bed(scene)
    model, order = network(scene), torch.randperm(len(position), generator=torch.Generator().manual_seed(1))
    plain = model.acceleration(position, velocity, scene, 1.5)
    turned = model.acceleration(position[order], velocity[order], scene, 1.5)
    assert plain.abs().max() > 0.1
    assert torch.allclose(turned, plain[order], rtol=1e-9, atol=1e-9)


def test_the_map_moves_with_spheres_and_walls():
    shift = np.array([3.0, -1.0, 2.0])
    floor = Plane((0.0, 0.0, -0.13), (0.0, 0.0, 1.0), turns=False)
    scene = replace(drum(), walls=(floor,), drum_radius=None)
    there = replace(scene, walls=(replace(floor, point=tuple(np.array(floor.point) + shift)),))
    position, velocity = bed(drum())
    model = network(scene)
    here = model.acceleration(position, velocity, scene, 1.5)
    assert len(frame_graph(position, velocity, scene, 1.5, REACH).normal) > 5
    assert torch.allclose(model.acceleration(position + torch.from_numpy(shift), velocity, there, 1.5), here, rtol=1e-6)


def test_a_period_has_no_seam():
    scene = drum(periodic=True)
    position, velocity = bed(scene)
    model, half = network(scene), torch.tensor([0.0, 0.5 * scene.period, 0.0], dtype=torch.float64)
    there = minimum_image(position + half, scene.period)
    here = model.acceleration(position, velocity, scene, 1.5)
    assert torch.allclose(model.acceleration(there, velocity, scene, 1.5), here, rtol=1e-6, atol=1e-9)


def test_an_edge_lets_go_smoothly_at_its_reach():
    scene = replace(drum(), walls=(), drum_radius=None)
    model = network(scene)
    third = torch.tensor([0.0, 0.99 * D, 0.0], dtype=torch.float64)  # in touch with the first throughout

    def pushed(distance):
        position = torch.stack((torch.zeros(3).double(), torch.tensor([distance, 0.0, 0.0]).double(), third))
        return model.acceleration(position, torch.ones_like(position), scene, 1.5)

    steps = [(pushed(REACH * (1 - e)) - pushed(REACH * (1 + e))).norm().item() for e in (1e-2, 1e-3, 1e-4)]
    assert steps[0] > 0
    assert steps[1] < 0.05 * steps[0]
    assert steps[2] < 0.05 * steps[1]


def test_float64_gradients_are_exact_in_positions_velocities_and_weights():
    scene = drum(count=6)
    position = (0.06 * torch.rand(6, 3, generator=torch.Generator().manual_seed(2))).double()
    position = position + torch.tensor([0.0, 0.1, -0.26], dtype=torch.float64)
    velocity = torch.randn(6, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    model = network(scene, width=4, message_steps=2)
    assert len(frame_graph(position, velocity, scene, 1.5, REACH).normal) > 2
    weights = {name: weight for name, weight in model.named_parameters() if name.startswith("edge_updates.0")}

    def acceleration(position, velocity, *values):
        changed = dict(zip(weights, values, strict=True))
        # functional_call runs forward(); the acceleration is what is differentiated.
        state = model.begin(scene, position, velocity)
        return torch.func.functional_call(model, changed, (state, scene, 1.5)).velocity

    inputs = (position.requires_grad_(), velocity.requires_grad_(), *weights.values())
    assert torch.autograd.gradcheck(acceleration, inputs, atol=1e-4)


def test_one_and_two_threads_give_the_same_bits():
    scene = drum(count=300)
    position, velocity = (values.float() for values in bed(scene))
    model, before, found = network(scene, width=64).float(), torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(model.acceleration(position, velocity, scene, 1.5))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*found)


TINY = [
    *("+experiment=smoke", "model=gns", "device=cpu", "threads=1", "scene.container.diameter=0.4"),
    *("scene.container.length=0.3", "scene.container.periodic_axis=true", "scene.filling.count=40"),
    *("scene.start_time=0.4", "scene.end_time=0.8", "scene.rotation.times=[0.4]", "dem.threads=1"),
    *("dataset.training_speeds_rpm=[30]", "judge.speeds_rpm=[]", "tracking.enabled=false", "model.width=16"),
    *("trainer.steps=60", "trainer.log_every=1", "optim.accumulate=2", "optim.warmup_steps=0"),
]


def test_a_tiny_training_lowers_its_loss_and_its_file_gives_the_same_model(tmp_path):
    config = checked_config(compose("train", TINY), TrainConfig)
    validate(config)
    scene, losses = build_scene(config.scene), []
    specs = split_cases(scene, config.dem, config.dataset).training
    ensure_cases(specs, tmp_path, workers=1, progress=False)
    windows = Windows([read_case(spec.path(tmp_path)) for spec in specs], config.seed)
    torch.manual_seed(0)
    model = make_model(config, scene)
    Trainer(model, windows, config, tmp_path, lambda metrics, step: losses.append(metrics["loss"])).run(False)
    assert np.mean(losses[-10:]) < 0.8 * np.mean(losses[:10])

    card = ModelCard(*(asdict(part) for part in (config.model, config.boundary, config.scene)), {})
    save_model(tmp_path / "gns.pt", model.state_dict(), card)
    again, _ = load_model(tmp_path / "gns.pt")
    assert isinstance(again, GraphNetwork)
    start = windows.window(0, 5, 1)
    position, velocity = torch.from_numpy(start.position[0]), torch.from_numpy(start.velocity[0])
    with torch.no_grad():
        one, other = (m.acceleration(position, velocity, scene, start.time) for m in (model, again))
    assert torch.equal(one, other)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("model.radius_diameters=1", ["model.radius_diameters=1 ", "at least 1.1 diameters"]),
        ("model.radius_m=0.16", ["model.radius_m=0.16 ", "at most 0.15 m"]),
        ("model.message_steps=0", ["model.message_steps=0"]),
        ("model.update=euler", ["model.update=euler", "mean or trapezoid"]),
        ("loss=with_momentum", ["loss.momentum=0.1", "model=gns", "loss.momentum=0", "model=radial"]),
        ("loss=with_spin", ["loss.spin=", "model=gns", "loss.spin=0"]),
        ("boundary=spheres", ["boundary.kind=spheres", "model=gns", "boundary=contact"]),
    ],
)
def test_what_does_not_fit_is_refused_in_a_line(change, words):
    with pytest.raises(ValueError, match=r"^[^\n]+$") as error:
        validate(checked_config(compose("train", [*TINY, change]), TrainConfig))
    assert all(word in str(error.value) for word in words), str(error.value)
