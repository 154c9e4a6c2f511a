"""Baselines that keep everyone honest: what a model has to beat before it has learned anything.

- `ballistic`: gravity and nothing else; spheres fall through each other and the walls.
- `rigid_rotation`: the bed turns with the drum as if glued to it.
- `interpolated_statistics`: no particles at all, but the statistics of the neighbouring training speeds.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from gran_bench.config.registry import HOUSE, METRICS
from gran_bench.config.rules import check_arguments
from gran_bench.metrics.measured import Series
from gran_bench.metrics.summary import TrajectorySummary
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, ParticleState, Trajectory


def ballistic(scene: Scene, settled: ParticleState) -> Trajectory:
    """Free flight from a settled state: x = x₀ + v₀ τ + ½ g τ², v = v₀ + g τ, the spin kept; nothing touches."""
    time = _clock(scene, settled)
    past = (time - settled.time)[:, None, None]
    gravity = np.asarray(scene.gravity)
    return _trajectory(
        settled,
        time,
        settled.position + settled.velocity * past + 0.5 * gravity * past**2,
        settled.velocity + gravity * past,
        np.broadcast_to(settled.angular_velocity, (len(time), settled.count, 3)),
    )


def rigid_rotation(scene: Scene, settled: ParticleState) -> Trajectory:
    """The whole bed turns with the wall: x = Q(φ) x₀, v = ω × x, spin ω, with φ the angle that the wall has turned.

    The settled state, the first one, is kept as it is.
    """
    time, axis = _clock(scene, settled), np.asarray(scene.rotation.axis)
    angle = np.array([scene.rotation.angle(settled.time, t) for t in time])[:, None, None]
    speed = np.array([scene.rotation.angular_speed(t) for t in time])[:, None, None]
    start = settled.position.astype(np.float64)
    # Rodrigues: the part along the axis stays, the part across it turns.
    along = (start @ axis)[:, None] * axis
    position = along + (start - along) * np.cos(angle) + np.cross(axis, start) * np.sin(angle)
    velocity = speed * np.cross(axis, position)
    spin = np.broadcast_to(speed * axis, position.shape).copy()
    position[0], velocity[0], spin[0] = settled.position, settled.velocity, settled.angular_velocity
    return _trajectory(settled, time, position, velocity, spin)


def neighbouring_speeds(speed_rpm: float, training: Iterable[float]) -> tuple[float, float] | None:
    """The nearest training speeds below and above a speed, rpm; None where a side has none."""
    found = nearest_speeds(speed_rpm, training, 1)
    return (found[0], found[1]) if len(found) == 2 else None


def nearest_speeds(speed_rpm: float, training: Iterable[float], count: int) -> list[float]:
    """Up to ``count`` training speeds below a speed and as many above, the nearest ones, rpm, in order.

    Speeds of the other sense of rotation are no neighbours: their flow is a mirror image.
    """
    alike = sorted(rpm for rpm in training if rpm * speed_rpm >= 0.0)
    below, above = [rpm for rpm in alike if rpm < speed_rpm], [rpm for rpm in alike if rpm > speed_rpm]
    return below[-count:] + above[:count]


def interpolated_statistics(speed_rpm: float, training: Mapping[float, TrajectorySummary]) -> TrajectorySummary:
    """Statistics at a speed, linear in the speed between the neighbouring training cases, state by state.

    Series are interpolated as they are, speeds quantile by quantile (the straight line between two distributions in
    the Wasserstein-1 distance). There are no particles, so figures that need them are undefined.

    Args:
        speed_rpm: that has no case.
        training: summaries of the training cases by speed, rpm; of one definition of velocity.

    Raises:
        ValueError: the speed lies outside the training speeds, or the cases are not comparable.
    """
    check_arguments(speed_rpm=(speed_rpm, float), training=(training, Mapping))
    found = (speed_rpm, speed_rpm) if speed_rpm in training else neighbouring_speeds(speed_rpm, training)
    if found is None:
        known = ", ".join(f"{rpm:g}" for rpm in sorted(training))
        raise ValueError(f"speed_rpm={speed_rpm:g} lies outside the training speeds {known}; interpolate between them")
    below, above = found
    low, high = training[below], training[above]
    if low.velocity_kind != high.velocity_kind:
        raise ValueError(
            f"the cases at {below:g} and {above:g} rpm use {low.velocity_kind} and {high.velocity_kind} velocities; "
            "summarise both with one velocity_kind"
        )
    if low.sorted_speed.shape != high.sorted_speed.shape:
        raise ValueError(
            f"the cases at {below:g} and {above:g} rpm have (states, spheres) = {low.sorted_speed.shape} and "
            f"{high.sorted_speed.shape}; interpolate between cases of one scene"
        )
    share = 0.0 if above == below else (speed_rpm - below) / (above - below)
    house = [name for name in low.series if METRICS.owner(name) == HOUSE]  # those of plugins need particles

    def between(name: str) -> FloatArray:
        one, other = getattr(low, name), getattr(high, name)
        return one + (other - one) * np.asarray(share, one.dtype)

    def series(one: Series, other: Series) -> Series:
        value = (1.0 - share) * one.value + share * other.value
        return replace(one, value=value, undefined_because=one.undefined_because or other.undefined_because)

    return replace(
        low,
        series={name: series(low.series[name], high.series[name]) for name in house},
        sorted_speed=between("sorted_speed"),
        sorted_component=between("sorted_component"),
        layers=between("layers"),
        position=None,
        failures=None,
    )


def _clock(scene: Scene, settled: ParticleState) -> FloatArray:
    check_arguments(scene=(scene, Scene), settled=(settled, ParticleState))
    return settled.time + scene.frame_interval * np.arange(scene.frame_count)


def _trajectory(
    settled: ParticleState, time: FloatArray, position: FloatArray, velocity: FloatArray, spin: FloatArray
) -> Trajectory:
    single = [array.astype(np.float32) for array in (position, velocity, spin)]
    return Trajectory(time, *single, settled.radius)
