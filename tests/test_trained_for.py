"""What a model was trained for: refused where it cannot be right, told and recorded where it extrapolates."""

from dataclasses import replace

import numpy as np
import pytest

from gran_bench.config import BoundaryConfig, ContactModelConfig
from gran_bench.run.summary import rollout_warnings
from gran_bench.scene import Scene
from gran_bench.shipped import shipped_model, shipped_scene
from gran_bench.state import ParticleState
from gran_bench.surrogate.checkpoint import load_model
from gran_bench.surrogate.rollout import rollout, step_frames
from gran_bench.surrogate.step import build_model
from gran_bench.surrogate.trained_for import ModelMismatch

HOME = shipped_scene("drum").at_speed(30.0)


@pytest.fixture(scope="module")
def model():
    return load_model(shipped_model())[0]


def spheres(count: int = 2, radius: float = 0.025, **fields) -> ParticleState:
    """A few spheres in the middle of the drum."""
    zeros = np.zeros((count, 3))
    position = zeros + np.arange(count)[:, None] * (0.0, 0.1 / count, 0.0)
    return ParticleState(position, zeros, zeros, np.full(count, radius), time=1.5, **fields)


def home_bed() -> ParticleState:
    return spheres(HOME.filling.count)


def test_a_rollout_at_home_warns_of_nothing(model):
    assert model.trained_for.warnings(HOME, home_bed()) == ()
    assert model.trained_for.speeds_rpm == (20.0, 25.0, 35.0, 40.0, 50.0, 60.0)


def resized(scene: Scene, diameter: float) -> Scene:
    return replace(scene, filling=replace(scene.filling, diameter=diameter))


@pytest.mark.parametrize(
    ("scene", "state", "words"),
    [
        (HOME, spheres(radius=0.02), ["radius 0.02 to 0.025 m", "radius 0.025 m alone"]),
        (resized(HOME, 0.04), spheres(radius=0.02), ["radius 0.02 m:", "scene.filling.diameter", "train a model"]),
        (HOME, replace(spheres(), radius=np.array([0.025, 0.03])), ["radius 0.025 to 0.03 m"]),
        (replace(HOME, frame_interval=0.005), spheres(), ["scene.frame_interval=0.005 s", "steps 0.01 s"]),
        (replace(HOME, frame_interval=0.02), spheres(), ["scene.frame_interval=0.02 s", "train a model on yours"]),
    ],
)
def test_what_cannot_be_right_is_refused_before_a_frame_is_made(model, scene, state, words):
    with pytest.raises(ModelMismatch) as refused:
        rollout(model, scene, state, frames=2)
    assert all(word in str(refused.value) for word in words)
    assert "\n" not in str(refused.value)


def test_a_model_trained_without_walls_is_refused_where_there_are_some():
    built = build_model(ContactModelConfig(), BoundaryConfig(kind="own"), replace(HOME, walls=()))
    with pytest.raises(ModelMismatch, match="trained without walls"):
        rollout(built, HOME, spheres(), frames=2)


@pytest.mark.parametrize(
    ("scene", "state", "warning"),
    [
        (
            replace(HOME, material=replace(HOME.material, friction=0.5)),
            home_bed(),
            "scene.material.friction=0.5, trained on 0.3",
        ),
        (
            replace(HOME, wall_material=replace(HOME.wall_material, youngs_modulus=1e6)),
            home_bed(),
            "scene.wall_material.youngs_modulus=1e+06, trained on 1e+07",
        ),
        (
            replace(HOME, gravity=(0.0, 0.0, -1.62)),
            home_bed(),
            "scene.gravity=[0.0, 0.0, -1.62], trained on [0.0, 0.0, -9.81]",
        ),
        (
            shipped_scene("drum_slice").at_speed(30.0),
            home_bed(),
            "walls: a periodic drum of diameter 1 m and length 0.2 m; trained in a drum of diameter 1 m and length 1 m",
        ),
        (
            resized(shipped_scene("hopper", {"material.friction": 0.3}), 0.05),
            home_bed(),
            "walls: hopper, 1 × cylinder, 1 × cone, 1 × disc; trained in a drum of diameter 1 m and length 1 m",
        ),
        (HOME.at_speed(70.0), home_bed(), "a drum at 70 rpm, trained at 20 to 60 rpm"),
        (HOME.at_speed(-30.0), home_bed(), "a drum at -30 rpm, trained at 20 to 60 rpm"),
        (shipped_scene("drum_stop"), home_bed(), "a drum at 0 to 30 rpm, trained at 20 to 60 rpm"),
        (HOME, spheres(5), "5 spheres, trained on 3000"),
        (
            HOME,
            replace(home_bed(), material=np.arange(3000).astype(np.uint8) % 2),
            "spheres of 2 materials, which the model cannot tell apart",
        ),
    ],
)
def test_what_is_an_extrapolation_is_told_alone(model, scene, state, warning):
    assert model.trained_for.warnings(scene, state) == (warning,)


def test_a_rollout_carries_its_warnings_to_the_summary(model):
    result = rollout(model, HOME, spheres(), frames=2)
    assert result.warnings == ("2 spheres, trained on 3000",)
    summary = {"rollouts": {"30rpm": {"warnings": list(result.warnings)}, "35rpm": {}}}
    assert rollout_warnings(summary) == ["rollout 30rpm is an extrapolation: 2 spheres, trained on 3000"]


def test_single_frames_are_held_against_the_training_as_rollouts_are(model):
    with pytest.raises(ModelMismatch, match="radius"):
        next(step_frames(model, HOME, spheres(radius=0.02)))
