"""An impact by the Hertz–Mindlin equations in continuous time, integrated to 1e-10: what a small time step tends to.

The motion lies in the x–z plane; spins are about y. With n from the first body to the second, t = ŷ × n, and the
velocity v of the first relative to the second,

    δ̇ = v·n,   s = v·t + a₁ω₁ + a₂ω₂,   γ = α √(m* K √δ),   F = max(0, K δ^{3/2} + γ δ̇)
    m* v̇ = −F n + f t,   I₁ ω̇₁ = a₁ f,   I₂ ω̇₂ = a₂ f

    sticking:  f = h − γ s,  ḣ = −8 G* √(R*δ) s, and + h δ̇/2δ while δ falls     until |f| reaches μF
    sliding:   f = ∓μF, and h keeps what damping leaves of it, |h| = max(0, μF − γ|s|)
               until an elastic h would grow slower than the limit

The lever arms end on the plane of the circle in which two spheres intersect, or on the wall. The contact ends when F
vanishes (the attractive tail is cut off). The states between two changes of regime are integrated by DOP853, and the
changes are found as roots. No code is shared with the solver.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from gran_bench.state import FloatArray
from gran_bench.verification.theory import Contact, damping

SOURCE = "Hertz–Mindlin ODE, events, DOP853 at 1e-10"
FIRST_OVERLAP = 1e-7  # of the largest one: where the integration starts and ends, for δ̇/δ is singular at touch


@dataclass(frozen=True)
class Rebound:
    """Velocities when the bodies part, in the frame of their common centre of mass (of the wall, where one is).

    Attributes:
        velocity: ``(2,)`` of the first relative to the second, (x, z) m/s.
        spin: of both, about y, rad/s.
        duration: s.
        slid_throughout: whether the contact point never stuck.
    """

    velocity: FloatArray
    spin: tuple[float, float]
    duration: float
    slid_throughout: bool


class _Equations:
    """The equations of one contact; y = (displacement x, z of the second from touch; v x, z; ω₁; ω₂; h)."""

    def __init__(self, contact: Contact, normal: FloatArray, overlap: float) -> None:
        first, second = contact.first, contact.second
        self.overlap = overlap  # the largest, as a scale of lengths
        self.wall, self.normal = second.is_wall, normal
        self.R1, self.R2 = first.radius, second.radius
        self.reach = first.radius if self.wall else first.radius + second.radius
        self.mass, self.K = contact.effective_mass, contact.stiffness
        self.shear, self.friction = contact.shear_stiffness, second.material.friction
        self.alpha = damping(second.material.restitution)
        self.inertia1 = 0.4 * first.mass * first.radius**2
        self.inertia2 = math.inf if self.wall else 0.4 * second.mass * second.radius**2

    def geometry(self, y: FloatArray) -> tuple[float, FloatArray, FloatArray, float, float]:
        """Overlap, n, t and the lever arms."""
        offset = self.reach * self.normal + y[:2]
        if self.wall:
            distance = float(offset @ self.normal)
            return self.reach - distance, self.normal, _across(self.normal), distance, 0.0
        distance = math.hypot(*offset)
        normal = offset / distance
        arm = 0.5 * (distance + (self.R1**2 - self.R2**2) / distance)
        return self.reach - distance, normal, _across(normal), arm, distance - arm

    def loads(self, y: FloatArray) -> tuple[float, float, float]:
        """Normal force, damping coefficient γ and slip."""
        overlap, normal, across, arm1, arm2 = self.geometry(y)
        overlap = max(overlap, 0.0)
        gamma = self.alpha * math.sqrt(self.mass * self.K * math.sqrt(overlap))
        # Not cut off at zero: the integration ends there, and what looks ahead of the end needs a smooth force.
        force = self.K * overlap**1.5 + gamma * float(y[2:4] @ normal)
        return force, gamma, float(y[2:4] @ across) + arm1 * y[4] + arm2 * y[5]

    def elastic_rate(self, y: FloatArray) -> float:
        """ḣ of a sticking contact."""
        overlap, normal, _, _, _ = self.geometry(y)
        rate = -self.shear * math.sqrt(max(overlap, 0.0)) * self.loads(y)[2]
        closing = float(y[2:4] @ normal)
        return rate + (0.5 * y[6] * closing / overlap if closing < 0 and overlap > 0 else 0.0)

    def kept(self, y: FloatArray, sense: float) -> float:
        """h of a contact that slides with f = −sense μF."""
        force, gamma, slip = self.loads(y)
        return -sense * max(0.0, self.friction * force - gamma * slip * sense)

    def rates(self, y: FloatArray, sense: float) -> FloatArray:
        """ẏ; ``sense`` is the direction of sliding, or 0 of a sticking contact."""
        _, normal, across, arm1, arm2 = self.geometry(y)
        force, gamma, slip = self.loads(y)
        tangential = -sense * self.friction * force if sense else y[6] - gamma * slip
        push = (-force * normal + tangential * across) / self.mass
        spin1, spin2 = arm1 * tangential / self.inertia1, arm2 * tangential / self.inertia2
        return np.array([-y[2], -y[3], *push, spin1, spin2, 0.0 if sense else self.elastic_rate(y)])

    def overload(self, y: FloatArray) -> float:
        """|f| − μF of a sticking contact, N."""
        force, gamma, slip = self.loads(y)
        return abs(y[6] - gamma * slip) - self.friction * force

    def growth(self, y: FloatArray, sense: float) -> float:
        """How fast a sliding contact would exceed the limit if it stuck, N/s; negative where it would not."""
        y = np.concatenate((y[:6], [self.kept(y, sense)]))
        step = 1e-7 * self.overlap / max(math.hypot(*y[2:4]), 1e-300)
        slope = self.rates(y, sense)
        slope[6] = self.elastic_rate(y)
        ahead, behind = y + step * slope, y - step * slope

        def excess(state: FloatArray) -> float:
            force, gamma, slip = self.loads(state)
            return sense * (gamma * slip - state[6]) - self.friction * force

        return (excess(ahead) - excess(behind)) / (2.0 * step)


def _across(normal: FloatArray) -> FloatArray:
    """ŷ × n in (x, z)."""
    return np.array([normal[1], -normal[0]])


def impact(
    contact: Contact, velocity: FloatArray, spin: tuple[float, float] = (0.0, 0.0), normal: FloatArray | None = None
) -> Rebound:
    """The rebound of two bodies that just touch.

    Args:
        contact: the bodies.
        velocity: ``(2,)`` of the first relative to the second, (x, z) m/s; must approach.
        spin: of the first and the second about y, rad/s.
        normal: ``(2,)`` unit vector from the first to the second, (x, z); −z where None.

    Raises:
        RuntimeError: an integration that does not end.
    """
    normal = np.array([0.0, -1.0]) if normal is None else np.asarray(normal, float)
    velocity = np.asarray(velocity, float)
    approach, speed = float(velocity @ normal), math.hypot(*velocity)
    overlap, force = contact.largest_overlap(approach), contact.largest_force(approach)
    equations = _Equations(contact, normal, overlap)
    turning = max(speed / contact.first.radius, abs(spin[0]), abs(spin[1]))
    limits = 1e-11 * np.array([overlap, overlap, approach, approach, turning, turning, max(force, 1e-300)])
    touch = FIRST_OVERLAP * overlap
    y = np.array([*(-velocity * touch / approach), *velocity, *spin, 0.0])
    # Time runs in units of the elastic contact time: SciPy finds events to 1e-15 of a unit.
    unit = contact.duration(approach)
    time, longest, stuck = 0.0, 20.0 * (1.0 + equations.alpha), False

    def parted(_: float, y: FloatArray) -> float:
        return equations.geometry(y)[0] - 0.5 * touch

    def unloaded(_: float, y: FloatArray) -> float:
        depth, normal, *_ = equations.geometry(y)
        drag = equations.alpha * math.sqrt(equations.mass / equations.K) * float(y[2:4] @ normal)
        return (max(depth, 0.0) ** 1.25 + drag) / overlap**1.25

    for event in (parted, unloaded):
        event.terminal, event.direction = True, -1.0
    sense = _first_sense(equations, y)
    for _ in range(200):
        stuck |= sense == 0.0
        change = _change_of_regime(equations, sense, force)
        part = solve_ivp(
            lambda _, y, sense=sense: unit * equations.rates(y, sense),
            (time, longest), y, "DOP853", events=(parted, unloaded, change), rtol=1e-10, atol=limits,
        )  # fmt: skip
        y, time = part.y[:, -1], float(part.t[-1])
        if sense:
            y[6] = equations.kept(y, sense)
        # Where nothing slips, the limit vanishes with the force, and either event may come first.
        if len(part.t_events[0]) or len(part.t_events[1]) or unloaded(time, y) < 1e-10:
            return Rebound(y[2:4], (float(y[4]), float(y[5])), time * unit, not stuck)
        if not len(part.t_events[2]):
            break
        sense = 0.0 if sense else -math.copysign(1.0, _tangential(equations, y))
    raise RuntimeError(f"an impact at {velocity} m/s did not end; its equations are not what this integration expects")


def _tangential(equations: _Equations, y: FloatArray) -> float:
    """f of a sticking contact, N."""
    _, gamma, slip = equations.loads(y)
    return float(y[6] - gamma * slip)


def _first_sense(equations: _Equations, y: FloatArray) -> float:
    """Direction in which a contact slides that nothing has loaded yet, or 0 where it sticks."""
    force, gamma, slip = equations.loads(y)
    if slip == 0.0:
        return 0.0
    sense = math.copysign(1.0, slip)
    # With damping a part of the force is there at once; without it the faster one of load and limit wins.
    slides = abs(gamma * slip) > equations.friction * force if gamma else equations.growth(y, sense) > 0.0
    return sense if slides else 0.0


def _change_of_regime(equations: _Equations, sense: float, force: float):
    """The event that ends sticking or sliding."""
    if sense == 0.0:

        def slips(_: float, y: FloatArray) -> float:
            return equations.overload(y) / force

        slips.terminal, slips.direction = True, 1.0
        return slips

    def sticks(_: float, y: FloatArray) -> float:
        load, gamma, slip = equations.loads(y)
        if gamma * slip * sense > equations.friction * load:
            return 1.0
        return math.copysign(1.0, equations.growth(y, sense))

    sticks.terminal, sticks.direction = True, -1.0
    return sticks
