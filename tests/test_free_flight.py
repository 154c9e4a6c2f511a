"""Where nothing touches and nothing is near, every model moves a sphere ballistically, whatever its weights."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gran_bench.config import BoundaryConfig, CconvModelConfig, ContactModelConfig, GnsConfig
from gran_bench.config.registry import MODELS
from gran_bench.scene import Plane
from gran_bench.shipped import shipped_model, shipped_scene
from gran_bench.state import ParticleState
from gran_bench.surrogate.checkpoint import load_model
from gran_bench.surrogate.rollout import rollout
from gran_bench.surrogate.step import Surrogate, build_model

# A floor that a hundred frames don't reach.
SCENE = replace(
    shipped_scene("drum").at_speed(30.0),
    walls=(Plane((0.0, 0.0, -90.0), (0.0, 0.0, 1.0), turns=False),),
    drum_radius=None,
)
CONTACT = [{}, {"velocity": "instantaneous", "memory": True}]
CONVOLUTION = [{"update": "mean", "backend": "fused"}, {"update": "trapezoid", "backend": "torch"}]
CASES = [
    *(("contact", choices | {"backend": backend}, "own") for choices in CONTACT for backend in ("fused", "torch")),
    *(
        (name, choices, kind)
        for name in ("radial", "ccnn")
        for choices in CONVOLUTION
        for kind in ("spheres", "analytic", "none")
    ),
    ("radial", {"pair_branch": "antisymmetric"}, "spheres"),
    *(("gns", {"update": update}, "own") for update in ("mean", "trapezoid")),
    *(("xu_shen2022", choices, kind) for choices in CONVOLUTION for kind in ("static", "none")),
    *(("lu2021", {"backend": backend}, kind) for backend in ("fused", "torch") for kind in ("static", "none")),
]


def lively(name: str, choices: dict, boundary: str) -> Surrogate:
    """A model of small sizes whose every weight and bias is far from zero."""
    torch.manual_seed(0)
    if name == "contact":
        config = ContactModelConfig(**{"iterations": 3} | choices)
    elif name == "gns":
        config = GnsConfig(**{"width": 8} | choices)
    elif name in ("lu2021", "xu_shen2022"):
        config = MODELS[name].config(**{"width": 8} | choices)
    else:
        kernel = "radial" if name == "radial" else "lattice"
        config = CconvModelConfig(**{"name": name, "kernel": kernel, "width": 8} | choices)
    walls = BoundaryConfig(velocity=False) if boundary == "static" else BoundaryConfig(kind=boundary)
    model = build_model(config, walls, SCENE)
    with torch.no_grad():
        for weight in model.parameters():
            weight += 0.3 * torch.randn_like(weight)
    return model


def flown(model: Surrogate, frames: int = 100) -> None:
    """Hold a lone sphere's flight against x = x₀ + v τ + ½ g τ²."""
    start = ParticleState(
        np.array([[0.01, 0.02, -0.03]]), np.array([[0.5, -0.3, 0.2]]), np.array([[1.0, -2.0, 3.0]]), np.array([0.025]),
        time=1.5,
    )  # fmt: skip
    motion = rollout(model, SCENE, start, frames + 1).trajectory
    step, gravity, n = SCENE.frame_interval, np.array(SCENE.gravity), np.arange(frames + 1)[:, None]
    velocity = start.velocity + gravity * step * n
    # A velocity that is a mean over the frame moves the sphere by itself: v₁ = v₀ + g Δt, x₁ = x₀ + v₁ Δt.
    falls = 0.5 * n * (n + 1) if model.velocity_kind == "mean" else 0.5 * n**2
    position = start.position + start.velocity * step * n + gravity * step**2 * falls
    # In float32: what is left is rounding, 1e-7 of the largest number a frame.
    np.testing.assert_allclose(motion.velocity[:, 0], velocity, atol=2e-5)
    np.testing.assert_allclose(motion.position[:, 0], position, atol=2e-5)
    if model.uses_spin:
        assert (motion.angular_velocity == start.angular_velocity.astype(np.float32)).all()


@pytest.mark.parametrize(("name", "choices", "boundary"), CASES)
def test_a_lone_sphere_flies_ballistically_for_a_hundred_frames(name, choices, boundary):
    flown(lively(name, choices, boundary))


def test_a_lone_sphere_flies_ballistically_under_the_shipped_model():
    flown(load_model(shipped_model())[0])


@pytest.mark.parametrize(("name", "choices", "boundary"), CASES)
def test_a_sphere_that_nothing_is_near_has_no_part_in_any_gradient(name, choices, boundary):
    model = lively(name, choices, boundary)
    states = [torch.zeros(2, 3) for _ in range(3)]
    states[0][1, 0] = 0.2
    state = model.begin(SCENE, *states)
    after = model(model(state, SCENE, 1.5), SCENE, 1.51)
    loss = after.position.sum() + after.velocity.sum()
    gradients = torch.autograd.grad(loss, list(model.parameters()), allow_unused=True, materialize_grads=True)
    assert not any(gradient.any() for gradient in gradients)


@pytest.mark.parametrize("name", ["radial", "ccnn"])
def test_a_convolution_lets_go_of_its_neighbours_and_walls_smoothly(name):
    model = lively(name, {"backend": "torch"}, "analytic").double()
    radius = model.radius

    def pushed(gap: float, wall: float) -> float:
        position = torch.tensor([[0.0, 0.0, 0.0], [radius - gap, 0.0, 0.0]], dtype=torch.float64)
        floor = Plane((0.0, 0.0, wall - radius), (0.0, 0.0, 1.0), turns=False)
        scene = replace(SCENE, walls=(floor,), gravity=(0.0, 0.0, 0.0))
        return model.acceleration(position, torch.zeros_like(position), scene, 1.5)[0].norm().item()

    for near in ((1e-6, -1.0), (-1.0, 1e-6)):
        far, close = pushed(*near), pushed(*(0.03 if value > 0 else value for value in near))
        assert far < 1e-6 * close
