"""How large the spheres of a filling are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gran_bench.config import SizesConfig
from gran_bench.scene.errors import SceneError, hold
from gran_bench.state import FloatArray

CUT = 2.0  # standard deviations at which a lognormal distribution ends


@dataclass(frozen=True)
class Sizes:
    """A distribution of diameters by number, as factors of the filling's diameter.

    Attributes:
        kind: ``one``; ``listed``; ``uniform`` in 1 ± spread; ``lognormal`` with median 1 and standard deviation
            ``spread`` of ln d, cut at two standard deviations.
        factors: of ``listed``, −.
        fractions: share of each factor, by number; they sum to 1.
        spread: −.
    """

    kind: str = "one"
    factors: tuple[float, ...] = ()
    fractions: tuple[float, ...] = ()
    spread: float = 0.0

    def __post_init__(self) -> None:
        hold(self, SizesConfig.place, SizesConfig)
        if self.kind == "listed":
            if not self.factors:
                raise SceneError(f"scene.filling.sizes.factors={list(self.factors)} is impossible; give values > 0")
            check_fractions("scene.filling.sizes.fractions", self.fractions, len(self.factors))
        elif self.factors or self.fractions:
            raise SceneError(f"scene.filling.sizes.factors={list(self.factors)} needs scene.filling.sizes.kind=listed")
        if self.kind in ("uniform", "lognormal"):
            if not self.spread:
                raise SceneError(f"scene.filling.sizes.spread={self.spread:g} is impossible; choose a value in (0, 1)")
        elif self.spread:
            raise SceneError(
                f"scene.filling.sizes.spread={self.spread:g} needs scene.filling.sizes.kind=uniform or lognormal"
            )

    @property
    def smallest(self) -> float:
        """−, of all factors that can come."""
        return min(self._ends)

    @property
    def largest(self) -> float:
        """−, of all factors that can come."""
        return max(self._ends)

    @property
    def _ends(self) -> tuple[float, ...]:
        if self.kind == "listed":
            return tuple(f for f, share in zip(self.factors, self.fractions, strict=True) if share > 0)
        if self.kind == "uniform":
            return (1.0 - self.spread, 1.0 + self.spread)
        if self.kind == "lognormal":
            return (math.exp(-CUT * self.spread), math.exp(CUT * self.spread))
        return (1.0,)

    def sample(self, count: int, rng: np.random.Generator) -> FloatArray:
        """``(count,)`` factors in random order: the same sizes for every seed.

        Shares are exact to one sphere; of a continuous distribution come the quantiles (k + ½)/count.
        """
        if self.kind == "one":
            return np.ones(count)
        share = (np.arange(count) + 0.5) / max(count, 1)
        if self.kind == "listed":
            factors = np.repeat(self.factors, apportioned(count, self.fractions))
        elif self.kind == "uniform":
            factors = 1.0 + self.spread * (2.0 * share - 1.0)
        else:
            from scipy.special import ndtri  # a fifth of a second to load, and no other kind of sizes needs it

            low, high = (0.5 * math.erfc(-z / math.sqrt(2.0)) for z in (-CUT, CUT))
            factors = np.exp(self.spread * ndtri(low + (high - low) * share))
        return rng.permutation(factors)


def check_fractions(name: str, fractions: tuple[float, ...], count: int) -> None:
    """Refuses shares that are none.

    Raises:
        SceneError: not one for each of ``count``, or a sum other than 1.
    """
    if len(fractions) != count or not math.isclose(sum(fractions), 1.0, abs_tol=1e-9):
        raise SceneError(f"{name}={list(fractions)} is impossible; give {count} shares ≥ 0 that sum to 1")


def apportioned(count: int, fractions: tuple[float, ...]) -> np.ndarray:
    """Whole numbers that sum to ``count`` and differ from count × fraction by less than one (largest remainders)."""
    exact = count * np.asarray(fractions)
    whole = np.floor(exact + 1e-9).astype(np.int64)
    order = np.argsort(whole - exact, kind="stable")
    whole[order[: count - whole.sum()]] += 1
    return whole
