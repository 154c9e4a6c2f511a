"""What theory says of spheres in contact, from the equations alone: nothing here is shared with the solver."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import brentq

from gran_bench.scene import Material
from gran_bench.state import FloatArray

HERTZ = "Hertz, closed form (Johnson 1985, §11.4)"
RESTITUTION = "the restitution that is set"
SLIDING = "rigid-body sliding, closed form (Chung & Ooi 2011)"


@dataclass(frozen=True)
class Body:
    """A sphere of a radius in m, or a flat wall, which never moves, of an infinite one."""

    material: Material
    radius: float

    @property
    def mass(self) -> float:
        """m = 4/3 π ρ R³, kg; infinite for a wall."""
        return 4.0 / 3.0 * math.pi * self.material.density * self.radius**3

    @property
    def is_wall(self) -> bool:
        """Whether it is a flat wall."""
        return math.isinf(self.radius)


@dataclass(frozen=True)
class Contact:
    """The constants of a Hertz–Mindlin contact; only the second body may be a wall, and its e and μ count."""

    first: Body
    second: Body

    @property
    def effective_radius(self) -> float:
        """R* = (1/R₁ + 1/R₂)⁻¹, m."""
        return 1.0 / (1.0 / self.first.radius + 1.0 / self.second.radius)

    @property
    def effective_mass(self) -> float:
        """m* = (1/m₁ + 1/m₂)⁻¹, kg."""
        return 1.0 / (1.0 / self.first.mass + 1.0 / self.second.mass)

    @property
    def effective_modulus(self) -> float:
        """E* = [(1 − ν₁²)/E₁ + (1 − ν₂²)/E₂]⁻¹, Pa (Johnson 1985, eq. 4.20)."""
        a, b = self.first.material, self.second.material
        return 1.0 / ((1 - a.poisson_ratio**2) / a.youngs_modulus + (1 - b.poisson_ratio**2) / b.youngs_modulus)

    @property
    def effective_shear_modulus(self) -> float:
        """G* = [(2 − ν₁)/G₁ + (2 − ν₂)/G₂]⁻¹ with G = E/2(1 + ν), Pa (Johnson 1985, eq. 7.42)."""
        both = self.first.material, self.second.material
        return 1.0 / sum((2 - m.poisson_ratio) * 2 * (1 + m.poisson_ratio) / m.youngs_modulus for m in both)

    @property
    def stiffness(self) -> float:
        """K = 4/3 E* √R*, N/m^{3/2}; F = K δ^{3/2}."""
        return 4.0 / 3.0 * self.effective_modulus * math.sqrt(self.effective_radius)

    @property
    def shear_stiffness(self) -> float:
        """8 G* √R*, N/m^{3/2}; times √δ it is the tangential stiffness (Mindlin 1949)."""
        return 8.0 * self.effective_shear_modulus * math.sqrt(self.effective_radius)

    @cached_property
    def damper(self) -> float:
        """α √(m* K), N s/m^{5/4}; γ = α √(m* K) δ^{1/4}."""
        return damping(self.second.material.restitution) * math.sqrt(self.effective_mass * self.stiffness)

    def force(self, overlap: float, closing: float) -> float:
        """F = K δ^{3/2} + γ δ̇, N, zero where nothing touches; not cut off where it attracts."""
        overlap = max(overlap, 0.0)
        return self.stiffness * overlap**1.5 + self.damper * overlap**0.25 * closing

    def largest_overlap(self, speed: float) -> float:
        """δmax = (5 m* v² / 4 K)^{2/5} of an elastic head-on impact, m."""
        return (1.25 * self.effective_mass * speed**2 / self.stiffness) ** 0.4

    def largest_force(self, speed: float) -> float:
        """Fmax = K δmax^{3/2} of an elastic head-on impact, N."""
        return self.stiffness * self.largest_overlap(speed) ** 1.5

    def duration(self, speed: float) -> float:
        """t_c = 2.9432751 δmax / v of an elastic head-on impact, s."""
        return 2.9432751 * self.largest_overlap(speed) / speed

    def resting_overlap(self, load: float) -> float:
        """δ at which the contact carries a load, (F/K)^{2/3}, m."""
        return (load / self.stiffness) ** (2.0 / 3.0)

    def bobbing_period(self, load: float) -> float:
        """Period of a sphere that bobs on its contact under a load, 2π √(m/k), k = 3/2 K √δ: its fastest motion, s."""
        overlap = self.resting_overlap(load)
        return 2.0 * math.pi * math.sqrt(self.first.mass / (1.5 * self.stiffness * math.sqrt(overlap)))


def restitution(damping: float) -> float:
    """Coefficient of restitution of x″ + α x^{1/4} x′ + x^{3/2} = 0 when the attractive tail is cut off, α ≥ 0.

    With y = 4/5 x^{5/4} it is that of a linear dashpot, ω₀² = 5/4 and β = α/2: e = exp[−β/ω (π − atan2(2βω, ω² − β²))],
    ω² = ω₀² − β²; for β > ω₀, e = exp[−β/Ω ln((β + Ω)/(β − Ω))], Ω² = β² − ω₀².

    Source: Antypov & Elliott (2011), EPL 94, 50004 (the map); Schwager & Pöschel (2007), Granular Matter 9, 465.
    """
    beta, square = 0.5 * damping, 1.25 - 0.25 * damping**2
    omega = math.sqrt(abs(square))
    if square > 0:
        return math.exp(-beta / omega * (math.pi - math.atan2(2 * beta * omega, omega**2 - beta**2)))
    return math.exp(-beta / omega * math.log((beta + omega) / (beta - omega)) if omega else -2.0)


def damping(e: float) -> float:
    """α that gives the restitution e in (0, 1], the inverse of :func:`restitution`, −."""
    return 0.0 if e == 1.0 else float(brentq(lambda alpha: restitution(alpha) - e, 0.0, 1e3, xtol=1e-14, rtol=1e-14))


def sliding_rebound(
    contact: Contact, normal: FloatArray, tangential: FloatArray, arm: float
) -> tuple[FloatArray, FloatArray]:
    """Relative tangential speed, ``(P,)`` m/s, and spin of the first body after an impact that slides throughout.

    v_t′ = v_t − μ (1 + e) v_n and ω′ = 5/2 μ (1 + e) v_n (m*/m) a/R² for spheres that did not spin, with the approach
    v_n > 0 and v_t, ``(P,)`` m/s, and the lever arm a of the friction, m, which is R of a rigid sphere.

    Source: Chung & Ooi (2011), Granular Matter 13, 643, eqs. for gross sliding; Kharaz et al. (2001).
    """
    e, friction = contact.second.material.restitution, contact.second.material.friction
    change = friction * (1.0 + e) * normal
    share = contact.effective_mass / contact.first.mass
    return tangential - change, 2.5 * share * change * arm / contact.first.radius**2


def slides_throughout(contact: Contact, normal: FloatArray, slip: FloatArray) -> FloatArray:
    """Whether an impact slides all through: |slip| > 7/2 μ (1 + e) v_n, ``(P,)`` m/s; of a wall or equal spheres."""
    m = contact.second.material
    return np.abs(slip) > 3.5 * m.friction * (1.0 + m.restitution) * normal
