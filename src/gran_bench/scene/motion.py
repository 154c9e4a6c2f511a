"""How walls move: schedules that are piecewise linear in time, and sinusoidal vibration.

Every motion is a pure function of the scene's clock, so that a run that goes on from a frame finds its walls where
the run that did not stop had them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gran_bench.config import RotationConfig
from gran_bench.config.consistency import check_schedule
from gran_bench.config.rules import Range, at_least
from gran_bench.scene.errors import hold, scene_errors
from gran_bench.state import FloatArray

RADIANS_PER_SECOND_PER_RPM = 2.0 * math.pi / 60.0

Vector = tuple[float, float, float]
SECONDS = Range(unit="s")


def rate_at(times: Sequence[float], rates: Sequence[float], time: FloatArray) -> FloatArray:
    """A schedule's rate: 0 before the first knot, piecewise linear, constant after the last; shape of ``time``."""
    return np.where(np.asarray(time) < times[0], 0.0, np.interp(time, times, rates))[()]


def integral_to(times: Sequence[float], rates: Sequence[float], time: FloatArray) -> FloatArray:
    """∫ of a schedule's rate from its first knot to each time; exact, 0 before the first knot."""
    knots, values, time = np.asarray(times, float), np.asarray(rates, float), np.asarray(time, float)
    passed = np.concatenate(([0.0], np.cumsum(0.5 * np.diff(knots) * (values[1:] + values[:-1]))))
    last = np.clip(np.searchsorted(knots, time, side="right") - 1, 0, len(knots) - 1)
    # From the last knot passed: the mean of both ends' rates. Right of a jump, its second value counts.
    since = np.maximum(0.0, time - knots[last])
    return passed[last] + 0.5 * since * (values[last] + np.interp(time, knots, values))


@dataclass(frozen=True)
class Rotation:
    """Rotation of the scene about an axis through the origin: at rest before the first knot, piecewise linear between
    knots, constant after the last.
    """

    times: tuple[float, ...] = (0.0,)  # knots, s, increasing (equal times make a jump)
    speeds_rpm: tuple[float, ...] = (0.0,)  # speed at each knot, revolutions a minute; positive turns +z into +x
    axis: Vector = (0.0, 1.0, 0.0)  # unit vector

    def __post_init__(self) -> None:
        place = RotationConfig.place if type(self) is Rotation else "spin."
        hold(self, place, RotationConfig, unit="axis")
        with scene_errors():
            check_schedule(self.times, self.speeds_rpm, f"{place}speeds_rpm", f"{place}times")

    def angular_speed(self, time: FloatArray | float) -> FloatArray | float:
        """ω(t), rad/s; at each time of an array."""
        return rate_at(self.times, self.speeds_rpm, time) * RADIANS_PER_SECOND_PER_RPM

    def angle(self, start: float, end: float) -> float:
        """Angle turned between two times, ∫ω dt, rad; exact for the piecewise linear schedule."""
        before, after = self.angles(np.array([start, end]))
        return float(after - before)

    def angles(self, time: FloatArray) -> FloatArray:
        """Angle turned from the first knot to each time, rad."""
        return integral_to(self.times, self.speeds_rpm, time) * RADIANS_PER_SECOND_PER_RPM

    @property
    def point(self) -> Vector:
        """A point of the axis, m."""
        return getattr(self, "center", (0.0, 0.0, 0.0))

    @property
    def is_still(self) -> bool:
        """Whether nothing ever turns."""
        return not any(self.speeds_rpm)

    @property
    def is_constant(self) -> bool:
        """Whether there is one speed, from the first knot on."""
        return len(set(self.speeds_rpm)) == 1

    @property
    def largest_angular_speed(self) -> float:
        """max |ω|, rad/s."""
        return max(abs(s) for s in self.speeds_rpm) * RADIANS_PER_SECOND_PER_RPM


@dataclass(frozen=True)
class Spin(Rotation):
    """Rotation of one wall about an axis of its own; a schedule as a scene's."""

    center: Vector = (0.0, 0.0, 0.0)  # a point of the axis, m


@dataclass(frozen=True)
class Translation:
    """A wall that moves without turning; its velocity is piecewise linear in time."""

    times: tuple[float, ...]  # knots, s; at rest before the first, constant after the last (equal times make a jump)
    velocities: tuple[Vector, ...]  # ``(K, 3)`` at each knot, m/s

    def __post_init__(self) -> None:
        hold(self, "translation.", times=SECONDS, velocities=Range(unit="m/s"))
        with scene_errors():
            check_schedule(self.times, self.velocities, "translation.velocities", "translation.times")

    @property
    def is_still(self) -> bool:
        """Whether it never moves."""
        return not np.any(self.velocities)

    @property
    def extreme_velocities(self) -> FloatArray:
        """``(K, 3)`` m/s; every velocity lies between two of them."""
        return np.array(self.velocities, float)

    def displacement(self, time: FloatArray) -> FloatArray:
        """How far the wall is from where it is drawn, ``(T, 3)`` m."""
        return np.stack([integral_to(self.times, rates, time) for rates in zip(*self.velocities, strict=True)], axis=-1)

    def velocity(self, time: FloatArray) -> FloatArray:
        """``(T, 3)`` m/s."""
        return np.stack([rate_at(self.times, rates, time) for rates in zip(*self.velocities, strict=True)], axis=-1)


@dataclass(frozen=True)
class Vibration:
    """A wall that shakes: u(t) = A [sin(2πf(t − t₀) + φ) − sin φ] along a direction from t₀ on, so that it begins
    where it is drawn, whatever its phase.
    """

    amplitude: float  # A, m
    frequency: float  # f, Hz
    direction: Vector  # unit vector
    phase: float = 0.0  # φ, rad
    start: float = 0.0  # t₀, s

    def __post_init__(self) -> None:
        rules = {"amplitude": Range(unit="m"), "frequency": at_least(0, "Hz"), "phase": Range(unit="rad")}
        hold(self, "vibration.", unit="direction", start=SECONDS, **rules)

    @property
    def is_still(self) -> bool:
        """Whether it never moves."""
        return self.amplitude == 0.0 or self.frequency == 0.0

    @property
    def extreme_velocities(self) -> FloatArray:
        """2πf A along the direction, ``(1, 3)`` m/s; the other end is its opposite."""
        return 2.0 * math.pi * self.frequency * self.amplitude * np.array([self.direction])

    def displacement(self, time: FloatArray) -> FloatArray:
        """How far the wall is from where it is drawn, ``(T, 3)`` m."""
        since = np.maximum(0.0, np.asarray(time, float) - self.start)
        swing = np.sin(2.0 * math.pi * self.frequency * since + self.phase) - math.sin(self.phase)
        return self.amplitude * swing[..., None] * np.asarray(self.direction)

    def velocity(self, time: FloatArray) -> FloatArray:
        """``(T, 3)`` m/s."""
        time, omega = np.asarray(time, float), 2.0 * math.pi * self.frequency
        rate = np.where(time < self.start, 0.0, omega * np.cos(omega * (time - self.start) + self.phase))
        return self.amplitude * rate[..., None] * np.asarray(self.direction)


Motion = Spin | Translation | Vibration
