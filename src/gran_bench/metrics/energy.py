"""Kinetic energy of the bed, translational and rotational, and the height of its centre of mass."""

from __future__ import annotations

import math

import numpy as np

from gran_bench.config.registry import register_metric
from gran_bench.metrics.measured import Series
from gran_bench.metrics.speeds import velocities
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, Trajectory


def sphere_masses(radius: FloatArray, density: float) -> FloatArray:
    """m = 4/3 π ρ r³, ``(N,)`` kg, of ``(N,)`` radii in m and a density in kg/m³."""
    return 4.0 / 3.0 * math.pi * density * radius.astype(np.float64) ** 3


@register_metric("translational energy", "J")
def translational_energy(trajectory: Trajectory, scene: Scene) -> Series:
    """Σ ½ m v² of each state, J."""
    mass = sphere_masses(trajectory.radius, scene.material.density)
    value = _half_sum(velocities(trajectory, trajectory.velocity_kind), mass)
    return Series(trajectory.time, value, "J", invalid_because="velocity is not finite")


@register_metric("rotational energy", "J")
def rotational_energy(trajectory: Trajectory, scene: Scene) -> Series:
    """Σ ½ (2/5 m r²) ω² of each state, J; undefined where a model has no spin."""
    if trajectory.angular_velocity is None:
        nothing = np.full(trajectory.frame_count, np.nan)
        return Series(trajectory.time, nothing, "J", undefined_because="the model has no spin")
    mass = sphere_masses(trajectory.radius, scene.material.density)
    inertia = 0.4 * mass * trajectory.radius.astype(np.float64) ** 2
    value = _half_sum(trajectory.angular_velocity, inertia)
    return Series(trajectory.time, value, "J", invalid_because="spin is not finite")


@register_metric("height of the centre of mass", "m")
def center_height(trajectory: Trajectory, scene: Scene) -> Series:
    """Σ m z / Σ m of each state, m."""
    mass = sphere_masses(trajectory.radius, scene.material.density)
    with np.errstate(invalid="ignore", over="ignore"):
        height = trajectory.position[..., 2].astype(np.float64) @ (mass / mass.sum())
    return Series(trajectory.time, np.where(np.isfinite(height), height, np.nan), "m", invalid_because="not finite")


def _half_sum(rate: FloatArray, weight: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore", over="ignore"):
        value = 0.5 * np.einsum("fnk,fnk,n->f", rate, rate, weight, dtype=np.float64)
    return np.where(np.isfinite(value), value, np.nan)
