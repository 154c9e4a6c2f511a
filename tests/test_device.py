"""Surrogates on another device than the CPU: the same operators, with all their tensors there.

No GPU is needed: a device is pretended, which computes here and refuses to mix its tensors with the CPU's.
"""

import numpy as np
import pytest
import torch
from pretend_device import DEVICE, PretendDevice, There
from trainings import SCENE, CrowdedWindows, config

from gran_bench.config import BoundaryConfig, CconvModelConfig, ContactModelConfig, LossConfig, RolloutConfig
from gran_bench.dem.outlet import taking_part
from gran_bench.shipped import shipped_scene
from gran_bench.state import ParticleState
from gran_bench.surrogate.rollout import rollout
from gran_bench.surrogate.step import build_model
from gran_bench.trainer import Trainer

CONVOLUTION = {"width": 8, "radius_m": 0.09}
MODELS = {
    "contact": (ContactModelConfig, {"iterations": 2}, "own"),
    "contact, instantaneous": (ContactModelConfig, {"iterations": 2, "velocity": "instantaneous"}, "own"),
    "ccnn, spheres": (CconvModelConfig, CONVOLUTION, "spheres"),
    "ccnn, analytic": (CconvModelConfig, CONVOLUTION, "analytic"),
    "ccnn, bfloat16": (CconvModelConfig, CONVOLUTION | {"precision": "bfloat16"}, "none"),
    "radial": (CconvModelConfig, CONVOLUTION | {"name": "radial", "kernel": "radial"}, "spheres"),
}
LOSS = {"velocity": 1.0, "huber": 1.0, "acceleration": 1.0, "overlap": 1.0, "center_of_mass": 1.0, "energy": 1.0}


def updated(name, folder, backend, device):
    """A model's weights after an update by two frames of four hundred spheres, and its loss."""
    schema, choices, walls = MODELS[name]
    torch.manual_seed(0)
    model = build_model(schema(**choices, backend=backend), BoundaryConfig(kind=walls), SCENE).to(device)
    loss = LossConfig(**LOSS, momentum=float(schema is CconvModelConfig))  # the contact network always conserves it
    settings = config(loss=loss, threads=1, rollout=RolloutConfig(frames=2, noise_m=1e-4))
    trainer = Trainer(model, CrowdedWindows(), settings, folder)
    loss = trainer.update(SameThread())["loss"]
    return trainer.model.state_dict(), loss


class SameThread:
    """A pool whose work is done by who asks for it: another thread would not know that a device is pretended."""

    map = staticmethod(map)


@pytest.mark.parametrize("name", MODELS)
def test_a_training_on_a_device_keeps_to_it_and_learns_what_one_on_the_cpu_does(name, tmp_path):
    expected, expected_loss = updated(name, tmp_path, "torch", "cpu")
    with PretendDevice():
        found, loss = updated(name, tmp_path, "fused", DEVICE)  # plain torch takes the place of the kernels for CPUs
        assert all(isinstance(value, There) for value in found.values())
        found = {key: value.cpu() for key, value in found.items()}
    assert loss == pytest.approx(expected_loss, rel=1e-5)
    for key, value in expected.items():
        assert torch.allclose(found[key], value, atol=1e-5), key


def test_a_rollout_on_a_device_keeps_to_it_and_goes_as_on_the_cpu_does():
    """With springs of contacts, walls that are bodies of revolution, and spheres that fall out."""
    scene = shipped_scene("hopper", {"filling.count": 150})
    filling = scene.fresh_filling(0)
    velocity = np.zeros_like(filling.position)
    velocity[:50, 2] = -4.0
    state = ParticleState(filling.position, velocity, velocity, filling.radius, scene.start_time)

    def rolled_out(backend, device):
        torch.manual_seed(0)
        choices = ContactModelConfig(radius_m=0.024, wall_reach_m=0.004, memory=True, iterations=2, backend=backend)
        model = build_model(choices, BoundaryConfig(kind="own"), scene).to(device)
        return rollout(model, scene, state, frames=8).trajectory.position

    expected = rolled_out("torch", "cpu")
    with PretendDevice():
        found = rolled_out("fused", DEVICE)
    assert not taking_part(scene, expected[-1]).all()
    assert np.allclose(found, expected, rtol=0.0, atol=1e-6)


def test_the_pretended_device_refuses_tensors_of_the_cpu():
    with PretendDevice():
        there = torch.ones(3, device=DEVICE)
        assert (there + 1.0).device == DEVICE
        assert (2.0 * there).cpu().tolist() == [2.0, 2.0, 2.0]
        with pytest.raises(RuntimeError, match="of the device and of the CPU"):
            there + torch.ones(3)
