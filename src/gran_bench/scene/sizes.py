"""How large the spheres of a filling are."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from gran_bench.config import SizesConfig
from gran_bench.scene.errors import SceneError, hold
from gran_bench.state import FloatArray

CUT = 2.0  # standard deviations at which a lognormal distribution ends


@dataclass(frozen=True)
class Sizes:
    """A distribution of diameters as factors of the filling's diameter, by number or by mass.

    By mass the share of a size is its share of the bed's mass, as a sieve curve gives it: a share m of spheres of
    diameter d is a number in proportion to m/d³.
    """

    # ``one``; ``listed``; ``uniform`` in 1 ± spread; ``lognormal`` with median 1 and standard deviation ``spread`` of
    # ln d, cut at two standard deviations; ``histogram``, uniform within each bin
    kind: str = "one"
    factors: tuple[float, ...] = ()  # of ``listed``, −
    fractions: tuple[float, ...] = ()  # share of each factor or bin; they sum to 1
    spread: float = 0.0  # −
    edges: tuple[float, ...] = ()  # of the bins of ``histogram``, one more than there are fractions, −
    by: str = "number"  # ``number`` or ``mass``: what is shared out

    def __post_init__(self) -> None:
        hold(self, SizesConfig.place, SizesConfig)
        kind, place = self.kind, SizesConfig.place
        needed = {"factors": ("listed",), "edges": ("histogram",), "fractions": ("listed", "histogram"),
                  "spread": ("uniform", "lognormal")}  # fmt: skip
        for name, kinds in needed.items():
            value = getattr(self, name)
            text = list(value) if isinstance(value, tuple) else f"{value:g}"
            if value and kind not in kinds:
                raise SceneError(f"{place}{name}={text} needs {place}kind={' or '.join(kinds)}")
            if kind not in kinds or name == "fractions":
                continue
            rises = name != "edges" or (len(value) > 1 and all(a < b for a, b in pairwise(value)))
            if not (value and rises):
                legal = {"factors": "give values > 0", "edges": "give two or more values > 0 that rise"}
                raise SceneError(f"{place}{name}={text} is impossible; {legal.get(name, 'choose a value in (0, 1)')}")
        if kind in needed["fractions"]:
            check_fractions(f"{place}fractions", self.fractions, len(self.factors) or len(self.edges) - 1)

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
        if self.kind == "lognormal":
            return (math.exp(-CUT * self.spread), math.exp(CUT * self.spread))
        if self.kind == "one":
            return (1.0,)
        edges, fractions = self._bins
        return tuple(f for bin, share in zip(pairwise(edges), fractions, strict=True) if share > 0 for f in bin)

    @property
    def _bins(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Edges and shares of a histogram; uniform sizes are one bin."""
        if self.kind == "uniform":
            return (1.0 - self.spread, 1.0 + self.spread), (1.0,)
        return self.edges, self.fractions

    def sample(self, count: int, rng: np.random.Generator) -> FloatArray:
        """``(count,)`` factors in random order: the same sizes for every seed.

        Shares are exact to one sphere; of a continuous distribution come the quantiles (k + ½)/count.
        """
        if self.kind == "one":
            return np.ones(count)
        share = (np.arange(count) + 0.5) / max(count, 1)
        by_mass = self.by == "mass"
        if self.kind == "listed":
            numbers = np.array(self.fractions) / np.array(self.factors) ** (3.0 if by_mass else 0.0)
            factors = np.repeat(self.factors, apportioned(count, tuple(numbers / numbers.sum())))
        elif self.kind == "lognormal":
            from scipy.special import ndtri  # a fifth of a second to load, and no other kind of sizes needs it

            # The numbers of a lognormal distribution of mass are lognormal too, with a median 3 σ² lower.
            shift = 3.0 * self.spread if by_mass else 0.0
            low, high = (0.5 * math.erfc(-(z + shift) / math.sqrt(2.0)) for z in (-CUT, CUT))
            factors = np.exp(self.spread * (ndtri(low + (high - low) * share) - shift))
        else:
            factors = _of_bins(share, *self._bins, by_mass)
        return rng.permutation(factors)


def _of_bins(share: FloatArray, edges: tuple[float, ...], fractions: tuple[float, ...], by_mass: bool) -> FloatArray:
    """Quantiles of a histogram at shares of the number of spheres.

    Where mass is uniform in d, the number is in proportion to 1/d³: uniform in 1/d².
    """
    places = np.array(edges)
    numbers = np.array(fractions)
    if by_mass:
        numbers *= -np.diff(places**-2.0) / (2.0 * np.diff(places))
        places = -(places**-2.0)
    reached = np.concatenate(([0.0], np.cumsum(numbers / numbers.sum())))
    # Of a bin without spheres both ends are reached at once, and no quantile lies inside.
    found = np.interp(share, reached, places)
    return (-found) ** -0.5 if by_mass else found


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
