"""From a config to a surrogate."""

from __future__ import annotations

from gran_bench.config import BoundaryConfig, CconvModelConfig, ContactModelConfig
from gran_bench.scene import Scene
from gran_bench.surrogate.step import Surrogate

MODELS = ("ccnn", "radial", "contact")


def build_model(model: CconvModelConfig | ContactModelConfig, boundary: BoundaryConfig, scene: Scene) -> Surrogate:
    """The surrogate that a config names, with fresh weights from torch's global generator.

    Args:
        model: its ``name`` is one of ``ccnn``, ``radial`` (a continuous-convolution network with the lattice or the
            radial kernel) and ``contact``.
        boundary: how a convolutional model sees the walls; the contact network always has analytic contacts.
        scene: the spheres and walls that the model is made for.

    Raises:
        ValueError: an unknown name, or a value that the model refuses.
    """
    # Imported on demand: a model that is not used costs no import.
    if model.name in ("ccnn", "radial"):
        from gran_bench.surrogate.ccnn import ContinuousConvolutionNetwork

        return ContinuousConvolutionNetwork(model, boundary, scene)
    if model.name == "contact":
        from gran_bench.surrogate.contact import ContactNetwork

        return ContactNetwork(model, scene)
    raise ValueError(f"model.name={model.name!r} is unknown; choose {', '.join(MODELS)}")
