"""Where a training starts: the windows that it sees and the model's seeded first weights."""

import torch

from gran_bench.config import TrainConfig
from gran_bench.dataset import Split, Windows, read_case
from gran_bench.dataset.mixture import Mixture
from gran_bench.scene import Scene
from gran_bench.surrogate.step import Surrogate, build_model


def training_windows(config: TrainConfig, split: Split) -> Windows:
    """The training side of the data; nothing of the held-out cases is opened."""
    cases = [read_case(spec.path(config.dataset.root)) for spec in split.training]
    trainer, mixed = config.trainer, config.trainer.mixture
    startup = trainer.startup_fraction, trainer.startup_fall_times, trainer.startup_seconds
    mixture = Mixture(cases, mixed.shares, mixed.until) if mixed.scenes else None
    return Windows(cases, config.seed, *startup, mixture)


def validation_windows(config: TrainConfig, split: Split) -> Windows | None:
    """Of the cases that a training is looked at by, which are trained on no more than the held-out ones; or None."""
    cases = [read_case(spec.path(config.dataset.root)) for spec in split.validation]
    return Windows(cases, config.seed) if cases else None


def make_model(config: TrainConfig, scene: Scene) -> Surrogate:
    """The model with its seeded first weights, on its device."""
    torch.manual_seed(config.seed)
    speeds = config.dataset.training_speeds_rpm
    return build_model(config.model, config.boundary, scene, speeds).to(device_named(config.device))


def device_named(name: str) -> str:
    """The torch device of ``auto``, ``cpu`` or ``cuda``."""
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    return name
