"""Loss terms: dimensionless means over particles, zero for a perfect prediction."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gran_bench.config import LossConfig, SceneConfig
from gran_bench.losses import TERMS, LossError, Target, WindowLoss, contact_overlaps, frame_weights
from gran_bench.scene import build_scene
from gran_bench.surrogate.step import FrameState

SCENE = build_scene(SceneConfig(name="drum"))
D, DT = SCENE.filling.diameter, SCENE.frame_interval


def bed(count: int = 50, seed: int = 0) -> tuple[FrameState, Target]:
    rng = np.random.default_rng(seed)
    position, velocity, spin = (torch.from_numpy(rng.uniform(-0.2, 0.2, (count, 3))) for _ in range(3))
    return FrameState(position, velocity, spin), Target(position.clone(), velocity.clone(), spin.clone(), 1.0)


@pytest.mark.parametrize("name", TERMS)
def test_a_perfect_prediction_costs_nothing(name):
    predicted, target = bed()
    assert TERMS[name](predicted, target, SCENE).item() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("name", "field", "error", "expected"),
    [
        ("position_l2", "position", D, 1.0),
        ("position_mse", "position", 2 * D, 4.0),
        ("cell_displacement", "position", D, 1.0),
        ("velocity", "velocity", D / DT, 1.0),
        ("spin", "angular_velocity", 2.0 / DT, 1.0),  # ω r Δt / d = 1 at ω = 2/Δt, since r = d/2
    ],
)
def test_an_error_of_one_diameter_counts_as_stated(name, field, error, expected):
    predicted, target = bed()
    shift = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64) * error
    setattr(predicted, field, getattr(predicted, field) + shift)
    assert TERMS[name](predicted, target, SCENE).item() == pytest.approx(expected, rel=1e-9)


def test_position_error_across_a_periodic_edge_is_the_short_way():
    scene = replace(SCENE, periodic_axis=True, length=0.2)
    predicted, target = bed(1)
    predicted.position = torch.tensor([[0.0, 0.099, 0.0]], dtype=torch.float64)
    target = replace(target, position=torch.tensor([[0.0, -0.099, 0.0]], dtype=torch.float64))
    assert TERMS["position_l2"](predicted, target, scene).item() == pytest.approx(0.002 / D, rel=1e-6)


def test_errors_that_cancel_within_a_cell_leave_the_flow_right():
    target = Target(torch.tensor([[0.02, 0.0, 0.02], [0.07, 0.4, 0.07], [0.13, 0.0, 0.02]]), *torch.zeros(2, 3, 3))
    error = torch.tensor([[0.001, 0.0, 0.0], [-0.001, 0.0, 0.0], [0.0, 0.0, 0.003]])
    predicted = FrameState(target.position + error, target.velocity, target.angular_velocity)
    # Only the sphere in the neighbouring cell is left: 3 mm, one of three spheres.
    assert TERMS["cell_displacement"](predicted, target, SCENE).item() == pytest.approx(0.001 / D, rel=1e-4)


def test_overlaps_are_those_of_pairs_and_walls():
    r, big_r, half = 0.5 * D, 0.5, 0.5
    position = torch.tensor(
        [
            [0.0, 0.0, 0.0],
            [0.9 * D, 0.0, 0.0],  # 0.1 d into the first
            [0.0, 0.0, -(big_r - r) - 0.002],  # 2 mm into the cylinder
            [0.0, half - r + 0.003, 0.0],  # 3 mm into a cap
        ],
        dtype=torch.float64,
    )
    assert contact_overlaps(position, SCENE).tolist() == pytest.approx([0.1 * D, 0.002, 0.003], rel=1e-9)


def test_only_overlap_deeper_than_the_dems_mean_costs_contact_by_contact():
    # A pair 0.1 d deep and a pair 0.01 d deep: four spheres, of which the shallow two cannot pay for the deep.
    position = torch.zeros(4, 3, dtype=torch.float64)
    position[:, 0] = torch.tensor([-4.0, -3.1, 2.0, 2.99], dtype=torch.float64) * D
    predicted = FrameState(position, torch.zeros_like(position))

    def cost(mean_overlap: float) -> float:
        return TERMS["overlap"](predicted, Target(position, position, position, mean_overlap), SCENE).item()

    assert cost(0.1 * D) == pytest.approx(0.0, abs=1e-9)
    assert cost(0.055 * D) == pytest.approx(0.045 / 4, rel=1e-9)
    assert cost(0.0) == pytest.approx(0.11 / 4, rel=1e-9)


def test_a_wall_is_a_contact_too():
    position = torch.tensor([[0.0, 0.0, -0.475 - 0.002]], dtype=torch.float64)  # 2 mm into the cylinder
    predicted = FrameState(position, torch.zeros_like(position))
    target = Target(position, position, position, mean_overlap=0.0005)
    assert TERMS["overlap"](predicted, target, SCENE).item() == pytest.approx(0.0015 / D, rel=1e-9)


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_overlap_of_a_position_that_is_not_finite_is_not_finite_and_no_crash(broken: float):
    predicted, target = bed()
    predicted.position[3, 1] = broken
    predicted.position.requires_grad_(True)
    found = TERMS["overlap"](predicted, target, SCENE)
    assert torch.isnan(found)
    found.backward()  # attached to the graph, like every other term


@pytest.mark.parametrize("name", TERMS)
def test_gradients_are_finite_even_at_zero_error(name):
    predicted, target = bed()
    leaves = [predicted.position, predicted.velocity, predicted.angular_velocity]
    for leaf in leaves:
        leaf.requires_grad_(True)
    TERMS[name](predicted, target, SCENE).backward()
    assert all(leaf.grad is None or torch.isfinite(leaf.grad).all() for leaf in leaves)


def test_frame_weights():
    assert frame_weights("uniform", 3) == [1, 1, 1]
    assert frame_weights("discounted", 3, 0.5) == [1, 0.5, 0.25]
    assert frame_weights("inverse", 4) == [1, 1 / 2, 1 / 3, 1 / 4]
    assert frame_weights("rising", 4) == [0.25, 0.5, 0.75, 1]
    with pytest.raises(LossError, match=r"frame_weights='linear'.*uniform"):
        frame_weights("linear", 3)


def test_the_spin_has_frame_weights_of_its_own():
    loss = WindowLoss(LossConfig(position_l2=2.0, spin=0.5, frame_weights="uniform", spin_frame_weights="inverse"))
    assert loss.weight_of("position_l2", 2, 3) == 2.0
    assert loss.weight_of("spin", 2, 3) == 0.25


def test_a_term_of_weight_zero_is_not_computed():
    predicted, target = bed()
    predicted.angular_velocity = None
    loss = WindowLoss(LossConfig(position_l2=1.0, spin=0.0))
    assert list(loss.terms(predicted, target, SCENE, 1, 1)) == ["position_l2"]


def test_a_loss_of_nothing_and_a_spin_of_nobody_are_refused():
    with pytest.raises(LossError, match="no term with a positive weight"):
        WindowLoss(LossConfig(position_l2=0.0))
    predicted, target = bed()
    predicted.angular_velocity = None
    with pytest.raises(LossError, match=r"loss\.spin=0"):
        TERMS["spin"](predicted, target, SCENE)
