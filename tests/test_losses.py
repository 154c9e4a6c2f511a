"""Loss terms: dimensionless, worth what is stated, zero for a perfect prediction, with gradients that are true."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gran_bench.config import LossConfig, SceneConfig
from gran_bench.config.choices import loss_terms
from gran_bench.config.registry import LOSS_TERMS
from gran_bench.losses import FrameAhead, LossError, Target, WindowLoss, contact_overlaps, frame_weights
from gran_bench.losses.terms import HUBER_WIDTH
from gran_bench.scene import Cone, Disc, Outlet, Plane, Scene, Translation, build_scene
from gran_bench.surrogate.step import FrameState

SCENE = build_scene(SceneConfig(name="drum"))
PERIODIC = replace(SCENE, periodic_axis=True, length=0.2)
START = 1.5  # s, of the frame that is looked at
D, DT, G = SCENE.filling.diameter, SCENE.frame_interval, 9.81


def vectors(seed: int, count: int = 50, size: float = 0.2) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(-size, size, (count, 3)))


def perfect(scene: Scene = SCENE) -> FrameAhead:
    """A frame that is predicted as it is, by a model whose pairs push each other apart."""
    position, velocity, spin, earlier, push = (vectors(seed) for seed in range(5))
    push[25:] = -push[:25]
    target = Target(position.clone(), velocity.clone(), spin.clone(), earlier, 1.0)
    before = FrameState(position - DT * velocity, earlier.clone(), spin.clone())
    return FrameAhead(before, FrameState(position, velocity, spin, pair_acceleration=push), target, scene, START)


def moved(ahead: FrameAhead, **fields: torch.Tensor) -> FrameAhead:
    """The same with parts of the prediction replaced."""
    return replace(ahead, predicted=replace(ahead.predicted, **fields))


def value(name: str, ahead: FrameAhead) -> float:
    return LOSS_TERMS[name](ahead).item()


def test_every_key_of_the_config_that_is_a_weight_has_a_term_and_no_term_lacks_a_key():
    assert sorted(loss_terms()) == sorted(LOSS_TERMS)


@pytest.mark.parametrize("scene", [SCENE, PERIODIC], ids=["drum", "periodic"])
@pytest.mark.parametrize("name", LOSS_TERMS)
def test_a_perfect_prediction_costs_nothing(name, scene):
    assert value(name, perfect(scene)) == pytest.approx(0.0, abs=1e-9)


# ---- what an error is worth ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "field", "error", "expected"),
    [
        ("position_l2", "position", D, 1.0),
        ("position_mse", "position", 2 * D, 4.0),
        ("huber", "position", D, 1.0 - 0.005),
        ("huber", "position", 0.004 * D, 0.004**2 / 0.02),
        ("huber", "position", HUBER_WIDTH * D, 0.5 * HUBER_WIDTH),
        ("cell_displacement", "position", D, 1.0),
        ("center_of_mass", "position", 0.3 * D, 0.3),
        ("velocity", "velocity", D / DT, 1.0),
        ("acceleration", "velocity", D / DT, 1.0),  # gained in one frame: a = d/Δt²
        ("spin", "angular_velocity", 2.0 / DT, 1.0),  # ω r Δt / d = 1 at ω = 2/Δt, since r = d/2
    ],
)
def test_an_error_of_one_diameter_counts_as_stated(name, field, error, expected):
    ahead = perfect()
    shift = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64) * error
    wrong = moved(ahead, **{field: getattr(ahead.predicted, field) + shift})
    assert value(name, wrong) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("position_l2", 0.04),
        ("position_mse", 0.0016),
        ("huber", 0.035),
        ("cell_displacement", 0.04),
        ("center_of_mass", 0.04),
    ],
)
def test_position_error_across_a_periodic_edge_is_the_short_way(name, expected):
    here, there = (torch.tensor([[0.0, y, 0.0]], dtype=torch.float64) for y in (0.099, -0.099))
    target = Target(there, there, there, there)
    ahead = FrameAhead(FrameState(here, here), FrameState(here, here), target, PERIODIC, START)
    assert value(name, ahead) == pytest.approx(expected, rel=1e-6)


def test_an_acceleration_is_not_blamed_for_the_velocity_that_it_started_from():
    ahead = perfect()
    late = torch.tensor([0.0, 0.0, 0.5 * D / DT], dtype=torch.float64)  # inherited, or put there as noise
    inherited = replace(ahead, before=replace(ahead.before, velocity=ahead.before.velocity + late))
    inherited = moved(inherited, velocity=ahead.predicted.velocity + late)
    assert value("acceleration", inherited) == pytest.approx(0.0, abs=1e-9)
    assert value("velocity", inherited) == pytest.approx(0.5)
    mended = replace(inherited, predicted=ahead.predicted)
    assert value("acceleration", mended) == pytest.approx(0.5)


def test_the_energy_counts_translation_and_rotation_against_the_dems_or_the_floor():
    still, fast = torch.zeros(2, 3, dtype=torch.float64), torch.zeros(2, 3, dtype=torch.float64)
    fast[0, 0] = 2.0  # m/s: one of two spheres, so 1 m²/s² a sphere and its mass
    turning = torch.zeros_like(still)
    turning[1, 1] = 40.0  # rad/s: r ω = 1 m/s, so ½ 0.4 · 1 / 2 = 0.1 m²/s² a sphere
    target = Target(still, fast, turning, still)

    def cost(velocity: torch.Tensor, spin: torch.Tensor | None, against: Target = target) -> float:
        return value(
            "energy", FrameAhead(FrameState(still, still), FrameState(still, velocity, spin), against, SCENE, START)
        )

    assert cost(still, still) == pytest.approx(1.0)
    assert cost(fast, still) == pytest.approx(0.1 / 1.1)
    assert cost(1.5 * fast, turning) == pytest.approx(1.25 / 1.1)
    assert cost(fast, None) == 0.0  # a model without spin is held to translation alone
    assert cost(1.5 * fast, None) == pytest.approx(1.25)
    # A bed at rest has no energy: m g d a sphere is what the error is measured in.
    assert cost(fast, None, Target(still, still, still, still)) == pytest.approx(1.0 / (G * D))


def test_speeds_are_compared_as_a_distribution_whoever_has_them():
    still = torch.zeros(3, 3, dtype=torch.float64)

    def at(*speeds: float) -> torch.Tensor:
        direction = torch.tensor([[0.6, 0.0, 0.8], [0.0, -1.0, 0.0], [0.0, 0.6, -0.8]], dtype=torch.float64)
        return direction * torch.tensor(speeds, dtype=torch.float64)[:, None]

    target = Target(still, at(1.0, 2.0, 3.0), still, still)

    def cost(velocity: torch.Tensor) -> float:
        return value(
            "speed_distribution",
            FrameAhead(FrameState(still, still), FrameState(still, velocity), target, SCENE, START),
        )

    assert cost(at(3.0, 1.0, 2.0)) == pytest.approx(0.0, abs=1e-9)
    # Sorted: 0.5, 2, 4 against 1, 2, 3.
    assert cost(at(4.0, 0.5, 2.0)) == pytest.approx(1.5 / 3.0 / math.sqrt(G * D))


def test_momentum_is_the_share_of_the_forces_that_nobody_answers():
    ahead = perfect()

    def cost(*accelerations: tuple[float, float, float]) -> float:
        return value("momentum", moved(ahead, pair_acceleration=torch.tensor(accelerations, dtype=torch.float64)))

    assert cost((3.0, 0.0, 0.0), (-3.0, 0.0, 0.0)) == pytest.approx(0.0, abs=1e-12)
    assert cost((3.0, 0.0, 0.0), (-1.0, 0.0, 0.0)) == pytest.approx(0.5)
    assert cost((3.0, 0.0, 0.0), (0.0, 4.0, 0.0)) == pytest.approx(5.0 / 7.0)
    assert cost((0.0, 2.0, 0.0), (0.0, 0.5, 0.0)) == pytest.approx(1.0)
    assert cost((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) == 0.0  # nobody touches anybody


def test_errors_that_cancel_in_the_mean_leave_the_flow_and_the_centre_of_mass_right():
    zeros = torch.zeros(3, 3)
    target = Target(torch.tensor([[0.02, 0.0, 0.02], [0.07, 0.4, 0.07], [0.13, 0.0, 0.02]]), zeros, zeros, zeros)
    error = torch.tensor([[0.001, 0.0, 0.0], [-0.001, 0.0, 0.0], [0.0, 0.0, 0.003]])
    ahead = FrameAhead(FrameState(zeros, zeros), FrameState(target.position + error, zeros), target, SCENE, START)
    # Only the sphere in the neighbouring cell is left: 3 mm, one of three spheres.
    assert value("cell_displacement", ahead) == pytest.approx(0.001 / D, rel=1e-4)
    assert value("center_of_mass", ahead) == pytest.approx(0.001 / D, rel=1e-4)


# ---- overlaps --------------------------------------------------------------------------------------------


def at_positions(position: torch.Tensor, mean_overlap: float = 0.0, scene: Scene = SCENE) -> FrameAhead:
    zeros = torch.zeros_like(position)
    target = Target(position.detach(), zeros, zeros, zeros, mean_overlap)
    return FrameAhead(FrameState(position, zeros), FrameState(position, zeros), target, scene, START)


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
    assert contact_overlaps(position, SCENE, START).tolist() == pytest.approx([0.1 * D, 0.002, 0.003], rel=1e-9)


def test_overlaps_reach_across_a_periodic_edge():
    position = torch.tensor([[0.0, 0.095, 0.0], [0.0, -0.06, 0.0]], dtype=torch.float64)  # 45 mm apart the short way
    assert value("overlap", at_positions(position, scene=PERIODIC)) == pytest.approx(0.1 / 2, rel=1e-9)


def test_only_overlap_deeper_than_the_dems_mean_costs_contact_by_contact():
    # A pair 0.1 d deep and a pair 0.01 d deep: four spheres, of which the shallow two cannot pay for the deep.
    position = torch.zeros(4, 3, dtype=torch.float64)
    position[:, 0] = torch.tensor([-4.0, -3.1, 2.0, 2.99], dtype=torch.float64) * D
    assert value("overlap", at_positions(position, 0.1 * D)) == pytest.approx(0.0, abs=1e-9)
    assert value("overlap", at_positions(position, 0.055 * D)) == pytest.approx(0.045 / 4, rel=1e-9)
    assert value("overlap", at_positions(position)) == pytest.approx(0.11 / 4, rel=1e-9)


def test_a_wall_is_a_contact_too():
    position = torch.tensor([[0.0, 0.0, -0.475 - 0.002]], dtype=torch.float64)  # 2 mm into the cylinder
    assert value("overlap", at_positions(position, 0.0005)) == pytest.approx(0.0015 / D, rel=1e-9)


def test_overlaps_know_every_wall_where_it_is_when_the_frame_ends():
    lid = Disc((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.2, turns=False, opens=2.0)
    cone = Cone((0.0, 0.0, -0.3), (0.0, 0.0, 1.0), 0.0, 0.3, 0.3, turns=False)
    piston = Plane((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), motion=Translation((1.5,), ((-0.2, 0.0, 0.0),)))
    scene = replace(SCENE, walls=(lid, cone, piston), drum_radius=None, frame_interval=0.01)
    r = 0.5 * D
    position = torch.tensor(
        [
            [0.0, 0.0, r - 0.001],  # 1 mm into the lid
            [0.5, 0.0, 0.9],  # far from all
            [0.05, 0.0, -0.25 + math.sqrt(2.0) * (r - 0.003)],  # 3 mm into the cone
            [0.998 - r + 0.004, 0.0, 0.0],  # 4 mm into the piston, which has moved 2 mm in this frame
        ],
        dtype=torch.float64,
    )
    assert contact_overlaps(position, scene, START).tolist() == pytest.approx([0.001, 0.003, 0.004], rel=1e-6)
    assert contact_overlaps(position[:1], scene, 1.99).tolist() == []  # gone at 2 s


def test_spheres_beyond_an_outlet_touch_nothing():
    scene = replace(SCENE, walls=(), outlet=Outlet((0.0, 0.0, -0.1), (0.0, 0.0, 1.0)))
    position = torch.tensor([[0.0, 0.0, -0.11], [0.0, 0.0, -0.12], [0.0, 0.0, 0.0]], dtype=torch.float64)
    assert contact_overlaps(position, scene, START).tolist() == []


# ---- gradients and failures ------------------------------------------------------------------------------


def with_leaves(ahead: FrameAhead) -> tuple[FrameAhead, list[torch.Tensor]]:
    """The same with a prediction that asks for gradients."""
    state = ahead.predicted
    fields = ("position", "velocity", "angular_velocity", "pair_acceleration")
    leaves = {name: getattr(state, name).clone().requires_grad_(True) for name in fields}
    return moved(ahead, **leaves), list(leaves.values())


@pytest.mark.parametrize("pushes", ["balanced", "none"])
@pytest.mark.parametrize("name", LOSS_TERMS)
def test_gradients_are_finite_even_at_zero_error(name, pushes):
    ahead = perfect()
    if pushes == "none":
        ahead = moved(ahead, pair_acceleration=torch.zeros_like(ahead.predicted.position))
    ahead, leaves = with_leaves(ahead)
    LOSS_TERMS[name](ahead).backward()
    assert all(leaf.grad is None or torch.isfinite(leaf.grad).all() for leaf in leaves)
    assert any(leaf.grad is not None for leaf in leaves)


@pytest.mark.parametrize("scene", [SCENE, PERIODIC], ids=["drum", "periodic"])
@pytest.mark.parametrize("name", LOSS_TERMS)
def test_gradients_are_those_of_finite_differences(name, scene):
    ahead = perfect(scene)
    state, far = ahead.predicted, {"huber": 2e-4}.get(name, 0.005)
    ahead = moved(
        ahead,
        position=state.position + vectors(10, size=far),
        velocity=state.velocity + vectors(11),
        angular_velocity=state.angular_velocity + vectors(12, size=20.0),
        pair_acceleration=state.pair_acceleration + vectors(13),
    )
    ahead = replace(ahead, target=replace(ahead.target, mean_overlap=0.001))
    ahead, leaves = with_leaves(ahead)

    def of(*parts: torch.Tensor) -> torch.Tensor:
        names = ("position", "velocity", "angular_velocity", "pair_acceleration")
        return LOSS_TERMS[name](moved(ahead, **dict(zip(names, parts, strict=True))))

    assert of(*leaves).item() > 1e-4
    gradients = torch.autograd.grad(of(*leaves), leaves, allow_unused=True)
    assert any(gradient is not None and gradient.abs().max() > 0 for gradient in gradients)
    assert torch.autograd.gradcheck(of, leaves, eps=1e-8, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("broken", [np.nan, np.inf])
@pytest.mark.parametrize("name", LOSS_TERMS)
def test_what_is_not_finite_is_not_finite_in_the_loss_and_no_crash(name, broken):
    ahead = perfect()
    for part in ("position", "velocity", "angular_velocity", "pair_acceleration"):
        getattr(ahead.predicted, part)[3, 1] = broken
    ahead, _ = with_leaves(ahead)
    found = LOSS_TERMS[name](ahead)
    assert not torch.isfinite(found)
    found.backward()  # attached to the graph


# ---- their weighted sum ----------------------------------------------------------------------------------


def test_frame_weights():
    assert frame_weights("uniform", 3) == [1, 1, 1]
    assert frame_weights("discounted", 3, 0.5) == [1, 0.5, 0.25]
    assert frame_weights("inverse", 4) == [1, 1 / 2, 1 / 3, 1 / 4]
    assert frame_weights("rising", 4) == [0.25, 0.5, 0.75, 1]
    with pytest.raises(LossError, match=r"frame_weights='linear'.*uniform"):
        frame_weights("linear", 3)


def test_the_spin_has_frame_weights_of_its_own():
    loss = WindowLoss(LossConfig(position_l2=2.0, spin=0.5, frame_weights="uniform", spin_frame_weights="inverse"))
    ahead = perfect()
    wrong = moved(ahead, angular_velocity=ahead.predicted.angular_velocity + 1.0)
    first, second = (loss.terms(wrong, frame, 3) for frame in (1, 2))
    assert second["spin"].item() == pytest.approx(0.5 * first["spin"].item())
    assert second["position_l2"].item() == first["position_l2"].item()


def test_terms_are_weighted_each_by_its_own_weight_and_the_frames():
    ahead = perfect()
    shift = torch.tensor([0.0, 0.0, 0.1 * D], dtype=torch.float64)
    wrong = moved(ahead, position=ahead.predicted.position + shift)
    loss = WindowLoss(LossConfig(position_l2=2.0, center_of_mass=3.0, frame_weights="inverse"))
    shares = {name: share.item() for name, share in loss.terms(wrong, 2, 3).items()}
    assert shares == pytest.approx({"position_l2": 0.1, "center_of_mass": 0.15})


def test_a_term_of_weight_zero_is_not_computed():
    ahead = moved(perfect(), angular_velocity=None, pair_acceleration=None)
    loss = WindowLoss(LossConfig(position_l2=1.0, spin=0.0))
    assert list(loss.terms(ahead, 1, 1)) == ["position_l2"]


def test_a_loss_of_nothing_and_terms_without_what_they_look_at_are_refused():
    with pytest.raises(LossError, match="no term with a positive weight"):
        WindowLoss(LossConfig(position_l2=0.0))
    ahead = moved(perfect(replace(SCENE, gravity=(0.0, 0.0, 0.0))), angular_velocity=None, pair_acceleration=None)
    for name in ("spin", "momentum", "energy", "speed_distribution"):
        with pytest.raises(LossError, match=rf"loss\.{name}=0"):
            LOSS_TERMS[name](ahead)
