"""Analytic walls: where they are, how they move, and until when they are there.

A flat wall and an infinite cylinder contain. Every other wall is thin, with two sides: a surface of revolution, given
by a straight segment in the half plane of (distance from the axis, height along it).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from gran_bench.config.rules import Range, at_least, checked_value, positive
from gran_bench.scene.errors import SceneError, hold, scene_errors
from gran_bench.scene.motion import Motion, Rotation, Vector
from gran_bench.state import FloatArray

METRES, SIZE, ANY_SIZE = Range(unit="m"), positive("m"), at_least(0, "m")

# Sphere radii within which two points of walls are one. The contact patch has a radius of √(δ/r) sphere radii: at an
# overlap of a millionth of the radius it is as wide.
SAME_POINT = 1e-3
RIM_POINTS = 256  # by which a rim is looked at

Segment = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True, kw_only=True)
class Surface:
    """What all walls have."""

    turns: bool = True  # whether the surface moves with the scene's rotation
    # what it does instead: ``Spin``, ``Translation`` or ``Vibration``; None for nothing of its own
    motion: Motion | None = None
    # time from which the wall is not there, s; None: it stays. While a bed settles, it is there.
    opens: float | None = None

    @property
    def contains(self) -> bool:
        """Whether particles live on one side of it, so that one beyond has escaped."""
        return self.meridian is None

    @property
    def meridian(self) -> Segment | None:
        """(ρ₀, s₀) and (ρ₁, s₁) of the line that sweeps a surface of revolution, m; None for a wall without an end."""
        return None

    @property
    def direction(self) -> Vector:
        """Unit normal of a plane or a disc, unit vector along the axis of any other wall."""
        return getattr(self, "normal", None) or self.axis


@dataclass(frozen=True)
class Plane(Surface):
    """A flat wall without an end; particles live on the side that ``normal`` points to."""

    point: Vector  # a point of the plane, m
    normal: Vector  # unit normal into the container

    def __post_init__(self) -> None:
        hold(self, "plane.", unit="normal", point=METRES)


@dataclass(frozen=True)
class Cylinder(Surface):
    """The inside of an infinite cylinder, or with a length a thin tube that has two sides and two rims."""

    point: Vector  # a point on the axis, m; with a length the middle of the tube
    axis: Vector  # unit vector along the axis
    radius: float  # m
    length: float | None = None  # m; None for no end

    def __post_init__(self) -> None:
        hold(self, "cylinder.", unit="axis", point=METRES, radius=SIZE, length=SIZE)

    @property
    def meridian(self) -> Segment | None:
        """A line along the axis; None without an end."""
        half = None if self.length is None else 0.5 * self.length
        return None if half is None else ((self.radius, -half), (self.radius, half))


@dataclass(frozen=True)
class Disc(Surface):
    """A thin disc with two sides, or a ring where it has a hole."""

    point: Vector  # the middle, m
    normal: Vector  # unit vector
    radius: float  # m
    hole: float = 0.0  # radius of the hole, m

    def __post_init__(self) -> None:
        hold(self, "disc.", unit="normal", point=METRES, radius=SIZE, hole=ANY_SIZE)
        if not self.hole < self.radius:
            raise SceneError(f"disc.hole={self.hole:g} is impossible; choose a value in [0, {self.radius:g}) m")

    @property
    def meridian(self) -> Segment:
        """A line away from the axis."""
        return ((self.hole, 0.0), (self.radius, 0.0))


@dataclass(frozen=True)
class Cone(Surface):
    """A thin frustum of a cone with two sides."""

    point: Vector  # where the axis meets the first rim's plane, m
    axis: Vector  # unit vector from the first rim to the second
    radius: float  # of the first rim, m; 0 for a tip
    end_radius: float  # of the second rim, m
    length: float  # along the axis, m

    def __post_init__(self) -> None:
        hold(self, "cone.", unit="axis", point=METRES, radius=ANY_SIZE, end_radius=ANY_SIZE, length=SIZE)

    @property
    def meridian(self) -> Segment:
        """The line that sweeps the cone."""
        return ((self.radius, 0.0), (self.end_radius, self.length))


Wall = Plane | Cylinder | Disc | Cone


def turns_into_itself(wall: Wall, axis: Vector, point: Vector) -> bool:
    """Whether a wall has the same shape after any rotation about an axis through a point."""
    offset = tuple(a - b for a, b in zip(wall.point, point, strict=True))
    aligned = _length_of_cross(axis, wall.direction) < 1e-9
    if isinstance(wall, Plane):
        return aligned
    return aligned and _length_of_cross(offset, axis) < 1e-9 * max(wall.radius, getattr(wall, "end_radius", 0.0))


def _length_of_cross(a: Vector, b: Vector) -> float:
    # Many times as fast as NumPy's for two single vectors, and asked for at every frame.
    return math.hypot(a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def box(lower: Vector, upper: Vector, **common: object) -> tuple[Plane, ...]:
    """The six planes of a box between two corners, m, at −x, +x, −y, +y, −z, +z.

    All six have in ``common``: ``turns``, ``motion``, ``opens``.

    Raises:
        SceneError: a box without room.
    """
    with scene_errors():
        lower, upper = (checked_value(Vector, METRES, v, f"box.{n}") for n, v in (("lower", lower), ("upper", upper)))
    if not all(a < b for a, b in zip(lower, upper, strict=True)):
        raise SceneError(f"box from {list(lower)} to {list(upper)} has no room; give an upper corner above the lower")
    sides = ((axis, corner, sign) for axis in range(3) for corner, sign in ((lower, 1.0), (upper, -1.0)))
    return tuple(Plane(c, tuple(sign if k == axis else 0.0 for k in range(3)), **common) for axis, c, sign in sides)


def surface_of_revolution(
    point: Vector, axis: Vector, profile: Sequence[tuple[float, float]], **common: object
) -> tuple[Cone | Disc, ...]:
    """Thin walls whose meridian is a polyline: a cone for each of its segments, a disc or ring for a level one.

    Args:
        point, axis: where the axis has s = 0, m, and unit vector along it.
        profile: (ρ, s) of each corner, m: distance from the axis, and height along it.
        common: what all pieces have: ``turns``, ``motion``, ``opens``.

    Raises:
        SceneError: fewer than two corners, or a segment without length.
    """
    if len(profile) < 2:
        raise SceneError(f"surface of revolution: profile={list(profile)} is no line; give two corners or more")
    pieces: list[Cone | Disc] = []
    for (rho, s), (end_rho, end_s) in pairwise(profile):
        if s > end_s:
            rho, s, end_rho, end_s = end_rho, end_s, rho, s
        foot = tuple(p + s * a for p, a in zip(point, axis, strict=True))
        if s < end_s:
            pieces.append(Cone(foot, axis, rho, end_rho, end_s - s, **common))
        else:
            pieces.append(Disc(foot, axis, max(rho, end_rho), min(rho, end_rho), **common))
    return tuple(pieces)


@dataclass(frozen=True)
class Outlet:
    """A plane through which spheres leave: one whose centre is beyond it at a frame takes no further part."""

    point: Vector  # the middle of the outlet, m
    normal: Vector  # unit vector towards the spheres that are still in
    # m; one that leaves farther than this from the middle came through a wall, which is an error. None: wherever.
    radius: float | None = None

    def __post_init__(self) -> None:
        hold(self, "outlet.", unit="normal", point=METRES, radius=SIZE)


def surfaces(
    walls: tuple[Wall, ...], motions: tuple[Rotation | Motion | None, ...], tolerance: float
) -> tuple[int, ...]:
    """Number of the surface that each wall is a piece of, from 1; 0 for a wall that meets no other.

    Walls meet within ``tolerance``, m. Walls that travel relative to each other may meet.
    """
    number = list(range(len(walls)))
    moving = [travels(wall, motion) for wall, motion in zip(walls, motions, strict=True)]
    for a, one in enumerate(walls):
        for b in range(a):
            together = motions[a] == motions[b] or not (moving[a] or moving[b])
            if number[a] != number[b] and _meet(one, walls[b], tolerance, together):
                number = [number[b] if n == number[a] else n for n in number]
    shared = [n for n in dict.fromkeys(number) if number.count(n) > 1]
    return tuple(shared.index(n) + 1 if n in shared else 0 for n in number)


def travels(wall: Wall, motion: Rotation | Motion | None) -> bool:
    """Whether a wall's shape goes elsewhere, and not only its surface along it."""
    turning = isinstance(motion, Rotation) and turns_into_itself(wall, motion.axis, motion.point)
    return motion is not None and not turning


def _meet(one: Wall, other: Wall, tolerance: float, together: bool) -> bool:
    """Whether two walls share an edge, or may come to share one."""
    if one.contains and other.contains:
        if type(one) is not type(other) or not np.allclose(np.cross(one.direction, other.direction), 0.0):
            return False
        if isinstance(one, Plane):
            facing = np.dot(one.normal, other.normal) > 0.0
            return facing and (not together or _distance(other, np.array([one.point]))[0] <= tolerance)
        apart = np.cross(np.subtract(one.point, other.point), other.axis)
        return abs(one.radius - other.radius) <= tolerance and (not together or np.linalg.norm(apart) <= tolerance)
    return not together or any(
        _distance(second, points).min() <= tolerance + gap
        for first, second in ((one, other), (other, one))
        for points, gap in _rims(first)
    )


def _rims(wall: Wall) -> list[tuple[FloatArray, float]]:
    """Points of each rim, ``(256, 3)`` m, and half the arc from one to the next."""
    axis, angle = np.asarray(wall.direction), 2.0 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS
    across = any_normal_to(axis)
    around = np.outer(np.cos(angle), across) + np.outer(np.sin(angle), np.cross(axis, across))
    return [(wall.point + rho * around + s * axis, np.pi * rho / RIM_POINTS) for rho, s in wall.meridian or ()]


def _distance(wall: Wall, points: FloatArray) -> FloatArray:
    """Of points from a wall where it is drawn, ``(P,)`` m."""
    offset, direction = points - wall.point, np.asarray(wall.direction)
    along = offset @ direction
    if isinstance(wall, Plane):
        return np.abs(along)
    reach = np.linalg.norm(offset - np.outer(along, direction), axis=1)
    if wall.meridian is None:
        return np.abs(reach - wall.radius)
    return np.hypot(*toward_segment(np.ravel(wall.meridian), reach, along))


def toward_segment(segment: FloatArray, reach: FloatArray, along: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Way to the closest point of (ρ₀, s₀, ρ₁, s₁) in the half plane, from points at (ρ, s) = (reach, along), m."""
    r0, s0, r1, s1 = segment
    dr, ds = r1 - r0, s1 - s0
    share = np.clip(((reach - r0) * dr + (along - s0) * ds) / (dr * dr + ds * ds), 0.0, 1.0)
    return r0 + share * dr - reach, s0 + share * ds - along


def any_normal_to(direction: FloatArray) -> FloatArray:
    """A unit vector across a unit vector, the same every time: where all ways out from an axis are alike."""
    across = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    return across / np.linalg.norm(across)
