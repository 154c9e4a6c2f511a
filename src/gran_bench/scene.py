"""A scene: walls, motion, materials, gravity and filling, and what of the physics it needs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from gran_bench.config import MaterialConfig, SceneConfig
from gran_bench.state import FloatArray, ParticleState

RADIANS_PER_SECOND_PER_RPM = 2.0 * math.pi / 60.0


class SceneError(ValueError):
    """A scene that cannot exist; the message names the key, the value and the remedy."""


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
class Plane:
    """A flat wall; particles live on the side that ``normal`` points to.

    Attributes:
        point: a point of the plane, m.
        normal: unit normal into the container.
        turns: whether its surface moves with the scene's rotation.
    """

    point: tuple[float, float, float]
    normal: tuple[float, float, float]
    turns: bool = True


@dataclass(frozen=True)
class Cylinder:
    """The inside of an infinite cylinder.

    Attributes:
        point: a point on the axis, m.
        axis: unit vector along the axis.
        radius: m.
        turns: whether its surface moves with the scene's rotation.
    """

    point: tuple[float, float, float]
    axis: tuple[float, float, float]
    radius: float
    turns: bool = True


Wall = Plane | Cylinder


@dataclass(frozen=True)
class Rotation:
    """Rotation about an axis through the origin: at rest before the first knot, piecewise linear between
    knots, constant after the last.

    Attributes:
        times: knots, s, increasing (equal times make a jump).
        speeds_rpm: speed at each knot, revolutions a minute; positive turns +z into +x.
        axis: unit vector.
    """

    times: tuple[float, ...] = (0.0,)
    speeds_rpm: tuple[float, ...] = (0.0,)
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0)

    def __post_init__(self) -> None:
        if len(self.times) != len(self.speeds_rpm) or not self.times:
            raise SceneError(
                f"rotation has {len(self.times)} times and {len(self.speeds_rpm)} speeds; give one speed for each time"
            )
        if not all(map(math.isfinite, (*self.times, *self.speeds_rpm))):
            raise SceneError(f"rotation.speeds_rpm={list(self.speeds_rpm)} at {list(self.times)} s is not finite")
        if any(b < a for a, b in pairwise(self.times)):
            raise SceneError(f"rotation.times={list(self.times)} must increase")

    def angular_speed(self, time: float) -> float:
        """ω(t), rad/s."""
        if time < self.times[0]:
            return 0.0
        return float(np.interp(time, self.times, self.speeds_rpm)) * RADIANS_PER_SECOND_PER_RPM

    def angle(self, start: float, end: float) -> float:
        """Angle turned between two times, ∫ω dt, rad; exact for the piecewise linear schedule."""
        knots = np.array(self.times)
        inner = knots[(knots > start) & (knots < end)]
        edges = np.concatenate(([start], inner, [end]))
        total = 0.0
        for a, b in pairwise(edges):
            if b > self.times[0]:
                total += self.angular_speed(0.5 * (a + b)) * (b - a)
        return total

    @property
    def is_still(self) -> bool:
        """Whether nothing ever turns."""
        return not any(self.speeds_rpm)

    @property
    def largest_angular_speed(self) -> float:
        """max |ω|, rad/s."""
        return max(abs(s) for s in self.speeds_rpm) * RADIANS_PER_SECOND_PER_RPM


@dataclass(frozen=True)
class Filling:
    """Spheres of one size on a jittered lattice, the lowest sites first.

    Attributes:
        count: N.
        diameter: d, m.
        lattice_spacing: distance of neighbouring sites, d.
        jitter: largest offset from a site along each axis, d.
        settled_speed: mean speed below which the bed is at rest, m/s.
        longest_settling: s; a bed that still moves then is an error.
    """

    count: int
    diameter: float
    lattice_spacing: float = 1.12
    jitter: float = 0.05
    settled_speed: float = 1.0e-3
    longest_settling: float = 20.0

    def __post_init__(self) -> None:
        if self.count < 0:
            raise SceneError(f"scene.filling.count={self.count} is impossible; choose 0 or more")
        if not (math.isfinite(self.diameter) and self.diameter > 0):
            raise SceneError(f"scene.filling.diameter={self.diameter:g} is impossible; choose a value > 0 m")
        if self.lattice_spacing - 2.0 * self.jitter < 1.0 or self.jitter < 0:
            raise SceneError(
                f"scene.filling.jitter={self.jitter:g} lets spheres overlap at a spacing of "
                f"{self.lattice_spacing:g} d; choose at most {(self.lattice_spacing - 1) / 2:.3g}"
            )

    @property
    def radius(self) -> float:
        """r, m."""
        return 0.5 * self.diameter


@dataclass(frozen=True)
class Needs:
    """What of the physics a scene needs; everything else is skipped."""

    tangential: bool  # a tangential law, spin and history: only with friction
    rolling: bool  # a rolling model: only with rolling friction
    walls: bool
    wall_motion: bool  # wall velocities: only where a wall turns
    end_caps: bool
    periodic: bool
    gravity: bool

    def __str__(self) -> str:
        needed = [name for name in self.__dataclass_fields__ if getattr(self, name)]
        skipped = [name for name in self.__dataclass_fields__ if not getattr(self, name)]
        return f"needs {', '.join(needed) or 'nothing'}; skips {', '.join(skipped) or 'nothing'}"


@dataclass(frozen=True)
class Scene:
    """A container, its motion, a filling, materials, gravity and a span of time.

    Attributes:
        name: of the shipped or the user's scene.
        walls: analytic walls; ``wall -1 - second`` of a contact history indexes this tuple.
        filling: the spheres.
        material: of the particles.
        wall_material: of the walls.
        gravity: m/s².
        rotation: schedule in the scene's clock.
        start_time: label of the settled state, s.
        end_time: s.
        frame_interval: Δt between stored states, s.
        drum_radius: inner radius of the drum, m; None where there is no drum.
        length: along y, m (between the caps, or the period).
        periodic_axis: whether y wraps around.
    """

    name: str
    walls: tuple[Wall, ...]
    filling: Filling
    material: Material
    wall_material: Material
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    rotation: Rotation = field(default_factory=Rotation)
    start_time: float = 1.5
    end_time: float = 5.5
    frame_interval: float = 0.01
    drum_radius: float | None = None
    length: float | None = None
    periodic_axis: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.frame_interval) and self.frame_interval > 0):
            raise SceneError(f"scene.frame_interval={self.frame_interval:g} is impossible; choose a value > 0 s")
        if not self.end_time > self.start_time:
            raise SceneError(
                f"scene.end_time={self.end_time:g} is not after scene.start_time={self.start_time:g}; "
                "choose a later end"
            )
        if not all(map(math.isfinite, self.gravity)):
            raise SceneError(f"scene.gravity={list(self.gravity)} is not finite")

    @property
    def frame_count(self) -> int:
        """F: number of stored states, the settled one included."""
        return round((self.end_time - self.start_time) / self.frame_interval) + 1

    @property
    def period(self) -> float:
        """Length of the periodic axis y, m; 0 where nothing wraps."""
        return float(self.length) if self.periodic_axis and self.length else 0.0

    @property
    def gravity_strength(self) -> float:
        """g, m/s²."""
        return float(np.linalg.norm(self.gravity))

    @property
    def needs(self) -> Needs:
        """What this scene needs of the physics."""
        friction = max(self.material.friction, self.wall_material.friction if self.walls else 0.0)
        rolling = max(self.material.rolling_friction, self.wall_material.rolling_friction if self.walls else 0.0)
        return Needs(
            tangential=friction > 0,
            rolling=rolling > 0 and friction > 0,
            walls=bool(self.walls),
            wall_motion=not self.rotation.is_still and any(w.turns for w in self.walls),
            end_caps=any(isinstance(w, Plane) for w in self.walls),
            periodic=self.periodic_axis,
            gravity=self.gravity_strength > 0,
        )

    @property
    def critical_speed_rpm(self) -> float:
        """Speed at which a ball at the wall centrifuges, √(g/(R − r)), rpm."""
        if self.drum_radius is None:
            return math.inf
        reach = self.drum_radius - self.filling.radius
        return math.sqrt(self.gravity_strength / reach) / RADIANS_PER_SECOND_PER_RPM

    @property
    def has_angle_of_repose(self) -> bool:
        """Whether the drum stays below its critical speed, so that a surface exists."""
        fastest = self.rotation.largest_angular_speed / RADIANS_PER_SECOND_PER_RPM
        return self.drum_radius is not None and fastest < self.critical_speed_rpm

    def at_speed(self, speed_rpm: float) -> Scene:
        """The same scene turning at one constant speed from ``start_time`` on."""
        rotation = replace(self.rotation, times=(self.start_time,), speeds_rpm=(float(speed_rpm),))
        return replace(self, rotation=rotation)

    def at_rest(self) -> Scene:
        """The same scene with walls that never move, for filling and settling."""
        return replace(self, rotation=replace(self.rotation, times=(0.0,), speeds_rpm=(0.0,)))

    def fresh_filling(self, seed: int) -> ParticleState:
        """N spheres at rest on a jittered lattice in the container, without overlap, at time 0.

        Args:
            seed: of the jitter and of the choice among the topmost sites.

        Raises:
            SceneError: more spheres than sites.
        """
        filling, rng = self.filling, np.random.default_rng(seed)
        sites = self._lattice_sites()
        if len(sites) < filling.count:
            raise SceneError(
                f"scene.filling.count={filling.count} spheres of {filling.diameter:g} m do not fit; "
                f"this container has room for {len(sites)}"
            )
        # Lowest first; sites of one height in random order, so that a part-filled top layer is even.
        order = np.lexsort((rng.random(len(sites)), np.round(sites[:, 2], 9)))
        position = sites[order[: filling.count]]
        offset = rng.uniform(-1.0, 1.0, position.shape) * filling.jitter * filling.diameter
        zeros = np.zeros_like(position)
        return ParticleState(position + offset, zeros, zeros.copy(), np.full(filling.count, filling.radius))

    def _lattice_sites(self) -> FloatArray:
        """Sites of a cubic lattice whose jittered spheres stay clear of every wall, ``(S, 3)`` m."""
        if self.drum_radius is None or self.length is None:
            raise SceneError(f"scene {self.name!r} has no container to fill; give a state instead")
        spacing = self.filling.lattice_spacing * self.filling.diameter
        clear = self.filling.radius + self.filling.jitter * self.filling.diameter
        reach = self.drum_radius - clear
        across = int(reach / spacing)
        if self.periodic_axis:
            layers = int(self.length / spacing)
            y = (np.arange(layers) + 0.5) * self.length / max(layers, 1) - 0.5 * self.length
        else:
            room = self.length - 2.0 * clear
            y = np.linspace(-0.5 * room, 0.5 * room, int(room / spacing) + 1) if room > 0 else np.zeros(0)
        line = np.arange(-across, across + 1) * spacing
        grid = np.stack(np.meshgrid(line, y, line, indexing="ij"), axis=-1).reshape(-1, 3)
        jitter = self.filling.jitter * self.filling.diameter
        radial = np.hypot(np.abs(grid[:, 0]) + jitter, np.abs(grid[:, 2]) + jitter)
        return grid[radial <= self.drum_radius - self.filling.radius]


def build_scene(config: SceneConfig) -> Scene:
    """The scene that a config describes.

    Raises:
        SceneError: a value that no scene can have; the message names key, value and remedy.
    """
    box, half = config.container, 0.5 * config.container.length
    if box.kind not in ("drum", "none"):
        raise SceneError(f"scene.container.kind={box.kind!r} is unknown; choose drum or none")
    walls: list[Wall] = []
    if box.kind == "drum":
        for name in ("diameter", "length"):
            value = getattr(box, name)
            if not (math.isfinite(value) and value > 0):
                raise SceneError(f"scene.container.{name}={value:g} is impossible; choose a value > 0 m")
        walls.append(Cylinder((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.5 * box.diameter))
        if not box.periodic_axis:
            walls.append(Plane((0.0, -half, 0.0), (0.0, 1.0, 0.0)))
            walls.append(Plane((0.0, half, 0.0), (0.0, -1.0, 0.0)))
    wall_material = config.wall_material or config.material
    return Scene(
        name=config.name,
        walls=tuple(walls),
        filling=Filling(**{name: getattr(config.filling, name) for name in Filling.__dataclass_fields__}),
        material=Material.from_config(config.material),
        wall_material=Material.from_config(wall_material),
        gravity=tuple(float(g) for g in config.gravity),
        rotation=Rotation(tuple(config.rotation.times), tuple(config.rotation.speeds_rpm)),
        start_time=config.start_time,
        end_time=config.end_time,
        frame_interval=config.frame_interval,
        drum_radius=0.5 * box.diameter if box.kind == "drum" else None,
        length=box.length if box.kind == "drum" else None,
        periodic_axis=box.kind == "drum" and box.periodic_axis,
    )
