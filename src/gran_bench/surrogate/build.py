"""From a config to a surrogate."""

from __future__ import annotations

from collections.abc import Sequence

from gran_bench.config import BoundaryConfig, CconvModelConfig, ContactModelConfig, TrainConfig
from gran_bench.config.rules import checked
from gran_bench.scene import Scene
from gran_bench.surrogate.step import Surrogate
from gran_bench.surrogate.trained_for import TrainedFor


def build_model(
    model: CconvModelConfig | ContactModelConfig,
    boundary: BoundaryConfig,
    scene: Scene,
    speeds_rpm: Sequence[float] = (),
) -> Surrogate:
    """The surrogate that a config names, with fresh weights from torch's global generator.

    Args:
        model: its ``name`` is one of ``ccnn``, ``radial`` (a continuous-convolution network with the lattice or the
            radial kernel) and ``contact``.
        boundary: how a convolutional model sees the walls; the contact network always has analytic contacts.
        scene: that the model is made for; a rollout in another one is held against it.
        speeds_rpm: of the drum in the training cases, rpm.

    Raises:
        ConfigError: no model's config, or values that do not fit together or to the scene's spheres.
    """
    checked(TrainConfig, "model", model)
    # Imported on demand: a model that is not used costs no import.
    if isinstance(model, CconvModelConfig):
        from gran_bench.surrogate.convolution.ccnn import ContinuousConvolutionNetwork

        built = ContinuousConvolutionNetwork(model, boundary, scene)
    else:
        from gran_bench.surrogate.contact.network import ContactNetwork

        built = ContactNetwork(model, scene)
    built.trained_for = TrainedFor(scene, tuple(speeds_rpm))
    return built
