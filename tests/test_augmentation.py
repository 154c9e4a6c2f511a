"""Turned windows: the same physics from another side, for a model that has no side of its own."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from trainings import config

from gran_bench.config import (
    BoundaryConfig,
    CconvModelConfig,
    ContactModelConfig,
    LossConfig,
    RolloutConfig,
    SceneConfig,
)
from gran_bench.dataset import Windows
from gran_bench.run.pace import NO_CONTACT, touching_bed
from gran_bench.scene import Scene, Spin, Translation, build_scene
from gran_bench.state import Trajectory
from gran_bench.surrogate.step import FrameState, Surrogate, build_model
from gran_bench.surrogate.walls import closest_point, frame_walls, wall_velocity
from gran_bench.trainer import Trainer
from gran_bench.trainer.augmentation import Turn

DRUM = SceneConfig(name="drum")
DRUM.container.diameter, DRUM.container.length, DRUM.filling.count = 0.4, 0.3, 60


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build_scene(DRUM).at_speed(30.0)


@pytest.fixture
def turn() -> Turn:
    return Turn.drawn(np.random.default_rng(3), 0.0)


def moving_bed(scene: Scene, seed: int = 0) -> FrameState:
    """Spheres that touch, with velocities and spins."""
    bed, rng = touching_bed(scene), np.random.default_rng(seed)
    velocity, spin = rng.normal(size=(2, bed.count, 3)) * [[[0.5]], [[10.0]]]
    return FrameState(*(torch.from_numpy(array) for array in (bed.position, velocity, spin)))


def test_a_turn_is_a_rotation_and_any_is_as_likely():
    rng = np.random.default_rng(0)
    turns = np.array([Turn.drawn(rng, 0.0).matrix for _ in range(3000)])
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turns.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turns), 1.0)
    # Of an even density, every direction goes everywhere: means 0, mean squares 1/3; the angle's mean cosine is −1/2.
    assert np.abs(turns.mean(axis=0)).max() < 0.04
    np.testing.assert_allclose((turns**2).mean(axis=0), 1 / 3, atol=0.03)
    assert np.mean((np.trace(turns, axis1=1, axis2=2) - 1) / 2) == pytest.approx(-0.5, abs=0.04)


def test_where_y_is_periodic_it_stays_where_it_is():
    rng = np.random.default_rng(0)
    turns = np.array([Turn.drawn(rng, 0.2).matrix for _ in range(500)])
    np.testing.assert_allclose(turns[:, 1], [[0.0, 1.0, 0.0]] * 500, atol=1e-12)
    assert np.abs(turns[:, 0, 0].mean()) < 0.1


def test_walls_their_motion_and_gravity_turn_alike(scene: Scene, turn: Turn):
    shaken = Translation(times=(0.0,), velocities=((0.1, 0.2, 0.3),))
    spun = Spin(times=(0.0,), speeds_rpm=(20.0,), axis=(0.0, 1.0, 0.0), center=(0.0, 0.0, 0.0))
    first, second, third = scene.walls
    scene = replace(scene, walls=(first, replace(second, motion=shaken), replace(third, motion=spun)))
    turned, matrix = turn.scene(scene), torch.from_numpy(turn.matrix)
    points = torch.from_numpy(np.random.default_rng(1).uniform(-0.1, 0.1, (20, 3)))
    here, there = (frame_walls(one, 2.0) for one in (scene, turned))
    for k in range(3):
        distance, toward = closest_point(here.after[k], points)
        its_distance, its_toward = closest_point(there.after[k], points @ matrix.T)
        torch.testing.assert_close(its_distance, distance)
        torch.testing.assert_close(its_toward, toward @ matrix.T)
        moving = wall_velocity(scene.walls[k], points, scene, 2.0)
        assert moving.abs().max() > 0.01
        torch.testing.assert_close(wall_velocity(turned.walls[k], points @ matrix.T, turned, 2.0), moving @ matrix.T)
    np.testing.assert_allclose(turned.gravity, turn.matrix @ scene.gravity)
    assert (turned.filling, turned.drum_radius) == (scene.filling, scene.drum_radius)


def test_back_undoes_a_turn(scene: Scene, turn: Turn):
    state = moving_bed(scene)
    again = turn.back(turn.state(state))
    torch.testing.assert_close(again.position, state.position)
    torch.testing.assert_close(again.angular_velocity, state.angular_velocity)


def step_and_turn(model: Surrogate, scene: Scene, turn: Turn) -> tuple[torch.Tensor, torch.Tensor]:
    """Displacements by contacts of a frame, predicted and then turned, and the other way round."""
    state, away = moving_bed(scene), scene.frame_interval
    free = state.position + away * (state.velocity + away * state.velocity.new_tensor(scene.gravity))
    with torch.no_grad():
        after = model.double()(state, scene, 2.0)
        turned = turn.back(model(turn.state(state), turn.scene(scene), 2.0))
    return after.position - free, turned.position - free


def test_a_model_without_directions_predicts_the_turned_frame_of_a_turned_window(scene: Scene, turn: Turn):
    torch.manual_seed(0)
    model = build_model(ContactModelConfig(backend="torch"), BoundaryConfig(kind="own"), scene)
    plain, turned = step_and_turn(model, scene, turn)
    assert plain.abs().max() > 1e-4
    torch.testing.assert_close(turned, plain, rtol=1e-6, atol=1e-9)


def test_to_a_model_with_directions_a_turned_window_is_a_new_one(scene: Scene, turn: Turn):
    torch.manual_seed(0)
    model = build_model(CconvModelConfig(width=8, layers=1, backend="torch"), BoundaryConfig(), scene)
    plain, turned = step_and_turn(model, scene, turn)
    assert (turned - plain).norm() > 0.1 * plain.norm()


def test_the_loss_of_a_model_without_directions_does_not_see_the_turn(scene: Scene, tmp_path: Path):
    """Terms that know an axis included: the prediction is turned back before the loss is taken."""
    bed = moving_bed(scene)
    frames = np.stack([bed.position.numpy() + 0.01 * k * bed.velocity.numpy() for k in range(4)]).astype(np.float32)
    speeds, nothing = np.repeat([bed.velocity.numpy()], 4, 0).astype(np.float32), dict.fromkeys(NO_CONTACT, np.zeros(4))
    motion = Trajectory(1.5 + 0.01 * np.arange(4), frames, speeds, 0 * speeds, np.full(60, 0.025), diagnostics=nothing)
    windows = Windows([_Case(scene, motion)])
    model = build_model(ContactModelConfig(backend="torch"), BoundaryConfig(kind="own"), scene).double()
    losses = []
    for rotation in (False, True):
        setup = config(
            rollout=RolloutConfig(frames=2, rotation=rotation), loss=LossConfig(cell_displacement=1.0, spin=1.0)
        )
        losses.append(Trainer(model, windows, setup, tmp_path)._window_gradients(model, 1, 2))
    assert losses[1][1] == pytest.approx(losses[0][1], rel=1e-6)
    for plain, turned in zip(losses[0][2], losses[1][2], strict=True):
        torch.testing.assert_close(turned, plain, rtol=1e-4, atol=1e-7)


class _Case:
    """As much of a case as windows read."""

    path, attributes = Path("made-here"), {}

    def __init__(self, scene: Scene, trajectory: Trajectory) -> None:
        self.scene, self.trajectory = scene, trajectory
