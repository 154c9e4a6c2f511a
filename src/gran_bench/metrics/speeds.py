"""Distributions of particle speed: histogram, Wasserstein-1 distance, components, profile under the surface."""

import math

import numpy as np

from gran_bench.config.registry import register_metric
from gran_bench.config.rules import check_arguments
from gran_bench.metrics.angle_of_repose import HALF_WINDOW, SurfaceLine, cross_section_axes
from gran_bench.metrics.measured import Series, shared_states
from gran_bench.scene import Scene
from gran_bench.state import VELOCITY_KINDS, FloatArray, Trajectory


def velocities(trajectory: Trajectory, velocity_kind: str, period: float = 0.0) -> FloatArray:
    """Velocities by the wanted definition, ``(F, N, 3)`` m/s, in double precision, so that squares stay finite.

    ``velocity_kind`` is ``instantaneous``, which a trajectory of means does not have (`ValueError`), or ``mean`` over
    the frame that ends at a state; ``period`` is the length of a periodic axis y, m.
    """
    check_arguments(trajectory=(trajectory, Trajectory))
    if velocity_kind not in VELOCITY_KINDS:
        raise ValueError(f"velocity_kind={velocity_kind!r}; choose one of {', '.join(VELOCITY_KINDS)}")
    if velocity_kind == trajectory.velocity_kind:
        return trajectory.velocity.astype(np.float64)
    if velocity_kind == "instantaneous":
        raise ValueError(
            "the trajectory stores mean velocities, which do not give instantaneous ones; compare by velocity_kind=mean"
        )
    return trajectory.mean_velocity(period)


def speeds(velocity: FloatArray) -> FloatArray:
    """‖v‖ of ``(F, N, 3)`` velocities, ``(F, N)`` m/s."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.sqrt(np.einsum("fnk,fnk->fn", velocity, velocity))


@register_metric("mean speed", "m/s")
def mean_speed(trajectory: Trajectory, scene: Scene) -> Series:
    """Mean over the spheres of ‖v‖ of each state, m/s."""
    with np.errstate(invalid="ignore", over="ignore"):
        speed = speeds(velocities(trajectory, trajectory.velocity_kind)).mean(axis=1, dtype=np.float64)
    return Series(trajectory.time, np.where(np.isfinite(speed), speed, np.nan), "m/s", invalid_because="not finite")


def wasserstein(sorted_a: FloatArray, sorted_b: FloatArray) -> float:
    """Wasserstein-1 distance ∫|A⁻¹(q) − B⁻¹(q)| dq of two increasing samples, ``(N,)`` and ``(M,)``, in their unit.

    Exact, also for unequal sizes; NaN where a sample is empty or has a value that is not finite.
    """
    sorted_a, sorted_b = np.asarray(sorted_a), np.asarray(sorted_b)
    if not (len(sorted_a) and len(sorted_b)):
        return math.nan
    if len(sorted_a) == len(sorted_b):
        return float(np.abs(sorted_a - sorted_b).mean(dtype=np.float64))
    both = (sorted_a, sorted_b)
    levels = np.unique(np.concatenate([np.arange(1, len(sample) + 1) / len(sample) for sample in both]))
    share = np.diff(levels, prepend=0.0)
    middle = levels - 0.5 * share
    a, b = (sample[np.minimum((middle * len(sample)).astype(np.int64), len(sample) - 1)] for sample in both)
    return float((np.abs(a - b) * share).sum(dtype=np.float64))


def sorted_frames(values: FloatArray) -> FloatArray:
    """Each frame's values in increasing order, ``(F, N)`` float32; a frame that is not finite is NaN throughout.

    An infinite or missing speed would else only shift the ranks. Values beyond single precision stay in double.
    """
    largest = np.abs(values, where=np.isfinite(values), out=np.zeros(values.shape)).max(initial=0.0)
    ordered = np.sort(values.astype(np.float32 if largest <= np.finfo(np.float32).max else np.float64), axis=1)
    ordered[~np.isfinite(values).all(axis=1)] = np.nan
    return ordered


def wasserstein_series(time_a: FloatArray, a: FloatArray, time_b: FloatArray, b: FloatArray) -> Series:
    """Wasserstein-1 distance of each state of two runs, by `sorted_frames`, m/s; what only one has is invalid."""
    shared = shared_states(time_a, time_b)
    value = [wasserstein(x, y) for x, y in zip(a[:shared], b[:shared], strict=True)]
    return Series.of_two(time_a, time_b, np.array(value), "m/s", "velocity is not finite, or missing,")


def layer_sums(position: FloatArray, velocity: FloatArray, lines: list[SurfaceLine], scene: Scene) -> FloatArray:
    """Spheres, their speeds and their velocities along the surface in layers of one diameter under it, summed.

    Only spheres within 0.6 R of the middle of the surface count, so that a layer has one depth. The velocity along
    the surface is positive uphill, so the flowing layer is negative. Layers run to the drum's wall. A state without a
    valid surface is left out: its sums are 0. Positions (m) and velocities (m/s) are ``(F, N, 3)`` in a drum, with
    the line of each state. Gives ``(3, F, K)``: −, m/s, m/s.
    """
    diameter = scene.filling.diameter
    layers = max(1, round(2.0 * scene.drum_radius / diameter))
    climbing, up = cross_section_axes(scene)
    sums = np.zeros((3, len(lines), layers))
    for frame, (x, v, line) in enumerate(zip(position, velocity, lines, strict=True)):
        if not line.valid:
            continue
        direction = climbing * math.cos(line.angle) + up * math.sin(line.angle)
        normal = up * math.cos(line.angle) - climbing * math.sin(line.angle)
        layer = np.floor((line.offset - x @ normal) / diameter)
        # A sphere above the line, half a diameter at most in a dense bed, belongs to the first layer.
        layer = np.where((layer < 0) & (layer >= -1), 0, layer)
        used = (np.abs(x @ direction) <= HALF_WINDOW * scene.drum_radius) & (layer >= 0) & (layer < layers)
        index = layer[used].astype(np.int64)
        sums[0, frame] = np.bincount(index, minlength=layers)
        sums[1, frame] = np.bincount(index, np.linalg.norm(v[used], axis=1), minlength=layers)
        sums[2, frame] = np.bincount(index, v[used] @ direction, minlength=layers)
    return sums


def depth_profile(sums: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean speed, and mean velocity along the surface, of `layer_sums` in each layer, ``(K,)`` m/s each.

    A layer that never held a sphere is NaN.
    """
    count, speed, along = sums.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return speed / count, along / count
