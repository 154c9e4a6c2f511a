"""Config keys of the continuous-convolution networks: the founding article's, and the two that it builds on."""

from __future__ import annotations  # the types of keys are read as words

from dataclasses import dataclass

from gran_bench.config.registry import register_model
from gran_bench.config.rules import Section, at_least, key, one_of, positive

CODE = ("surrogate/convolution",)


@dataclass
class ConvolutionConfig(Section, place="model"):
    """What all of them have."""

    kernel: str = key("lattice", one_of("lattice", "radial"))
    kernel_size: int = key(4, at_least(2))  # lattice nodes along an edge of the cube
    width: int = key(64, at_least(2))
    layers: int = key(3, at_least(1))  # hidden layers of each branch
    radius_diameters: float = key(2.25, positive("diameters"))  # support radius R
    radius_m: float | None = key(None, positive("m"))  # null: by radius_diameters
    constant_input: bool = True  # a constant 1 among the input features
    residual: bool = True  # where widths agree
    output_scale_diameters: float = key(0.02, positive("diameters per frame²"))  # one unit of the network's output
    backend: str = key("fused", one_of("fused", "torch"))  # fused: Numba, CPU
    precision: str = key("float32", one_of("float32", "bfloat16"))  # of the factors of the convolutions


@register_model(
    *("ccnn", "radial"),
    build="gran_bench.surrogate.convolution.ccnn:ContinuousConvolutionNetwork",
    own_walls=False,
    gravity_outside=True,
    code=CODE,
)
@dataclass
class CconvModelConfig(ConvolutionConfig, place="model"):
    """A continuous-convolution network: lattice (the paper's CCNN) or radial kernel basis."""

    name: str = key("ccnn", one_of("ccnn", "radial"))
    pair_branch: str = key("plain", one_of("plain", "antisymmetric"))  # antisymmetric: pairs conserve momentum
    update: str = key("mean", one_of("mean", "trapezoid"))


@register_model("lu2021", build="gran_bench.surrogate.convolution.lu2021:Lu2021Network", own_walls=False, code=CODE)
@dataclass
class Lu2021Config(ConvolutionConfig, place="model"):
    """One network that predicts the next position, after Lu et al. 2021; its one unit of output is in d a frame."""

    name: str = key("lu2021", one_of("lu2021"))
    width: int = key(32, at_least(2))


@register_model(
    "xu_shen2022", build="gran_bench.surrogate.convolution.xu_shen2022:XuShen2022Network", own_walls=False, code=CODE
)
@dataclass
class XuShen2022Config(ConvolutionConfig, place="model"):
    """Accelerations of a particle and a wall branch, then Newton's law, after Xu & Shen 2022."""

    name: str = key("xu_shen2022", one_of("xu_shen2022"))
    width: int = key(32, at_least(2))
    update: str = key("mean", one_of("mean", "trapezoid"))
