"""From a config to a surrogate."""

from __future__ import annotations

from collections.abc import Sequence

from gran_bench.config import BoundaryConfig, TrainConfig
from gran_bench.config.registry import MODELS
from gran_bench.config.rules import Section, checked
from gran_bench.scene import Scene
from gran_bench.surrogate.step import Surrogate
from gran_bench.surrogate.trained_for import TrainedFor


def build_model(model: Section, boundary: BoundaryConfig, scene: Scene, speeds_rpm: Sequence[float] = ()) -> Surrogate:
    """The surrogate that a config names, with fresh weights from torch's global generator.

    Args:
        model: its ``name`` is a registered one: ``ccnn``, ``radial`` (a continuous-convolution network with the lattice
            or the radial kernel), ``contact``, or a plugin's.
        boundary: how a model sees the walls that has no way of its own.
        scene: that the model is made for; a rollout in another one is held against it.
        speeds_rpm: of the drum in the training cases, rpm.

    Raises:
        ConfigError: no model's config, or values that do not fit together or to the scene's spheres.
    """
    checked(TrainConfig, "model", model)
    make = MODELS[model.name]  # imports the model's module: a model that is not used costs no import
    built = make(model, scene) if make.own_walls else make(model, boundary, scene)
    built.trained_for = TrainedFor(scene, tuple(speeds_rpm))
    return built
