"""What spheres and walls are made of, and what two materials do where they meet."""

from __future__ import annotations

from dataclasses import dataclass

from gran_bench.config import MaterialConfig, MixedConfig
from gran_bench.config.rules import at_least
from gran_bench.scene.errors import SceneError, hold


@dataclass(frozen=True)
class Material:
    """An elastic, frictional material."""

    youngs_modulus: float  # E, Pa
    poisson_ratio: float  # ν, −
    density: float  # ρ, kg/m³
    restitution: float  # e, −; of a head-on impact, at any speed
    friction: float  # μ, −; Coulomb limit of the tangential force
    rolling_friction: float = 0.0  # μ_r, −; 0 switches the rolling model off

    def __post_init__(self) -> None:
        hold(self, MaterialConfig.place, MaterialConfig)

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
    """What contacts between two different particle materials do, where the geometric mean is not wanted."""

    first: int  # and second: indices into ``Scene.materials``, in either order.
    second: int
    # and friction, rolling_friction: −; None for the geometric mean of the two materials' own
    restitution: float | None = None
    friction: float | None = None
    rolling_friction: float | None = None

    def __post_init__(self) -> None:
        hold(self, MixedConfig.place, MixedConfig, first=at_least(0), second=at_least(0))
        if self.first == self.second:
            raise SceneError(
                f"pair coefficients of material {self.first} with itself contradict the material's own; change those"
            )
