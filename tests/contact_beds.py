"""Scenes, beds and lively networks that the tests of the contact network share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gran_bench.config import ContactModelConfig, ContainerConfig, FillingConfig, SceneConfig
from gran_bench.dem.walls import wall_contact
from gran_bench.scene import Cone, Cylinder, Disc, Plane, Scene, Spin, Translation, Vibration, build_scene
from gran_bench.surrogate.contact.geometry import find_contacts
from gran_bench.surrogate.contact.memory import ContactMemory
from gran_bench.surrogate.contact.network import ContactNetwork
from gran_bench.surrogate.step import FrameState
from gran_bench.surrogate.walls import frame_walls

DIAMETER = 0.05
VARIANTS = ({}, {"memory": True}, {"velocity": "instantaneous"}, {"memory": True, "velocity": "instantaneous"})


def drum(count: int = 60, periodic: bool = False, speed_rpm: float = 30.0) -> Scene:
    """A short, narrow drum."""
    container = ContainerConfig(diameter=0.26, length=0.2, periodic_axis=periodic)
    return build_scene(SceneConfig("small", container, FillingConfig(count, DIAMETER))).at_speed(speed_rpm)


def nowhere(gravity: bool = False) -> Scene:
    """No walls."""
    strength = -9.81 if gravity else 0.0
    return build_scene(SceneConfig("free", ContainerConfig(kind="none"), gravity=[0.0, 0.0, strength]))


def furnished():
    """A wall of every kind, some off the axes, one that shakes, one that turns end over end, one that opens."""
    tilted = (0.6, 0.0, 0.8)
    walls = (
        Plane((0.1, 0.0, -0.5), tilted, motion=Vibration(0.01, 3.0, (0.0, 0.6, 0.8))),
        Cylinder((0.0, 0.1, 0.0), (0.0, 0.6, 0.8), 0.5, turns=False),
        Cylinder((0.3, 0.0, 0.0), tilted, 0.1, length=0.4, motion=Spin((1.5,), (40.0,), center=(0.1, 0.0, 0.2))),
        Disc((0.0, 0.0, -0.2), tilted, 0.3, hole=0.1, motion=Translation((1.4, 1.6), ((0, 0, 0), (0.5, -0.2, 0.1)))),
        Disc((0.0, 0.0, 0.4), (0.0, 0.0, 1.0), 0.3, turns=False),
        Cone((0.0, -0.3, 0.0), tilted, 0.05, 0.3, 0.25, turns=False),
        Disc((0.0, 0.2, 0.0), (0.0, 1.0, 0.0), 0.2, turns=False, opens=1.6),
    )
    return replace(drum(), walls=walls, drum_radius=None, length=None, name="furnished", frame_interval=0.01)


def at_walls(scene: Scene, dtype: torch.dtype = torch.float32) -> FrameState:
    """Three spheres at each wall, in touch, in full reach and in the fade of its reach, and a pair in its fade."""
    rng, shapes = np.random.default_rng(7), frame_walls(scene, 1.51).after
    taken: list[np.ndarray] = []

    def site(index: int | None, gap: float) -> np.ndarray:
        while True:
            place = rng.uniform(-0.6, 0.6, 3)
            if index is not None:
                distance, toward = wall_contact(shapes[index], place[None])
                place = place + (distance[0] - 0.5 * DIAMETER - gap) * toward[0]
            others = [wall_contact(shape, place[None])[0][0] for k, shape in enumerate(shapes) if k != index]
            if min(others) > 0.05 and all(np.linalg.norm(place - there) > 0.1 for there in taken):
                return place

    for index in range(len(shapes)):
        for gap in (-0.0004, 0.003, 0.0075):
            taken.append(site(index, gap))
    taken.append(site(None, 0.0))
    taken.append(taken[-1] + (0.0, 0.0575, 0.0))
    position = np.array(taken)
    velocity, spin = rng.normal(0.0, 0.02, position.shape), rng.normal(0.0, 2.0, position.shape)
    return FrameState(*(torch.tensor(a, dtype=dtype) for a in (position, velocity, spin)))


def network(scene: Scene, seed: int = 0, **choices) -> ContactNetwork:
    """A network whose weights are far from their quiet start, so that every term acts."""
    torch.manual_seed(seed)
    model = ContactNetwork(ContactModelConfig(**{"iterations": 3, "backend": "torch"} | choices), scene)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.15 * torch.randn_like(parameter)
    return model


def cluster(scene: Scene, count: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> FrameState:
    """Spheres on a jittered lattice with gaps of both signs, lively velocities and spins, a few at each wall."""
    rng = np.random.default_rng(seed)
    edge = int(np.ceil(count ** (1 / 3)))
    site = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), -1).reshape(-1, 3)[:count]
    position = (site - 0.5 * (edge - 1)) * DIAMETER * 1.01 + rng.uniform(-0.002, 0.002, (count, 3))
    if scene.drum_radius is not None:
        reach = scene.drum_radius - 0.5 * DIAMETER
        radial = np.hypot(position[:, 0], position[:, 2])
        far = radial > reach
        position[far] *= np.where([True, False, True], reach / radial[far, None], 1.0)
        position[:, 1] = np.clip(position[:, 1], -0.5 * scene.length + 0.024, 0.5 * scene.length - 0.024)
    velocity, spin = rng.normal(0.0, 0.3, (count, 3)), rng.normal(0.0, 8.0, (count, 3))
    return FrameState(*(torch.tensor(a, dtype=dtype) for a in (position, velocity, spin)))


def with_memory(model: ContactNetwork, scene: Scene, state: FrameState) -> FrameState:
    """The state with springs at half of its contacts."""
    if model.has_memory:
        contacts = find_contacts(scene, 1.51, state.position.detach().numpy(), DIAMETER * 1.1, 0.01)
        keys = contacts.keys[::2]
        spring = np.random.default_rng(5).normal(0.0, 0.3, (len(keys), 3)).astype(np.float32)
        state.memory = ContactMemory(keys, spring)
    return state
