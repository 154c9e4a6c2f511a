"""Rolling out: every frame kept as the model made it, failures included."""

import numpy as np
import pytest
import torch
from torch import nn

from gran_bench.config import BoundaryConfig, CconvModelConfig, ContactModelConfig, GnsConfig, SceneConfig
from gran_bench.dem.outlet import taking_part
from gran_bench.scene import build_scene
from gran_bench.shipped import shipped_scene
from gran_bench.state import ParticleState
from gran_bench.surrogate.rollout import rollout
from gran_bench.surrogate.step import FrameState, Surrogate, build_model

SCENE = build_scene(SceneConfig(name="drum"))


class Drift(Surrogate):
    """Moves everything along x by 1 mm a frame; breaks at a chosen frame."""

    def __init__(self, breaks_at: int | None = None) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(()))
        self.breaks_at, self.times = breaks_at, []

    def forward(self, state: FrameState, scene, time: float) -> FrameState:
        self.times.append(time)
        position = state.position + self.scale * torch.tensor([1e-3, 0.0, 0.0])
        if len(self.times) == self.breaks_at:
            position = position / 0.0 * 0.0
        return FrameState(position, state.velocity)


def settled(count: int = 5) -> ParticleState:
    zeros = np.zeros((count, 3))
    return ParticleState(zeros, zeros, zeros, np.full(count, 0.025), time=1.5)


def test_the_first_frame_is_the_start_and_the_clock_runs_with_the_walls():
    model = Drift()
    result = rollout(model, SCENE, settled(), frames=4)
    np.testing.assert_allclose(result.trajectory.position[:, 0, 0], [0.0, 1e-3, 2e-3, 3e-3], rtol=1e-6)
    np.testing.assert_allclose(model.times, [1.5, 1.51, 1.52])
    np.testing.assert_allclose(result.trajectory.time, [1.5, 1.51, 1.52, 1.53])
    assert result.failed_frame is None
    assert np.isfinite(result.seconds_per_frame).all()


def test_a_sphere_that_leaves_the_drum_is_not_put_back():
    result = rollout(Drift(), SCENE, settled(), frames=1001)
    assert result.trajectory.position[-1, 0, 0] == pytest.approx(1.0, rel=1e-4)


def test_after_a_frame_that_is_not_finite_everything_is_nan():
    result = rollout(Drift(breaks_at=3), SCENE, settled(), frames=6)
    assert result.failed_frame == 3
    assert np.isfinite(result.trajectory.position[:3]).all()
    assert np.isnan(result.trajectory.position[3:]).all()
    assert np.isnan(result.trajectory.velocity[3:]).all()


def test_a_scene_says_how_many_frames_a_rollout_has():
    assert rollout(Drift(), SCENE, settled()).trajectory.frame_count == SCENE.frame_count == 401


MODELS = {
    "contact": (ContactModelConfig(radius_m=0.024, wall_reach_m=0.004, memory=True), BoundaryConfig(kind="own")),
    "contact, torch": (ContactModelConfig(radius_m=0.024, memory=True, backend="torch"), BoundaryConfig(kind="own")),
    "radial": (CconvModelConfig(name="radial", kernel="radial", width=8, radius_m=0.045), BoundaryConfig()),
    "ccnn": (CconvModelConfig(width=8, radius_m=0.045), BoundaryConfig(kind="analytic")),
    "gns": (GnsConfig(width=8), BoundaryConfig(kind="own")),
}


@pytest.mark.parametrize("name", MODELS)
def test_a_hopper_is_rolled_out_and_whoever_passed_its_outlet_keeps_its_last_state(name):
    scene = shipped_scene("hopper", {"filling.count": 150})
    torch.manual_seed(0)
    model = build_model(*MODELS[name], scene)
    state = scene.fresh_filling(0)
    velocity = np.zeros_like(state.position)
    velocity[:50, 2] = -4.0  # a third of it falls out
    state = ParticleState(state.position, velocity, state.angular_velocity, state.radius, scene.start_time)
    result = rollout(model, scene, state, frames=15)
    assert result.failed_frame is None
    assert result.trajectory.frame_count == 15
    position, velocity = result.trajectory.position, result.trajectory.velocity
    left = np.array([~inside for frame in position if not (inside := taking_part(scene, frame)).all()])
    assert 5 < left[-1].sum() < 150
    first = len(position) - len(left)
    for k in range(len(left) - 1):
        assert np.array_equal(position[first + k + 1][left[k]], position[first + k][left[k]])
        assert np.array_equal(velocity[first + k + 1][left[k]], velocity[first + k][left[k]])
    assert not np.array_equal(position[-1][~left[-2]], position[-2][~left[-2]])


def test_those_who_are_left_move_as_if_the_others_were_not_there():
    scene = shipped_scene("hopper", {"filling.count": 60})
    torch.manual_seed(0)
    model = build_model(*MODELS["contact"], scene)
    start = scene.fresh_filling(0)
    gone = np.arange(60) % 3 == 0
    position = np.where(gone[:, None], (0.0, 0.0, -0.07), start.position)  # in one place, beyond the outlet
    zeros = np.zeros_like(position)
    whole = ParticleState(position, zeros, zeros, start.radius, scene.start_time)
    part = ParticleState(position[~gone], zeros[~gone], zeros[~gone], start.radius[~gone], scene.start_time)
    together, alone = (rollout(model, scene, state, frames=6).trajectory.position for state in (whole, part))
    assert np.array_equal(together[:, ~gone], alone)
    assert np.array_equal(together[-1][gone], together[0][gone])
