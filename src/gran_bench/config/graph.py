"""Config keys of the graph network."""

from __future__ import annotations  # the types of keys are read as words

from dataclasses import dataclass

from gran_bench.config.registry import register_model
from gran_bench.config.rules import Section, at_least, key, one_of, positive


@register_model(
    "gns",
    build="gran_bench.surrogate.graph.network:GraphNetwork",
    code=("surrogate/graph", "surrogate/convolution/boundary.py"),
)
@dataclass
class GnsConfig(Section, place="model"):
    """A graph network that passes messages between particles and closest wall points."""

    name: str = key("gns", one_of("gns"))
    message_steps: int = key(3, at_least(1))
    width: int = key(64, at_least(1))  # numbers that an edge or a node holds
    layers: int = key(2, at_least(1))  # hidden layers of each perceptron
    radius_diameters: float = key(1.5, positive("diameters"))  # reach of an edge between two particles
    radius_m: float | None = key(None, positive("m"))  # null: by radius_diameters
    output_scale_diameters: float = key(0.02, positive("diameters per frame²"))  # one unit of the network's output
    update: str = key("mean", one_of("mean", "trapezoid"))
