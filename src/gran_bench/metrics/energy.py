"""Kinetic energy of the bed, translational and rotational."""

from __future__ import annotations

import math

import numpy as np

from gran_bench.metrics.measured import Series
from gran_bench.state import FloatArray


def sphere_masses(radius: FloatArray, density: float) -> FloatArray:
    """m = 4/3 π ρ r³, ``(N,)`` kg, of ``(N,)`` radii in m and a density in kg/m³."""
    return 4.0 / 3.0 * math.pi * density * radius.astype(np.float64) ** 3


def translational_energy(time: FloatArray, velocity: FloatArray, mass: FloatArray) -> Series:
    """Σ ½ m v² of each state, J.

    Args:
        time: ``(F,)`` s.
        velocity: ``(F, N, 3)`` m/s.
        mass: ``(N,)`` kg.
    """
    return Series(time, _half_sum(velocity, mass), "J", invalid_because="velocity is not finite")


def rotational_energy(
    time: FloatArray, angular_velocity: FloatArray | None, mass: FloatArray, radius: FloatArray
) -> Series:
    """Σ ½ (2/5 m r²) ω² of each state, J; undefined where a model has no spin.

    Args:
        time: ``(F,)`` s.
        angular_velocity: ``(F, N, 3)`` rad/s, or None.
        mass: ``(N,)`` kg.
        radius: ``(N,)`` m.
    """
    if angular_velocity is None:
        return Series(time, np.full(len(time), np.nan), "J", undefined_because="the model has no spin")
    inertia = 0.4 * mass * radius.astype(np.float64) ** 2
    return Series(time, _half_sum(angular_velocity, inertia), "J", invalid_because="spin is not finite")


def _half_sum(rate: FloatArray, weight: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore", over="ignore"):
        value = 0.5 * np.einsum("fnk,fnk,n->f", rate, rate, weight, dtype=np.float64)
    return np.where(np.isfinite(value), value, np.nan)
