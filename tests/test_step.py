"""Gravity → network → Newton, and the two ways to move."""

import math

import pytest
import torch

from gran_bench.config import SceneConfig
from gran_bench.scene import build_scene
from gran_bench.surrogate.step import FrameState, NewtonSurrogate, minimum_image, wrap


class Constant(NewtonSurrogate):
    """A network that always answers 2 m/s² along x, and remembers what it was shown."""

    def acceleration(self, position, velocity, scene, time):
        self.shown = position, velocity, time
        return torch.tensor([2.0, 0.0, 0.0]).expand_as(velocity)


def scene_of(**changes):
    config = SceneConfig(name="test", **changes)
    config.container.periodic_axis = True
    return build_scene(config)


STATE = FrameState(torch.tensor([[0.1, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.5]]))


def test_mean_update_moves_with_the_new_velocity():
    model, scene = Constant("mean"), scene_of()
    after = model(STATE, scene, 1.5)
    position, velocity, time = model.shown
    assert torch.allclose(velocity, torch.tensor([[1.0, 0.0, 0.5 - 0.0981]]))
    assert torch.allclose(position, STATE.position + 0.01 * velocity)
    assert time == 1.5
    assert torch.allclose(after.velocity, torch.tensor([[1.02, 0.0, 0.4019]]))
    assert torch.allclose(after.position, STATE.position + 0.01 * after.velocity)
    assert model.velocity_kind == "mean"


def test_trapezoid_update_moves_with_the_mean_of_both_velocities_and_is_exact_in_free_flight():
    model, scene = Constant("trapezoid"), scene_of(gravity=[0.0, 0.0, -9.81])
    state, steps = STATE, 7
    for k in range(steps):
        state = model(state, scene, 1.5 + 0.01 * k)
    t = steps * scene.frame_interval
    expected = STATE.position + t * STATE.velocity + 0.5 * t**2 * torch.tensor([2.0, 0.0, -9.81])
    assert torch.allclose(state.position, expected, atol=1e-6)
    assert model.velocity_kind == "instantaneous"


def test_without_gravity_the_predictor_is_skipped_with_the_same_result():
    zero = scene_of(gravity=[0.0, 0.0, 0.0])
    after = Constant("mean")(STATE, zero, 1.5)
    added = STATE.velocity + torch.zeros(3) * 0.01 + 0.01 * torch.tensor([2.0, 0.0, 0.0])
    assert not zero.needs.gravity
    assert torch.equal(after.velocity, added)


def test_mean_velocity_starts_from_the_last_displacement_and_settled_states_from_their_own():
    scene = scene_of()
    here, before = torch.tensor([[0.0, -0.499, 0.0]]), torch.tensor([[0.01, 0.499, 0.0]])
    stored = torch.tensor([[0.0, 7.0, 0.0]])
    start = Constant("mean").begin(scene, here, stored, previous_position=before)
    assert torch.allclose(start.velocity, torch.tensor([[-1.0, 0.2, 0.0]]), atol=1e-4)  # through the periodic seam
    assert torch.equal(Constant("mean").begin(scene, here, stored).velocity, stored)
    assert torch.equal(Constant("trapezoid").begin(scene, here, stored, previous_position=before).velocity, stored)


def test_positions_wrap_into_one_period_and_differences_take_the_nearest_image():
    y = torch.tensor([-0.5, 0.5, 0.74, -0.51, 0.3])
    points = torch.stack((torch.full_like(y, 3.0), y, torch.full_like(y, -3.0)), dim=1)
    assert torch.allclose(wrap(points, 1.0)[:, 1], torch.tensor([-0.5, -0.5, -0.26, 0.49, 0.3]))
    assert torch.equal(wrap(points, 1.0)[:, [0, 2]], points[:, [0, 2]])
    assert wrap(points, 0.0) is points
    assert minimum_image(torch.tensor([0.0, 0.9, 0.0]), 1.0)[1] == pytest.approx(-0.1)


def test_a_state_that_is_not_finite_stays_visible():
    broken = FrameState(torch.tensor([[math.nan, 0.0, 0.0]]), torch.zeros(1, 3))
    after = Constant("mean")(broken, scene_of(), 1.5)
    assert after.velocity.isnan().all()
    assert after.position.isnan().all()


def test_an_unknown_update_is_refused_by_name():
    with pytest.raises(ValueError, match=r"model\.update=leapfrog.*mean or trapezoid"):
        Constant("leapfrog")


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"velocity": torch.tensor([[math.nan, 0.0, 0.0]])}, "velocity is not finite"),
        ({"angular_velocity": torch.tensor([[0.0, math.inf, 0.0]])}, "angular_velocity is not finite"),
        ({"velocity": torch.zeros(3)}, r"velocity has shape \(3,\); give begin\(\) one of \(1, 3\)"),
    ],
)
def test_a_start_that_is_no_start_is_refused_by_name(changed, words):
    given = {"position": STATE.position, "velocity": STATE.velocity} | changed
    with pytest.raises(ValueError, match=words):
        Constant("mean").begin(scene_of(), **given)
