"""What theory says of spheres in contact, from the equations alone: nothing here is shared with the solver."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from gran_bench.scene import Material
from gran_bench.state import FloatArray

HERTZ = "Hertz, closed form (Johnson 1985, §11.4)"
RESTITUTION = "the restitution that is set"
EQUATIONS = "Hertz–Mindlin ODE, events, DOP853 at 1e-10"
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


DOWN = np.array([0.0, -1.0])  # (x, z), from the first body to the second when they touch
FIRST_OVERLAP = 1e-7  # of the largest one: where the integration starts and ends, for δ̇/δ is singular at touch


class Rebound(NamedTuple):
    """Velocities when the bodies part, in the frame of their common centre of mass (of the wall, where one is)."""

    velocity: FloatArray  # ``(2,)`` of the first relative to the second, (x, z) m/s
    spin: tuple[float, float]  # of both, about y, rad/s
    duration: float  # s
    slid_throughout: bool  # whether the contact point never stuck


class _Loads(NamedTuple):
    """A contact at one instant; the force is not cut off at zero: what looks ahead of the end needs a smooth one."""

    overlap: float
    normal: tuple[float, float]
    arms: tuple[float, float]
    closing: float
    slip: float
    force: float
    gamma: float


class _Equations:
    """The Hertz–Mindlin equations of one contact in continuous time: what a small time step tends to.

    The motion lies in the x–z plane; spins are about y. With n from the first body to the second, t = ŷ × n, and the
    velocity v of the first relative to the second,

        δ̇ = v·n,   s = v·t + a₁ω₁ + a₂ω₂,   γ = α √(m* K √δ),   F = max(0, K δ^{3/2} + γ δ̇)
        m* v̇ = −F n + f t,   I₁ ω̇₁ = a₁ f,   I₂ ω̇₂ = a₂ f

        sticking:  f = h − γ s,  ḣ = −8 G* √(R*δ) s, and + h δ̇/2δ while δ falls     until |f| reaches μF
        sliding:   f = ∓μF, and h keeps what damping leaves of it, |h| = max(0, μF − γ|s|)
                   until an elastic h would grow slower than the limit

    The lever arms end on the plane of the circle in which two spheres intersect, or on the wall. The contact ends when
    F vanishes (the attractive tail is cut off). DOP853 integrates between two changes of regime, found as roots.

    y = (displacement x, z of the second from touch; v x, z; ω₁; ω₂; h).
    """

    def __init__(self, contact: Contact, overlap: float) -> None:
        first, second = contact.first, contact.second
        self.wall, self.overlap = second.is_wall, overlap  # the largest, as a scale of lengths
        self.reach = first.radius if self.wall else first.radius + second.radius
        self.squares = 0.0 if self.wall else first.radius**2 - second.radius**2
        # Properties, kept: each is asked for a million times.
        self.mass, self.stiffness, self.shear = contact.effective_mass, contact.stiffness, contact.shear_stiffness
        self.damper, self.friction = contact.damper, second.material.friction
        self.inertia = [0.4 * body.mass * body.radius**2 for body in (first, second)]

    def loads(self, y: FloatArray) -> _Loads:
        x, z, vx, vz, spin1, spin2, _ = np.asarray(y).tolist()  # plain numbers: ten times as fast as arrays of two
        z -= self.reach
        distance = -z if self.wall else math.hypot(x, z)
        nx, nz = (0.0, -1.0) if self.wall else (x / distance, z / distance)
        arm1 = distance if self.wall else 0.5 * (distance + self.squares / distance)
        arm2, overlap, closing = distance - arm1, self.reach - distance, vx * nx + vz * nz
        depth, slip = max(overlap, 0.0), vx * nz - vz * nx + arm1 * spin1 + arm2 * spin2
        gamma = self.damper * depth**0.25
        force = self.stiffness * depth**1.5 + gamma * closing
        return _Loads(overlap, (nx, nz), (arm1, arm2), closing, slip, force, gamma)

    def elastic_rate(self, y: FloatArray, at: _Loads) -> float:
        """ḣ of a sticking contact."""
        rate = -self.shear * math.sqrt(max(at.overlap, 0.0)) * at.slip
        return rate + (0.5 * y[6] * at.closing / at.overlap if at.closing < 0 and at.overlap > 0 else 0.0)

    def kept(self, y: FloatArray, sense: float) -> float:
        """h of a contact that slides with f = −sense μF."""
        at = self.loads(y)
        return -sense * max(0.0, self.friction * at.force - at.gamma * at.slip * sense)

    def rates(self, y: FloatArray, sense: float) -> FloatArray:
        """ẏ; ``sense`` is the direction of sliding, or 0 of a sticking contact."""
        at = self.loads(y)
        along = -sense * self.friction * at.force if sense else y[6] - at.gamma * at.slip
        (nx, nz), spins = at.normal, (arm * along / inertia for arm, inertia in zip(at.arms, self.inertia, strict=True))
        push = (along * nz - at.force * nx) / self.mass, (-along * nx - at.force * nz) / self.mass
        return np.array([-y[2], -y[3], *push, *spins, 0.0 if sense else self.elastic_rate(y, at)])

    def growth(self, y: FloatArray, sense: float) -> float:
        """How fast a sliding contact would exceed the limit if it stuck, N/s; negative where it would not."""
        y = np.concatenate((y[:6], [self.kept(y, sense)]))
        step = 1e-7 * self.overlap / max(math.hypot(*y[2:4]), 1e-300)
        slope = self.rates(y, sense)
        slope[6] = self.elastic_rate(y, self.loads(y))
        before, after = y - step * slope, y + step * slope
        return (self.excess(after, sense) - self.excess(before, sense)) / (2.0 * step)

    def excess(self, y: FloatArray, sense: float) -> float:
        """What the tangential force of a sticking contact has against ``sense`` beyond the limit, N."""
        at = self.loads(y)
        return sense * (at.gamma * at.slip - y[6]) - self.friction * at.force

    def first_sense(self, y: FloatArray) -> float:
        """Direction in which a contact slides that nothing has loaded yet, or 0 where it sticks."""
        at = self.loads(y)
        sense = math.copysign(1.0, at.slip) if at.slip else 0.0
        # With damping a part of the force is there at once; without it the faster one of load and limit wins.
        if at.gamma:
            return sense if abs(at.gamma * at.slip) > self.friction * at.force else 0.0
        return sense if sense and self.growth(y, sense) > 0.0 else 0.0

    def change_of_regime(self, sense: float, force: float) -> Callable[[float, FloatArray], float]:
        """The event that ends sticking or sliding."""

        def slips(_: float, y: FloatArray) -> float:
            return max(self.excess(y, 1.0), self.excess(y, -1.0)) / force

        def sticks(_: float, y: FloatArray) -> float:
            at = self.loads(y)
            if at.gamma * at.slip * sense > self.friction * at.force:
                return 1.0
            return math.copysign(1.0, self.growth(y, sense))

        return _ending(sticks, -1.0) if sense else _ending(slips, 1.0)


def _ending(event: Callable[[float, FloatArray], float], direction: float) -> Callable[[float, FloatArray], float]:
    event.terminal, event.direction = True, direction
    return event


def impact(contact: Contact, velocity: FloatArray, spin: tuple[float, float] = (0.0, 0.0)) -> Rebound:
    """The rebound of two bodies that just touch, the second straight below the first.

    ``velocity``, ``(2,)`` (x, z) m/s of the first relative to the second, must approach; ``spin`` is of both about y,
    rad/s. A `RuntimeError` is raised where the integration does not end.
    """
    velocity = np.asarray(velocity, float)
    approach, speed = float(velocity @ DOWN), math.hypot(*velocity)
    overlap, force = contact.largest_overlap(approach), contact.largest_force(approach)
    equations = _Equations(contact, overlap)
    turning = max(speed / contact.first.radius, abs(spin[0]), abs(spin[1]))
    limits = 1e-11 * np.array([overlap, overlap, approach, approach, turning, turning, max(force, 1e-300)])
    touch = FIRST_OVERLAP * overlap
    y = np.array([*(-velocity * touch / approach), *velocity, *spin, 0.0])
    # Time runs in units of the elastic contact time: SciPy finds events to 1e-15 of a unit.
    unit = contact.duration(approach)
    time, longest, stuck = 0.0, 20.0 * (1.0 + damping(contact.second.material.restitution)), False

    def parted(_: float, y: FloatArray) -> float:
        return equations.loads(y).overlap - 0.5 * touch

    def unloaded(_: float, y: FloatArray) -> float:
        at = equations.loads(y)
        return (max(at.overlap, 0.0) ** 1.25 + equations.damper / equations.stiffness * at.closing) / overlap**1.25

    ends = (_ending(parted, -1.0), _ending(unloaded, -1.0))
    sense = equations.first_sense(y)
    for _ in range(200):
        stuck |= sense == 0.0
        part = solve_ivp(
            lambda _, y, sense=sense: unit * equations.rates(y, sense), (time, longest), y, "DOP853",
            events=(*ends, equations.change_of_regime(sense, force)), rtol=1e-10, atol=limits,
        )  # fmt: skip
        y, time = part.y[:, -1], float(part.t[-1])
        if sense:
            y[6] = equations.kept(y, sense)
        # Where nothing slips, the limit vanishes with the force, and either event may come first.
        if len(part.t_events[0]) or len(part.t_events[1]) or unloaded(time, y) < 1e-10:
            return Rebound(y[2:4], (float(y[4]), float(y[5])), time * unit, not stuck)
        if not len(part.t_events[2]):
            break
        at = equations.loads(y)
        sense = 0.0 if sense else -math.copysign(1.0, y[6] - at.gamma * at.slip)
    raise RuntimeError(f"an impact at {velocity} m/s did not end; its equations are not what this integration expects")
