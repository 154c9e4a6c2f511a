"""Angle of repose of a bed in a drum, by two published definitions, each with its validity.

Both are measured in the plane across the axis, from the horizontal, positive where the bed has climbed with the
rotation, along e = axis × gravity.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from gran_bench.config.registry import register_metric
from gran_bench.config.rules import check_arguments
from gran_bench.metrics.measured import Series
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, Trajectory

BIN = 0.25  # of a diameter, across the surface
HALF_WINDOW = 0.6  # of the drum's radius: 0.3 m along the surface of the drum of 1 m
SURFACE_FRACTION = 0.3  # solid fraction at the surface
LARGEST_RESIDUAL = 0.5  # of a diameter, rms of the line's residuals
LEAST_FILLED = 0.8  # of the columns
WIDER = 1e-6  # relative; spheres that exceed the scene's largest by more count in several columns
TOLERANCE = 1e-4  # rad, of the iteration
MOST_ITERATIONS = 40


@dataclass(frozen=True)
class SurfaceLine:
    """The straight line w = offset + 0·s through a bed's surface, in the frame turned by ``angle``."""

    angle: float  # rad, NaN where there is no line
    offset: float  # m, height of the line over the axis, along the surface's normal
    residual: float  # m, rms distance of the columns' surface points from the line
    filled: float  # share of the columns that have a surface
    valid: bool  # residual ≤ 0.5 d and filled ≥ 80 %


NO_LINE = SurfaceLine(math.nan, math.nan, math.nan, 0.0, False)


def why_no_angle(scene: Scene) -> str:
    """Why no angle of repose exists in a scene, whatever a fit says; empty where one may exist."""
    if scene.drum_radius is None or scene.length is None:
        return "the scene has no drum"
    if not scene.needs.gravity:
        return "the scene has no gravity"
    if not scene.filling.count:
        return "the scene has no spheres"
    critical = f"at or above the critical speed of {scene.critical_speed_rpm:.3g} rpm"
    return "" if scene.has_angle_of_repose else critical


def cross_section_axes(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Unit vectors ``(3,)`` across the drum: climbing (with the rotation) and up; a `ValueError` without gravity."""
    if not scene.needs.gravity:
        raise ValueError(f"scene {scene.name!r} has no gravity, so nothing is up; choose scene.gravity")
    down = np.asarray(scene.gravity, float) / scene.gravity_strength
    climbing = np.cross(scene.rotation.axis, down)
    turning = next((speed for speed in scene.rotation.speeds_rpm if speed), 1.0)
    return math.copysign(1.0, turning) * climbing / np.linalg.norm(climbing), -down


def center_of_mass_angles(position: FloatArray, radius: FloatArray, scene: Scene) -> FloatArray:
    """Angle between gravity and the offset of the bed's centre c from the axis, tan θ = (c·e)/(c·g/|g|), ``(F,)`` rad.

    Args:
        position: ``(F, N, 3)`` m; a frame that is not finite gives NaN.
        radius: ``(N,)`` m; the spheres have one density.
        scene: gives the axis, gravity (a `ValueError` without) and the sense of rotation.
    """
    position, radius = np.asarray(position), np.asarray(radius)
    climbing, up = cross_section_axes(scene)
    mass = radius.astype(np.float64) ** 3
    with np.errstate(invalid="ignore", over="ignore"):
        center = np.einsum("fnk,n->fk", position, mass / mass.sum())
        angle = np.arctan2(center @ climbing, -(center @ up))
    # An infinite centre has an arctangent, but no angle.
    return np.where(np.isfinite(center).all(axis=1), angle, np.nan)


def surface_lines(
    position: FloatArray, radius: FloatArray, scene: Scene, start_angles: FloatArray | None = None
) -> list[SurfaceLine]:
    """The surface of every frame: a least-squares line through the topmost crossings of solid fraction 0.3.

    In the frame turned by the current angle, columns of one diameter cover |s| ≤ 0.6 R along the surface, with
    bins of d/4 across it. A sphere counts in the column of its centre (a wider one: `solid_fractions`); a bin's solid
    fraction is the exact volume of the sphere slabs in it over its own volume. The line's angle is added until it
    changes by ≤ 1e-4 rad.

    Args:
        position: ``(F, N, 3)`` m; a frame that is not finite has no line.
        radius: ``(N,)`` m.
        scene: a drum with gravity; a `ValueError` else.
        start_angles: ``(F,)`` rad; the centre-of-mass angles where None.
    """
    if scene.drum_radius is None or scene.length is None:
        raise ValueError(f"scene {scene.name!r} has no drum, so its beds have no surface; choose a drum")
    position, size = np.asarray(position), np.asarray(radius).astype(np.float64)
    plane = np.stack(cross_section_axes(scene), axis=1)
    if start_angles is None:
        start_angles = center_of_mass_angles(position, radius, scene)
    return [
        _surface_line(frame @ plane, size, scene, float(angle)) if np.isfinite(frame).all() else NO_LINE
        for frame, angle in zip(position.astype(np.float64), start_angles, strict=True)
    ]


def _surface_line(across: FloatArray, radius: FloatArray, scene: Scene, angle: float) -> SurfaceLine:
    """Of one bed, whose centres ``(N, 2)`` lie along the climbing direction and up."""
    line, seen = NO_LINE, []
    for _ in range(MOST_ITERATIONS):
        line, tilt = _fit(across, radius, scene, angle)
        if not math.isfinite(tilt):
            return line
        angle = line.angle
        if abs(tilt) <= TOLERANCE:
            return line
        again = next((k for k, before in enumerate(seen) if abs(angle - before) < 1e-12), None)
        if again is not None:
            # Spheres that change columns can make the iteration circle through a few angles for ever (in one state
            # of seven, over 0.5° in the mean): the middle of the circle is the answer.
            middle = float(np.mean(seen[again:]))
            return replace(_fit(across, radius, scene, middle)[0], angle=middle)
        seen.append(angle)
    return replace(line, valid=False)


def solid_fractions(
    s: FloatArray, w: FloatArray, radius: FloatArray, scene: Scene
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Solid fraction of the bins of d × d/4 over the drum's length, from the exact volumes of sphere slabs.

    A sphere counts in the column of its centre. A coarse-grained one, larger than all of the scene, would leave gaps
    beside it, so it is cut into discs of about d/4 along the surface, and each counts in its own column.

    Args:
        s, w: ``(N,)`` centres along the surface, and along its normal from the axis, m.
        radius: ``(N,)`` m.
        scene: a drum of radius R, its length, and d.

    Returns:
        Middles of the C columns along the surface (m), middles of the B bins across it (m), and ``(C, B)`` −.
    """
    drum_radius, diameter = scene.drum_radius, scene.filling.diameter
    columns, step = max(2, int(2.0 * HALF_WINDOW * drum_radius / diameter + 1e-9)), BIN * diameter
    half = 0.5 * columns * diameter
    lowest = -math.ceil((drum_radius + 0.5 * diameter + radius.max(initial=0.0)) / step)
    bins = -2 * lowest

    def volumes(s: FloatArray, w: FloatArray, radius: FloatArray, thickness: FloatArray | None = None) -> FloatArray:
        """In the bins, ``(C B,)`` m³: of spheres, or of discs along the surface with a thickness."""
        column = np.floor((s + half) / diameter)
        inside = (column >= 0) & (column < columns) & (np.abs(w) <= drum_radius)
        column, bottom, size = column[inside].astype(np.int64), w[inside] - radius[inside], radius[inside]
        first = np.floor(bottom / step)
        slabs = math.ceil(2.0 * size.max(initial=0.0) / step) + 1
        edges = (first + np.arange(1, slabs + 1)[:, None]) * step
        height = np.clip(edges - bottom, 0.0, 2.0 * size)  # of each slab's upper plane over a body's lowest point
        index = column * bins + (first.astype(np.int64) - lowest) + np.arange(slabs)[:, None]
        below = _cap(height, size) if thickness is None else thickness[inside] * _segment(height, size)
        slab_volume = np.diff(below, axis=0, prepend=0.0).ravel()
        return np.bincount(index.ravel(), slab_volume, minlength=columns * bins)

    wide = radius > scene.filling.largest_radius * (1.0 + WIDER)
    volume = volumes(s[~wide], w[~wide], radius[~wide])
    if wide.any():
        number, size = math.ceil(2.0 * radius.max() / step), radius[wide, None]
        place = (2.0 * np.arange(number) + 1.0) / number - 1.0  # of the discs, in radii of their sphere
        share = np.sqrt(1.0 - place**2)  # radius, likewise
        thickness = 4.0 / 3.0 / (share**2).sum() * size + 0.0 * place  # all together have the sphere's volume
        along, across = s[wide, None] + place * size, w[wide, None] + 0.0 * place
        volume = volume + volumes(*(values.ravel() for values in (along, across, share * size, thickness)))
    middles = (np.arange(columns) + 0.5) * diameter - half
    fraction = volume.reshape(columns, bins) / (diameter * step * scene.length)
    return middles, (np.arange(bins) + lowest + 0.5) * step, fraction


def _cap(height: FloatArray, radius: FloatArray) -> FloatArray:
    """Volume of a cap of a sphere, m³."""
    return math.pi / 3.0 * height**2 * (3.0 * radius - height)


def _segment(height: FloatArray, radius: FloatArray) -> FloatArray:
    """Area of a segment of a disc, m²."""
    x = np.clip(height / radius - 1.0, -1.0, 1.0)
    return radius**2 * (np.arccos(-x) + x * np.sqrt(1.0 - x**2))


def topmost_crossing(fraction: FloatArray, heights: FloatArray) -> FloatArray:
    """Height at which each column falls below solid fraction 0.3 for the last time, ``(C,)`` m, interpolated.

    Of ``(C, B)`` solid fractions at ``(B,)`` heights; NaN for a column that never reaches the fraction, or is still
    above it in its last bin.
    """
    dense = fraction >= SURFACE_FRACTION
    last = fraction.shape[1] - 1
    top = last - np.argmax(dense[:, ::-1], axis=1)
    row = np.arange(len(fraction))
    here, above = fraction[row, top], fraction[row, np.minimum(top + 1, last)]
    drop = np.where(here > above, here - above, 1.0)
    height = heights[top] + (heights[1] - heights[0]) * (here - SURFACE_FRACTION) / drop
    return np.where(dense.any(axis=1) & (top < last), height, np.nan)


@dataclass(frozen=True)
class SurfaceAngle(Series):
    """The surface angle of every state, and the ``lines`` behind it, valid or not: a depth needs a surface."""

    lines: list[SurfaceLine] = field(default_factory=list)


@register_metric("angle of repose", "deg")
def surface_angle(trajectory: Trajectory, scene: Scene) -> Series:
    """Angle of the bed's surface in every state, by `surface_lines`, degrees.

    Lines are fitted wherever there is a drum and gravity, also where no angle of repose exists.
    """
    if (nothing := _without_drum(trajectory, scene)) is not None:
        return nothing
    lines = surface_lines(trajectory.position, trajectory.radius, scene)
    value = np.degrees([line.angle if line.valid else math.nan for line in lines])
    return SurfaceAngle(trajectory.time, value, "deg", why_no_angle(scene), "no straight surface", lines)


@register_metric("centre-of-mass angle", "deg")
def com_angle(trajectory: Trajectory, scene: Scene) -> Series:
    """Angle of the bed's centre of mass in every state, by `center_of_mass_angles`, degrees."""
    if (nothing := _without_drum(trajectory, scene)) is not None:
        return nothing
    value = np.degrees(center_of_mass_angles(trajectory.position, trajectory.radius, scene))
    return Series(trajectory.time, value, "deg", why_no_angle(scene), "not finite")


def _without_drum(trajectory: Trajectory, scene: Scene) -> Series | None:
    """The undefined series of a scene in which nothing can be fitted."""
    check_arguments(trajectory=(trajectory, Trajectory), scene=(scene, Scene))
    if scene.drum_radius is not None and scene.length is not None and scene.needs.gravity:
        return None
    return Series(trajectory.time, np.full(trajectory.frame_count, np.nan), "deg", why_no_angle(scene))


def _fit(across: FloatArray, radius: FloatArray, scene: Scene, angle: float) -> tuple[SurfaceLine, float]:
    """One fit in the frame turned by ``angle``: the line, its angle included, and by how much it was turned, rad."""
    cosine, sine = math.cos(angle), math.sin(angle)
    s, w = across[:, 0] * cosine + across[:, 1] * sine, across[:, 1] * cosine - across[:, 0] * sine
    middle, heights, fraction = solid_fractions(s, w, radius, scene)
    height = topmost_crossing(fraction, heights)
    found = np.isfinite(height)
    filled = float(found.mean())
    if found.sum() < 2:
        return replace(NO_LINE, filled=filled), math.nan
    x, y = middle[found], height[found]
    x_mean, y_mean = x.mean(), y.mean()
    slope = float(((x - x_mean) * (y - y_mean)).sum() / ((x - x_mean) ** 2).sum())
    offset = y_mean - slope * x_mean
    residual = float(np.sqrt(np.mean((y - offset - slope * x) ** 2)))
    tilt = math.atan(slope)
    valid = residual <= LARGEST_RESIDUAL * scene.filling.diameter and filled >= LEAST_FILLED
    return SurfaceLine(angle + tilt, float(offset * math.cos(tilt)), residual, filled, valid), tilt
