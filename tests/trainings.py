"""Trainings of milliseconds: a small network, and spheres that lose a third of their velocity each frame."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import nn

from gran_bench.config import (
    ContactModelConfig,
    LossConfig,
    OptimConfig,
    RolloutConfig,
    SceneConfig,
    TrainConfig,
    TrainerConfig,
)
from gran_bench.scene import build_scene
from gran_bench.surrogate.step import FrameState, Surrogate
from gran_bench.trainer import (
    Trainer,
)

SCENE = build_scene(SceneConfig(name="drum"))


class Network(Surrogate):
    """A small network of the velocity: enough to have several weights and a history through time."""

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        torch.manual_seed(seed)
        self.net = nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, 3))

    def forward(self, state: FrameState, scene, time: float) -> FrameState:
        velocity = state.velocity + self.net(state.velocity)
        return FrameState(state.position + scene.frame_interval * velocity, velocity)


@dataclass(frozen=True)
class FakeWindow:
    scene: object
    time: float
    position: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray
    mean_overlap: np.ndarray

    def velocity_at(self, k: int, kind: str) -> np.ndarray:
        return self.velocity[k]


class FakeWindows:
    """Spheres that lose a third of their velocity each frame; every draw is a function of its number."""

    mixture = None

    def draw(self, draw: int, frames: int, progress: float = 0.0) -> FakeWindow:
        rng = np.random.default_rng((5, draw))
        start, speed = rng.normal(size=(2, 20, 3)).astype(np.float32)
        k = np.arange(frames + 1, dtype=np.float32)[:, None, None]
        velocity = speed * (2.0 / 3.0) ** k
        position = start + SCENE.frame_interval * (np.cumsum(velocity, axis=0) - velocity[0])
        return FakeWindow(SCENE, 1.5, position, velocity, velocity * 0, np.zeros(frames + 1))


class CrowdedWindows(FakeWindows):
    """The same in a box of half a metre, so that spheres have neighbours and walls."""

    def draw(self, draw: int, frames: int, progress: float = 0.0) -> FakeWindow:
        window = super().draw(draw, frames)
        crowd = np.random.default_rng((6, draw)).uniform(-0.25, 0.25, (frames + 1, 400, 3)).astype(np.float32)
        zeros = np.zeros_like(crowd)
        return replace(window, position=crowd - [0.0, 0.0, 0.2], velocity=zeros, angular_velocity=zeros)


def config(**changes) -> TrainConfig:
    settings = dict(
        model=ContactModelConfig(),
        seed=3,
        threads=2,
        scene=SceneConfig(name="drum"),
        loss=LossConfig(velocity=1.0),
        rollout=RolloutConfig(frames=2, noise_m=1e-3),
        optim=OptimConfig(learning_rate=1e-2, accumulate=3, weight_average=0.9, gradient_clip=1.0),
        trainer=TrainerConfig(steps=12, checkpoint_steps=4, log_every=1),
    )
    return TrainConfig(**(settings | changes))


def train(folder, **changes) -> tuple[Trainer, list]:
    folder.mkdir(exist_ok=True)
    logged = []
    trainer = Trainer(Network(), FakeWindows(), config(**changes), folder, lambda m, s: logged.append((s, m)))
    trainer.run(progress=False)
    return trainer, logged


def same(a: dict, b: dict) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a)
