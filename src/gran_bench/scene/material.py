"""What spheres and walls are made of, and what two materials do where they meet."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gran_bench.config import MaterialConfig
from gran_bench.scene.errors import SceneError


@dataclass(frozen=True)
class Material:
    """An elastic, frictional material.

    Attributes:
        youngs_modulus: E, Pa.
        poisson_ratio: ν, −.
        density: ρ, kg/m³.
        restitution: e, −; of a head-on impact, at any speed.
        friction: μ, −; Coulomb limit of the tangential force.
        rolling_friction: μ_r, −; 0 switches the rolling model off.
    """

    youngs_modulus: float
    poisson_ratio: float
    density: float
    restitution: float
    friction: float
    rolling_friction: float = 0.0

    def __post_init__(self) -> None:
        legal = {
            "youngs_modulus": (self.youngs_modulus > 0, "> 0 Pa"),
            "poisson_ratio": (-1.0 < self.poisson_ratio < 0.5, "in (−1, 0.5)"),
            "density": (self.density > 0, "> 0 kg/m³"),
            "restitution": (0.0 < self.restitution <= 1.0, "in (0, 1]"),
            "friction": (self.friction >= 0, "≥ 0"),
            "rolling_friction": (self.rolling_friction >= 0, "≥ 0"),
        }
        for name, (holds, bounds) in legal.items():
            value = getattr(self, name)
            if not (math.isfinite(value) and holds):
                raise SceneError(f"material.{name}={value:g} is impossible; choose a value {bounds}")

    @property
    def shear_modulus(self) -> float:
        """G = E / 2(1 + ν), Pa."""
        return self.youngs_modulus / (2.0 * (1.0 + self.poisson_ratio))

    @classmethod
    def from_config(cls, config: MaterialConfig) -> Material:
        """The material that a config describes."""
        return cls(**{name: getattr(config, name) for name in cls.__dataclass_fields__})


@dataclass(frozen=True)
class PairCoefficients:
    """What contacts between two different particle materials do, where the geometric mean is not wanted.

    Attributes:
        first, second: indices into ``Scene.materials``, in either order.
        restitution, friction, rolling_friction: −; None for the geometric mean of the two materials' own.
    """

    first: int
    second: int
    restitution: float | None = None
    friction: float | None = None
    rolling_friction: float | None = None

    def __post_init__(self) -> None:
        if self.first == self.second:
            raise SceneError(
                f"pair coefficients of material {self.first} with itself contradict the material's own; change those"
            )
        legal = {
            "restitution": (lambda e: 0.0 < e <= 1.0, "in (0, 1]"),
            "friction": (lambda mu: mu >= 0.0, "≥ 0"),
            "rolling_friction": (lambda mu: mu >= 0.0, "≥ 0"),
        }
        for name, (holds, bounds) in legal.items():
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and holds(value)):
                raise SceneError(f"scene.mixed.{name}={value:g} is impossible; choose a value {bounds}, or null")


def mixed_coefficients(
    first: Material, second: Material, own: PairCoefficients | None = None
) -> tuple[float, float, float]:
    """(e, μ, μ_r) of contacts between two materials: the geometric means, or what the pair has of its own.

    The geometric mean is a convention, not a law of nature: where a pair was measured, give what was measured.
    """
    names = ("restitution", "friction", "rolling_friction")
    given = [None if own is None else getattr(own, name) for name in names]
    means = [math.sqrt(getattr(first, name) * getattr(second, name)) for name in names]
    e, mu, rolling = (mean if value is None else value for value, mean in zip(given, means, strict=True))
    return e, mu, rolling
