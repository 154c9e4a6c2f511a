"""A data set, a training and a model file that are made in seconds: what damage, full disks and kills are done to."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import torch
from overrides import override

from gran_bench.compose import checked_config, compose
from gran_bench.config import ContainerConfig, FillingConfig, SceneConfig, TrainConfig
from gran_bench.dataset import CaseSpec, Windows, ensure_cases, read_case, split_cases
from gran_bench.scene import Scene, build_scene
from gran_bench.surrogate.checkpoint import ModelCard, save_model
from gran_bench.surrogate.step import build_model
from gran_bench.trainer import Trainer

SPEEDS = (20.0, 30.0, 40.0)  # rpm


def tiny_specs(seconds: float = 2.0) -> list[CaseSpec]:
    """Three cases of 60 spheres in a short drum, with so many seconds of rotation."""
    config = SceneConfig(
        name="drum_tiny",
        container=ContainerConfig(diameter=0.4, length=0.2),
        filling=FillingConfig(count=60),
        start_time=1.0,
        end_time=1.0 + seconds,
    )
    return [CaseSpec(build_scene(config).at_speed(speed)) for speed in SPEEDS]


def tiny_training(root: Path) -> tuple[TrainConfig, Scene]:
    """The smoke recipe with short cases, which lie in ``root``, and 40 updates."""
    changes = [
        "scene.end_time=1.9", "judge.short_horizon_starts=3", "trainer.steps=40", "trainer.checkpoint_steps=3",
        "threads=1", override("dataset.root", root), "dataset.workers=1",
    ]  # fmt: skip
    config = checked_config(compose("train", ["+experiment=smoke", *changes]), TrainConfig)
    return config, build_scene(config.scene)


def tiny_trainer(root: Path, folder: Path) -> Trainer:
    """A trainer of that recipe with its checkpoint in ``folder``; its data are made where they are missing."""
    config, scene = tiny_training(root)
    split = split_cases(scene, config.dem, config.dataset)
    ensure_cases(split.training, root, workers=1, progress=False)
    windows = Windows([read_case(spec.path(root)) for spec in split.training], config.seed)
    torch.manual_seed(config.seed)
    model = build_model(config.model, config.boundary, scene)
    folder.mkdir(parents=True, exist_ok=True)
    return Trainer(model, windows, config, folder)


def model_file(folder: Path) -> Path:
    """An untrained model in a file of a folder; one that is there is replaced."""
    config, scene = tiny_training(folder / "data")
    torch.manual_seed(0)
    model = build_model(config.model, config.boundary, scene)
    card = ModelCard(asdict(config.model), asdict(config.boundary), asdict(config.scene), {"steps": 0})
    save_model(folder / "model.pt", model.state_dict(), card)
    return folder / "model.pt"
