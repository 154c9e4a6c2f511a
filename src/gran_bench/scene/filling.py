"""The spheres of a scene: how many, how large, of what, and where they start."""

import math
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from gran_bench.config import FRACTION, FillingConfig, SizesConfig
from gran_bench.config.consistency import check_filling
from gran_bench.config.rules import Range, positive
from gran_bench.scene.errors import SceneError, hold, scene_errors
from gran_bench.scene.motion import Vector
from gran_bench.state import FloatArray

CUT = 2.0  # standard deviations at which a lognormal distribution ends
MOST_SITES = 10_000_000  # of a first lattice, about a gigabyte; or 20 a sphere, for beds of more than half a million


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
            places, numbers = (np.array(values) for values in self._bins)
            if by_mass:  # uniform in d: their number is in proportion to 1/d³, uniform in 1/d²
                numbers *= -np.diff(places**-2.0) / (2.0 * np.diff(places))
                places = -(places**-2.0)
            # Of a bin without spheres both ends are reached at once, and no quantile lies inside.
            factors = np.interp(share, np.concatenate(([0.0], np.cumsum(numbers / numbers.sum()))), places)
            factors = (-factors) ** -0.5 if by_mass else factors
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


@dataclass(frozen=True)
class Room:
    """Where a lattice may stand when there is no drum: a box, or an upright tube about the z axis."""

    lower: Vector  # and upper: corners, m
    upper: Vector
    radius: float | None = None  # of the tube, m; None for the whole box

    def __post_init__(self) -> None:
        hold(self, "room.", lower=Range(unit="m"), upper=Range(unit="m"), radius=positive("m"))


@dataclass(frozen=True)
class Filling:
    """Spheres on a jittered lattice, the lowest sites first, or where they are placed one by one."""

    count: int  # N
    diameter: float  # d, m: the length of reference
    lattice_spacing: float = 1.12  # distance of neighbouring sites, in largest diameters
    jitter: float = 0.05  # largest offset from a site along each axis, in largest diameters
    # root mean square of the speeds over √(g d); a bed that stays below is at rest (dem/rest.py)
    settled_froude: float = 1.428e-3
    settled_speed: float | None = None  # the same in m/s; None: by the Froude number
    longest_settling_fall_times: float = 280.0  # √(d/g); a bed that is not at rest then is an error
    longest_settling: float | None = None  # the same in s; None: by the fall times
    settles: bool = True  # whether the spheres fall and come to rest before the scene starts
    sizes: Sizes = field(default_factory=Sizes)  # distribution of the diameters about d
    # share of each of the scene's materials, by number, in random order; empty: all of the first
    fractions: tuple[float, ...] = ()
    positions: tuple[Vector, ...] = ()  # ``(N, 3)`` centres instead of a lattice, m; empty for the lattice
    velocities: tuple[Vector, ...] = ()  # and spins: ``(N, 3)`` of placed spheres, m/s and rad/s; empty for rest
    spins: tuple[Vector, ...] = ()
    expansion: float = 0.0  # H of a start with velocity v = H x, 1/s: spheres fly apart and never meet
    radii: tuple[float, ...] = ()  # ``(N,)`` of placed spheres instead of sizes about d, m; empty for these

    def __post_init__(self) -> None:
        hold(self, FillingConfig.place, FillingConfig, fractions=FRACTION)
        with scene_errors():
            check_filling(self)
        moving = bool(self.velocities or self.spins or self.expansion)
        if moving and self.settles:
            raise SceneError("scene.filling.settles=true lets moving spheres come to rest; choose settles=false")
        if self.fractions:
            check_fractions("scene.filling.fractions", self.fractions, len(self.fractions))

    def __str__(self) -> str:
        """``3000 spheres of 50 mm``, or of ``40 to 60 mm``."""
        sizes = dict.fromkeys(f"{2e3 * r:.3g}" for r in (self.smallest_radius, self.largest_radius))
        return f"{self.count} spheres of {' to '.join(sizes)} mm"

    @property
    def radius(self) -> float:
        """r = d/2, m."""
        return 0.5 * self.diameter

    @property
    def smallest_radius(self) -> float:
        """m, of all that can come."""
        return min(self.radii, default=self.radius * self.sizes.smallest)

    @property
    def largest_radius(self) -> float:
        """m, of all that can come."""
        return max(self.radii, default=self.radius * self.sizes.largest)

    @property
    def spacing(self) -> float:
        """Distance of lattice sites, m."""
        return self.lattice_spacing * 2.0 * self.largest_radius

    @property
    def offset(self) -> float:
        """Largest offset from a site along each axis, m."""
        return self.jitter * 2.0 * self.largest_radius

    def materials(self, rng: np.random.Generator) -> np.ndarray:
        """Index of each sphere's material, ``(N,)`` uint8."""
        if not self.fractions:
            return np.zeros(self.count, np.uint8)
        counts = apportioned(self.count, self.fractions)
        return rng.permutation(np.repeat(np.arange(len(counts), dtype=np.uint8), counts))


def drum_sites(filling: Filling, drum_radius: float, length: float, periodic: bool) -> FloatArray:
    """Sites of a cubic lattice in a drum about y whose jittered spheres stay clear of every wall, ``(S, 3)`` m.

    Raises:
        SceneError: a drum so large for its spheres that the lattice fills the memory.
    """
    spacing, clear = filling.spacing, filling.largest_radius + filling.offset
    across, room = int((drum_radius - clear) / spacing), length - 2.0 * clear
    layers = int(length / spacing) if periodic else int(room / spacing) + 1 if room > 0 else 0
    wide = ("diameter", 2.0 * drum_radius, 2 * across + 1)
    _check_sites(filling, wide, ("length", length, layers), wide)
    if periodic:
        y = (np.arange(layers) + 0.5) * length / max(layers, 1) - 0.5 * length
    else:
        y = np.linspace(-0.5 * room, 0.5 * room, layers)
    line = np.arange(-across, across + 1) * spacing
    return _inside(filling, _grid(line, y, line), (0, 2), drum_radius)


def room_sites(filling: Filling, room: Room) -> FloatArray:
    """Sites of a cubic lattice in a room whose jittered spheres stay clear of its sides, ``(S, 3)`` m.

    Raises:
        SceneError: as of :func:`drum_sites`.
    """
    spacing, clear = filling.spacing, filling.largest_radius + filling.offset
    names = ("width", "length", "height") if room.radius is None else ("diameter", "diameter", "height")
    sizes = [high - low for low, high in zip(room.lower, room.upper, strict=True)]
    free = [size - 2.0 * clear for size in sizes]
    numbers = [int(width / spacing + 1e-9) + 1 if width >= 0 else 0 for width in free]
    _check_sites(filling, *zip(names, sizes, numbers, strict=True))
    lines = [
        0.5 * (low + high) + (np.arange(sites) - 0.5 * (sites - 1)) * spacing
        for low, high, sites in zip(room.lower, room.upper, numbers, strict=True)
    ]
    if len(lines[2]):  # the lowest layer lies at the bottom
        lines[2] = lines[2] - lines[2][0] + room.lower[2] + clear
    grid = _grid(*lines)
    return grid if room.radius is None else _inside(filling, grid, (0, 1), room.radius)


def _check_sites(filling: Filling, *sides: tuple[str, float, int]) -> None:
    """Refuses a lattice that is too large, before it is made; ``sides``: key, size in m, and sites along it."""
    sites = math.prod(number for _, _, number in sides)
    if sites > max(MOST_SITES, 20 * filling.count):
        name, size, _ = max(sides, key=lambda side: side[2])
        raise SceneError(
            f"scene.container.{name}={size:g} m holds {sites:.0e} sites of a lattice for {filling.count} spheres of "
            f"{2.0 * filling.largest_radius:g} m; lengths are in m: choose a smaller container or larger spheres"
        )


def open_sites(filling: Filling) -> FloatArray:
    """Sites of a cubic lattice about the origin without any wall, N or a few more, ``(S, 3)`` m."""
    side = math.ceil(round(filling.count ** (1.0 / 3.0), 9))
    line = (np.arange(side) - 0.5 * (side - 1)) * filling.spacing
    return _grid(line, line, line)


def _grid(*lines: FloatArray) -> FloatArray:
    return np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)


def _inside(filling: Filling, grid: FloatArray, axes: tuple[int, int], radius: float) -> FloatArray:
    """Sites whose jittered spheres lie within a tube."""
    one, other = (np.abs(grid[:, axis]) + filling.offset for axis in axes)
    return grid[np.hypot(one, other) <= radius - filling.largest_radius]
