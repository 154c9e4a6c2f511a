"""A scene: a container and its motion, a filling, materials, gravity and a span of time."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from gran_bench.config import SEED, SceneConfig
from gran_bench.config.consistency import check_coarse_graining, check_end, check_frames
from gran_bench.config.rules import at_least, checked_value, positive
from gran_bench.scene.errors import SceneError, hold, scene_errors
from gran_bench.scene.filling import Filling, Room, drum_sites, open_sites, room_sites
from gran_bench.scene.material import Material, PairCoefficients
from gran_bench.scene.motion import RADIANS_PER_SECOND_PER_RPM, Motion, Rotation
from gran_bench.scene.walls import SAME_POINT, Outlet, Plane, Wall, surfaces, travels
from gran_bench.state import FloatArray, ParticleState

# Spacings of the first lattice, in diameters, that coarse spheres are given where the scene's own does not fit.
CLOSER = (1.08, 1.05, 1.02)


@dataclass(frozen=True)
class Needs:
    """What of the physics a scene needs; everything else is skipped."""

    tangential: bool  # a tangential law, spin and history: only with friction
    rolling: bool  # a rolling model: only with rolling friction
    walls: bool
    wall_motion: bool  # wall velocities: only where a wall's surface moves
    wall_geometry: bool  # walls that are elsewhere, or gone, in the next step
    wall_seams: bool  # walls that are pieces of one surface, which answers a sphere once
    end_caps: bool
    periodic: bool
    gravity: bool
    materials: bool  # several particle materials, a law for each pair of them
    polydispersity: bool  # several radii
    outlet: bool  # spheres that leave

    def __str__(self) -> str:
        needed = [name for name, needs in vars(self).items() if needs]
        skipped = [name for name, needs in vars(self).items() if not needs]
        return f"needs {', '.join(needed) or 'nothing'}; skips {', '.join(skipped) or 'nothing'}"


@dataclass(frozen=True)
class FineSpheres:
    """What coarse-grained spheres stand for; fields as in `Scene`."""

    filling: Filling
    material: Material
    wall_material: Material


@dataclass(frozen=True)
class Scene:
    """A container, its motion, a filling, materials, gravity and a span of time."""

    name: str  # of the shipped or the user's scene
    walls: tuple[Wall, ...]  # analytic walls; ``wall -1 - second`` of a contact history indexes this tuple
    filling: Filling  # the spheres
    material: Material  # of the particles, of the first kind
    wall_material: Material  # of the walls
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)  # m/s²
    rotation: Rotation = field(default_factory=Rotation)  # schedule in the scene's clock
    start_time: float = 1.5  # label of the settled state, s
    end_time: float = 5.5  # s
    frame_interval: float = 0.01  # Δt between stored states, s
    drum_radius: float | None = None  # inner radius of the drum, m; None where there is no drum
    length: float | None = None  # along y, m (between the caps, or the period)
    periodic_axis: bool = False  # whether y wraps around
    # of further kinds of particles; ``ParticleState.material`` indexes ``materials``.
    more_materials: tuple[Material, ...] = ()
    # of two different particle materials, where the geometric mean is not wanted
    pair_coefficients: tuple[PairCoefficients, ...] = ()
    room: Room | None = None  # where the first lattice stands in a container that is no drum; None for open space
    outlet: Outlet | None = None  # where spheres leave; None where none do
    fine_spheres: FineSpheres | None = None  # that coarse-grained ones stand for; None where none are

    def __post_init__(self) -> None:
        # A config's name becomes a folder; a scene made in Python is called as its author likes.
        hold(self, SceneConfig.place, SceneConfig, name=None, drum_radius=positive("m"), length=positive("m"))
        with scene_errors():
            check_end(self)
        if len(self.filling.fractions) > len(self.materials):
            raise SceneError(
                f"scene.filling.fractions={list(self.filling.fractions)} shares out more materials than the scene's "
                f"{len(self.materials)}; describe the others or leave their shares out"
            )
        for pair in self.pair_coefficients:
            if not 0 <= min(pair.first, pair.second) <= max(pair.first, pair.second) < len(self.materials):
                raise SceneError(
                    f"pair coefficients of materials {pair.first} and {pair.second} name one that the scene does not "
                    f"have; it has {len(self.materials)}"
                )

    @property
    def materials(self) -> tuple[Material, ...]:
        """Of the particles; ``ParticleState.material`` indexes this tuple."""
        return (self.material, *self.more_materials)

    def coefficients(self, first: int, second: int) -> tuple[float, float, float]:
        """(e, μ, μ_r) of contacts between particles of two materials.

        A material meets itself with its own coefficients. Two materials meet with the geometric means, unless
        ``pair_coefficients`` say otherwise: that is a convention, so give what was measured where a pair was.
        """
        one, other = self.materials[first], self.materials[second]
        own = next((pair for pair in self.pair_coefficients if {pair.first, pair.second} == {first, second}), None)

        def of(name: str) -> float:
            given = getattr(own, name, None)
            return math.sqrt(getattr(one, name) * getattr(other, name)) if given is None else given

        return of("restitution"), of("friction"), of("rolling_friction")

    @property
    def frame_count(self) -> int:
        """F: number of stored states, the settled one included.

        Raises:
            SceneError: a span that is no whole number of frames.
        """
        with scene_errors():
            check_frames(self)
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
    def fall_time(self) -> float:
        """√(d/g), the time of reference, s.

        Raises:
            SceneError: a scene without gravity.
        """
        return math.sqrt(self.filling.diameter / self._gravity("the time √(d/g)", "filling.longest_settling"))

    @property
    def settled_speed(self) -> float:
        """Root mean square of the speeds that a bed at rest stays below, m/s.

        Raises:
            SceneError: a Froude number in a scene without gravity.
        """
        filling = self.filling
        if filling.settled_speed is not None:
            return filling.settled_speed
        return filling.settled_froude * math.sqrt(
            self._gravity("scene.filling.settled_froude", "filling.settled_speed") * filling.diameter
        )

    @property
    def longest_settling(self) -> float:
        """Time after which a bed that is not at rest is an error, s; raises as :attr:`fall_time` does."""
        filling = self.filling
        if filling.longest_settling is not None:
            return filling.longest_settling
        return filling.longest_settling_fall_times * self.fall_time

    def _gravity(self, what: str, absolute: str) -> float:
        if strength := self.gravity_strength:
            return strength
        raise SceneError(f"scene.gravity is 0, and {what} is measured with it; give scene.{absolute}")

    @property
    def needs(self) -> Needs:
        """What this scene needs of the physics."""
        kinds = range(len(self.materials))
        meetings = [self.coefficients(a, b) for a in kinds for b in kinds if a <= b]
        if self.walls:
            meetings.append((1.0, self.wall_material.friction, self.wall_material.rolling_friction))
        _, friction, rolling = map(max, zip(*meetings, strict=True))
        return Needs(
            tangential=friction > 0,
            rolling=rolling > 0 and friction > 0,
            walls=bool(self.walls),
            wall_motion=any(self.motion_of(wall) is not None for wall in self.walls),
            wall_geometry=any(w.opens is not None or travels(w, self.motion_of(w)) for w in self.walls),
            wall_seams=any(self.surfaces),
            end_caps=self.drum_radius is not None and any(isinstance(w, Plane) for w in self.walls),
            periodic=self.periodic_axis,
            gravity=self.gravity_strength > 0,
            materials=bool(self.more_materials),
            polydispersity=self.filling.smallest_radius < self.filling.largest_radius,
            outlet=self.outlet is not None,
        )

    def motion_of(self, wall: Wall) -> Rotation | Motion | None:
        """What a wall does: its own motion, or the scene's rotation; None where it rests for ever."""
        motion = self.rotation if wall.motion is None and wall.turns else wall.motion
        return None if motion is None or motion.is_still else motion

    @cached_property
    def surfaces(self) -> tuple[int, ...]:
        """Number of the surface that each wall is a piece of, from 1; 0 for a wall that meets no other."""
        motions = tuple(map(self.motion_of, self.walls))
        return surfaces(self.walls, motions, SAME_POINT * self.filling.largest_radius)

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

    @property
    def takes_speeds(self) -> bool:
        """Whether the cases of a data set give it their speeds: a drum that has no schedule of its own."""
        return self.drum_radius is not None and len(set(self.rotation.speeds_rpm)) == 1

    @property
    def fall_height(self) -> float | None:
        """The farthest that a sphere can fall inside, m; None in open space."""
        if self.drum_radius is not None:
            return 2.0 * self.drum_radius
        return None if self.room is None else self.room.upper[2] - self.room.lower[2]

    @property
    def fine(self) -> Scene:
        """The scene that coarse-grained spheres stand for; itself where none are."""
        return self if self.fine_spheres is None else replace(self, **vars(self.fine_spheres), fine_spheres=None)

    @property
    def coarse_graining(self) -> float:
        """f: diameter over the diameter that it stands for, −."""
        return self.filling.diameter / self.fine.filling.diameter

    @property
    def spheres(self) -> str:
        """``3000 spheres of 50 mm``, or ``coarse-grained: 889 spheres of 75 mm for 3000 of 50 mm``."""
        fine = self.fine.filling
        stand_for = str(fine).replace(" spheres", "")
        return str(self.filling) if self.fine_spheres is None else f"coarse-grained: {self.filling} for {stand_for}"

    def coarse_grained(
        self, factor: float, friction: float | None = None, rolling_friction: float | None = None
    ) -> Scene:
        """The scene with N/f³ spheres of f d in the place of N of d, of the same material: stresses scale, E stays.

        Source: Bierwisch et al., J. Mech. Phys. Solids 57 (2009) 10–31.

        Args:
            factor: f ≥ 1, −.
            friction, rolling_friction: μ, μ_r of the coarse spheres, and of walls of the same material, −; None: as
                they are.

        Raises:
            SceneError: spheres that are placed, or too few that are left.
        """
        with scene_errors():
            factor = checked_value(float, at_least(1), factor, "scene.coarse_graining")
            check_coarse_graining(factor, self.fine.filling)
        fine, given = self.fine, {"friction": friction, "rolling_friction": rolling_friction}
        count, diameter = round(fine.filling.count / factor**3), factor * fine.filling.diameter
        material = replace(fine.material, **{name: value for name, value in given.items() if value is not None})
        wall = material if fine.wall_material == fine.material else fine.wall_material
        spheres = FineSpheres(fine.filling, fine.material, fine.wall_material)
        # Few large spheres fit a container less well, and the first lattice says nothing of the bed.
        for spacing in (fine.filling.lattice_spacing, *CLOSER):
            jitter = min(fine.filling.jitter, 0.5 * (spacing - 1.0))
            filling = replace(fine.filling, count=count, diameter=diameter, lattice_spacing=spacing, jitter=jitter)
            coarse = replace(fine, filling=filling, material=material, wall_material=wall, fine_spheres=spheres)
            if (room := len(coarse._sites())) >= count:
                return coarse
        raise SceneError(
            f"scene.coarse_graining={factor:g} leaves {count} spheres of {diameter:g} m, and the first lattice of this "
            f"container has room for {room}; choose less"
        )

    def at_speed(self, speed_rpm: float) -> Scene:
        """The same scene turning at one constant speed from ``start_time`` on.

        Raises:
            SceneError: a speed that is no finite number.
        """
        rotation = replace(self.rotation, times=(self.start_time,), speeds_rpm=(speed_rpm,))
        return replace(self, rotation=rotation)

    def at_rest(self) -> Scene:
        """The same scene with walls that never move or open, for filling and settling."""
        walls = tuple(replace(wall, motion=None, opens=None) for wall in self.walls)
        return replace(self, walls=walls, rotation=replace(self.rotation, times=(0.0,), speeds_rpm=(0.0,)))

    def fresh_filling(self, seed: int) -> ParticleState:
        """N spheres in the container without overlap, at time 0: on a jittered lattice, or where they are placed.

        The seed is of the jitter, the choice among the topmost sites, and which sphere has which size and material.

        Raises:
            SceneError: more spheres than sites, or a seed that is no whole number ≥ 0.
        """
        with scene_errors():
            seed = checked_value(int, SEED, seed, "seed")
        filling, rng = self.filling, np.random.default_rng(seed)
        position = np.array(filling.positions) if filling.positions else self._on_lattice(rng)
        radius = filling.radii or filling.radius * filling.sizes.sample(filling.count, rng)
        velocity, spin = (np.array(g) if g else np.zeros_like(position) for g in (filling.velocities, filling.spins))
        velocity = velocity + filling.expansion * position
        return ParticleState(position, velocity, spin, np.array(radius), material=filling.materials(rng))

    def _sites(self) -> FloatArray:
        """Of the first lattice, ``(S, 3)`` m."""
        filling = self.filling
        if self.drum_radius is not None and self.length is not None:
            return drum_sites(filling, self.drum_radius, self.length, self.periodic_axis)
        if self.room is not None:
            return room_sites(filling, self.room)
        if self.walls:
            raise SceneError(f"scene {self.name!r} has no container to fill; give a state or scene.filling.positions")
        return open_sites(filling)

    def _on_lattice(self, rng: np.random.Generator) -> FloatArray:
        filling, sites = self.filling, self._sites()
        if len(sites) < filling.count:
            raise SceneError(
                f"scene.filling.count={filling.count} spheres do not fit: the lattice that they start from has room "
                f"for {len(sites)}, at scene.filling.lattice_spacing={filling.lattice_spacing:g} times the largest "
                f"diameter, {2 * filling.largest_radius:g} m; choose fewer or smaller spheres, a larger container, or "
                "a smaller lattice_spacing > 1 (with jitter at most half of what is above 1)"
            )
        # Lowest first; sites of one height in random order, so that a part-filled top layer is even.
        order = np.lexsort((rng.random(len(sites)), np.round(sites[:, 2] / filling.spacing, 7)))
        position = sites[order[: filling.count]]
        return position + rng.uniform(-1.0, 1.0, position.shape) * filling.offset
