"""The Hertz–Mindlin law: its constants, its damping, and the analytic head-on impact that verifies them.

Normal force, on a pair that overlaps by δ and approaches at δ̇ (attraction cut off):

    F_n = max(0, K δ^{3/2} + α √(m* K) δ^{1/4} δ̇),    K = 4/3 E* √R*

Tangential force on the first particle, with slip velocity v_t of its contact point relative to the second's:

    f_t = h − α √(m* K) δ^{1/4} v_t,    |f_t| ≤ μ F_n

where the elastic part h is the history. It is turned with the contact plane at constant length, reduced by
√(δ/δ_before) when the normal load drops, and then loaded by −8 G* a v_t Δt, where a is √(R* δ), or while δ grows its
mean over the step. When f_t slips, h and f_t are rescaled together. v_t counts the spins in with the lever arms that
the torque has; LAMMPS `granular` measures it with the full radii R, as ``dem.slip=full_radius`` does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from gran_bench.config import MaterialConfig
from gran_bench.config.rules import checked
from gran_bench.dem.vectors import cross, dot
from gran_bench.scene import Material
from gran_bench.state import FloatArray

# The damping of a contact counts in what the velocity still gains until the step's end, times
# max(0, 1 − PREDICTION_FADE γ Δt / m*), γ its drag: a prediction halves the step up to which damping is stable.
PREDICTION_FADE = 3.0
# Contact time of an elastic Hertzian impact in units of δmax/v: 2.94 in every textbook, 4/5 √π Γ(2/5)/Γ(9/10) exactly.
CONTACT_TIME_FACTOR = 0.8 * math.sqrt(math.pi) * math.gamma(0.4) / math.gamma(0.9)


@dataclass(frozen=True)
class ContactLaw:
    """The constants of contacts between two materials; sizes enter through R* and m* of each contact."""

    effective_modulus: float  # E*, Pa
    effective_shear_modulus: float  # G*, Pa
    damping: float  # α, −
    friction: float  # μ, −
    rolling_friction: float  # μ_r, −

    @classmethod
    def between(cls, first: Material, second: Material) -> ContactLaw:
        """The law of a contact of ``first`` with ``second``, whose restitution and friction coefficients count."""
        return cls.of(first, second, second.restitution, second.friction, second.rolling_friction)

    @classmethod
    def of(cls, first: Material, second: Material, restitution: float, *frictions: float) -> ContactLaw:
        """The law of a contact between two materials that has this restitution, μ and μ_r.

        1/E* = (1 − ν₁²)/E₁ + (1 − ν₂²)/E₂ and 1/G* = (2 − ν₁)/G₁ + (2 − ν₂)/G₂ (Johnson 1985, eqs. 4.20 and 7.42).
        """
        normal = sum((1.0 - m.poisson_ratio**2) / m.youngs_modulus for m in (first, second))
        shear = sum((2.0 - m.poisson_ratio) / m.shear_modulus for m in (first, second))
        return cls(1.0 / normal, 1.0 / shear, damping_coefficient(restitution), *frictions)

    @property
    def constants(self) -> tuple[float, ...]:
        """(4/3 E*, 8 G*, α, μ, μ_r) in SI."""
        moduli = 4.0 / 3.0 * self.effective_modulus, 8.0 * self.effective_shear_modulus
        return (*moduli, self.damping, self.friction, self.rolling_friction)

    @classmethod
    def from_constants(cls, constants: FloatArray) -> ContactLaw:
        """The laws of contacts, each attribute an array, from ``(..., 5)`` rows (4/3 E*, 8 G*, α, μ, μ_r)."""
        modulus, shear, damping, friction, rolling = np.moveaxis(constants, -1, 0)
        return cls(0.75 * modulus, 0.125 * shear, damping, friction, rolling)


class Contacts(NamedTuple):
    """What touches, with all that its laws ask for; M contacts."""

    first: np.ndarray  # (M,) particles
    second: np.ndarray  # (M,) particles, or −1 − w for wall w
    diameter: FloatArray  # (M,) m, mean of the two; of the sphere at a wall
    law: FloatArray  # (M, 5) constants
    effective_radius: FloatArray  # (M,) R*, m
    effective_mass: FloatArray  # (M,) m*, kg
    effective_inertia: FloatArray  # (M,) I_r of rolling.py, kg m²
    normal: FloatArray  # (M, 3) from first to second
    overlap: FloatArray  # (M,) m
    velocity: FloatArray  # (M, 3) of the first relative to the second, m/s
    gain: FloatArray  # (M, 3) what that velocity still gains until the end of the step, m/s
    spin: FloatArray  # (M, 3) of the first relative to the second, rad/s; (0, 3) where nothing resists rolling
    surface_spin: FloatArray  # (M, 3) Σ arm × ω, with which spins add to the slip, m/s
    arm: FloatArray  # (M,) lever arm of the first, m
    other_arm: FloatArray  # (M,) of the second, m


@dataclass(frozen=True)
class ContactForce:
    """What M contacts do."""

    force: FloatArray  # ``(M, 3)`` on the first, N
    twist: FloatArray  # ``(M, 3)`` n × f_t, N; times each lever arm it is the torque on either particle
    history: FloatArray  # ``(M, 3)`` new elastic tangential force on the first, N


def contact_force(
    law: ContactLaw, *, normal: FloatArray, overlap: FloatArray, effective_radius: FloatArray,
    effective_mass: FloatArray, velocity: FloatArray, velocity_gain: FloatArray, surface_spin: FloatArray,
    history: FloatArray, overlap_before: FloatArray, time_step: float,
) -> ContactForce:  # fmt: skip
    """Forces of M touching contacts by the law at the head of this file, vectorised.

    Args:
        law, normal: constants; ``(M, 3)`` unit vectors from the first to the second.
        overlap, effective_radius, effective_mass: ``(M,)`` δ > 0 and R*, m, and m*, kg.
        velocity: ``(M, 3)`` of the first centre relative to the second centre (or to the wall's point), m/s.
        velocity_gain: ``(M, 3)`` what that velocity still gains until the end of the step, m/s.
        surface_spin: ``(M, 3)`` Σ lever arm × ω of both, m/s; its cross product with n adds to the slip.
        history: ``(M, 3)`` elastic tangential force on the first, N.
        overlap_before: ``(M,)`` overlap when it was stored, m; 0 for a new contact.
        time_step: Δt over which the slip loads the history, s; 0 leaves it as it is.
    """
    contact_radius = np.sqrt(effective_radius * overlap)
    stiffness = 4.0 / 3.0 * law.effective_modulus * contact_radius
    drag = law.damping * np.sqrt(effective_mass * stiffness)
    approach = dot(velocity, normal)
    gain = dot(velocity_gain, normal)
    gain = gain * np.maximum(0.0, 1.0 - PREDICTION_FADE * drag * time_step / effective_mass)
    load = np.maximum(0.0, stiffness * overlap + drag * (approach + gain))

    slip = velocity - approach[:, None] * normal + cross(surface_spin, normal)
    length = np.sqrt(dot(history, history))
    history = history - dot(history, normal)[:, None] * normal
    inside = np.sqrt(dot(history, history))
    turned = np.divide(length, inside, out=np.zeros_like(length), where=inside > 0)
    ratio = np.divide(overlap, overlap_before, out=np.zeros_like(overlap), where=overlap_before > 0)
    history = (turned * np.sqrt(np.minimum(1.0, ratio)))[:, None] * history
    mean_radius = 0.5 * (contact_radius + np.sqrt(effective_radius * np.minimum(overlap, overlap_before)))
    history = history - (8.0 * law.effective_shear_modulus * mean_radius * time_step)[:, None] * slip
    tangential = history - drag[:, None] * slip
    size, limit = np.sqrt(dot(tangential, tangential)), law.friction * load
    scale = np.divide(limit, size, out=np.ones_like(size), where=size > limit)[:, None]
    tangential, history = scale * tangential, scale * history
    return ContactForce(tangential - load[:, None] * normal, cross(normal, tangential), history)


def restitution_of(damping: float) -> float:
    """Coefficient of restitution that a damping α ≥ 0 gives.

    Integrates the dimensionless head-on impact x″ + α x^{1/4} x′ + x^{3/2} = 0 from x = 0, x′ = 1 until the force
    vanishes. The attractive tail that would follow is cut off, so the spheres part there with speed e = −x′.

    Source: Antypov & Elliott (2011), EPL 94, 50004, eq. 8, whose closed form of α(e) holds with the tail.
    """
    if damping == 0.0:
        return 1.0

    def rates(_: float, y: list[float]) -> tuple[float, float]:
        x = max(y[0], 0.0)
        return y[1], -damping * x**0.25 * y[1] - x**1.5

    def force_vanishes(_: float, y: list[float]) -> float:
        # The force over x^{1/4}: at the start x^{1/4} hides the sign, this form does not.
        return max(y[0], 0.0) ** 1.25 + damping * y[1]

    force_vanishes.terminal, force_vanishes.direction = True, -1.0
    span = (0.0, 20.0 + 20.0 * damping)  # overdamped impacts creep apart
    impact = solve_ivp(rates, span, (0.0, 1.0), events=force_vanishes, rtol=1e-9, atol=1e-12)
    return -float(impact.y_events[0][0][1])


@lru_cache(maxsize=256)
def damping_coefficient(restitution: float) -> float:
    """The damping α that makes the restitution e that was set the one that comes out, at any impact speed.

    Raises:
        ConfigError: a restitution outside (0, 1].
    """
    restitution = checked(MaterialConfig, "restitution", restitution)
    if restitution == 1.0:
        return 0.0
    upper = 1.0
    while restitution_of(upper) > restitution:
        upper *= 2.0
    return float(brentq(lambda damping: restitution_of(damping) - restitution, 0.0, upper, xtol=1e-9))


def hertz_impact(
    effective_modulus: float, effective_radius: float, effective_mass: float, speed: float
) -> tuple[float, float, float]:
    """Largest overlap, largest force and duration of an elastic head-on impact.

    δmax = (5 m* v² / 4 K)^{2/5},  Fmax = K δmax^{3/2},  t_c = 2.943275 δmax / v,  K = 4/3 E* √R*

    in m, N and s, of E* in Pa, R* in m, m* in kg, and a relative speed v > 0 in m/s.

    Source: Johnson (1985), Contact Mechanics, §11.4.
    """
    stiffness = 4.0 / 3.0 * effective_modulus * math.sqrt(effective_radius)
    overlap = (1.25 * effective_mass * speed**2 / stiffness) ** 0.4
    return overlap, stiffness * overlap**1.5, CONTACT_TIME_FACTOR * overlap / speed


def sphere_mass(density: float, radius: float) -> float:
    """m = 4/3 π ρ r³, kg; works on arrays of radii too."""
    return 4.0 / 3.0 * math.pi * density * radius**3
