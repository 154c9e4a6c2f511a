"""A data set, a training and a model file that are made in seconds: what damage, full disks and kills are done to."""

from __future__ import annotations

from pathlib import Path

import torch

from gran_bench.compose import override
from gran_bench.config import ContainerConfig, FillingConfig, SceneConfig, TrainConfig
from gran_bench.dataset import CaseSpec, Windows, ensure_cases, read_case, split_cases
from gran_bench.entry import checked_config, compose
from gran_bench.scene import Scene, build_scene
from gran_bench.surrogate.build import build_model
from gran_bench.trainer import Trainer

SPEEDS = (20.0, 30.0, 40.0)  # rpm
STEPS = 40  # updates of the training


def tiny_specs(count: int = 60, seconds: float = 2.0) -> list[CaseSpec]:
    """Three cases of a short drum.

    Args:
        count: of spheres.
        seconds: of rotation.
    """
    scene = build_scene(
        SceneConfig(
            name="drum_tiny",
            container=ContainerConfig(diameter=0.4, length=0.2),
            filling=FillingConfig(count=count),
            start_time=1.0,
            end_time=1.0 + seconds,
        )
    )
    return [CaseSpec(scene.at_speed(speed)) for speed in SPEEDS]


def tiny_training(root: Path) -> tuple[TrainConfig, Scene]:
    """The smoke recipe with short cases and few updates.

    Args:
        root: folder of its cases.
    """
    changes = [
        "scene.end_time=1.9", "judge.short_horizon_starts=3", f"trainer.steps={STEPS}", "trainer.checkpoint_steps=3",
        "threads=1", override("dataset.root", root), "dataset.workers=1",
    ]  # fmt: skip
    config = checked_config(compose("train", ["+experiment=smoke", *changes]), TrainConfig)
    return config, build_scene(config.scene)


def tiny_trainer(root: Path, folder: Path) -> Trainer:
    """A trainer of that recipe, whose data are made where they are missing.

    Args:
        root: of the data.
        folder: of the checkpoint.
    """
    config, scene = tiny_training(root)
    split = split_cases(scene, config.dem, config.dataset)
    ensure_cases(split.training, root, workers=1, progress=False)
    windows = Windows([read_case(spec.path(root)) for spec in split.training], config.seed)
    torch.manual_seed(config.seed)
    model = build_model(config.model, config.boundary, scene)
    folder.mkdir(parents=True, exist_ok=True)
    return Trainer(model, windows, config, folder)
