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
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from gran_bench.state import FloatArray
from gran_bench.verification.theory import Contact, damping

SOURCE = "Hertz–Mindlin ODE, events, DOP853 at 1e-10"
DOWN = np.array([0.0, -1.0])  # (x, z), from the first body to the second when they touch
FIRST_OVERLAP = 1e-7  # of the largest one: where the integration starts and ends, for δ̇/δ is singular at touch


@dataclass(frozen=True)
class Rebound:
    """Velocities when the bodies part, in the frame of their common centre of mass (of the wall, where one is)."""

    velocity: FloatArray  # ``(2,)`` of the first relative to the second, (x, z) m/s
    spin: tuple[float, float]  # of both, about y, rad/s
    duration: float  # s
    slid_throughout: bool  # whether the contact point never stuck


class _Loads(NamedTuple):
    """A contact at one instant; the force is not cut off at zero: what looks ahead of the end needs a smooth one."""

    overlap: float
    normal: FloatArray
    across: FloatArray
    arm1: float
    arm2: float
    closing: float
    slip: float
    force: float
    gamma: float


class _Equations:
    """The equations of one contact; y = (displacement x, z of the second from touch; v x, z; ω₁; ω₂; h)."""

    def __init__(self, contact: Contact, overlap: float) -> None:
        first, second = contact.first, contact.second
        self.overlap = overlap  # the largest, as a scale of lengths
        self.wall = second.is_wall
        self.R1, self.R2 = first.radius, second.radius
        self.reach = first.radius if self.wall else first.radius + second.radius
        self.mass, self.K = contact.effective_mass, contact.stiffness
        self.shear, self.friction = contact.shear_stiffness, second.material.friction
        self.alpha = damping(second.material.restitution)
        self.inertia1 = 0.4 * first.mass * first.radius**2
        self.inertia2 = math.inf if self.wall else 0.4 * second.mass * second.radius**2

    def loads(self, y: FloatArray) -> _Loads:
        offset = self.reach * DOWN + y[:2]
        if self.wall:
            distance, normal = float(offset @ DOWN), DOWN
            arm1, arm2 = distance, 0.0
        else:
            distance = math.hypot(*offset)
            normal = offset / distance
            arm1 = 0.5 * (distance + (self.R1**2 - self.R2**2) / distance)
            arm2 = distance - arm1
        across, overlap = np.array([normal[1], -normal[0]]), self.reach - distance
        depth, closing = max(overlap, 0.0), float(y[2:4] @ normal)
        gamma = self.alpha * math.sqrt(self.mass * self.K * math.sqrt(depth))
        slip = float(y[2:4] @ across) + arm1 * y[4] + arm2 * y[5]
        return _Loads(overlap, normal, across, arm1, arm2, closing, slip, self.K * depth**1.5 + gamma * closing, gamma)

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
        tangential = -sense * self.friction * at.force if sense else y[6] - at.gamma * at.slip
        push = (-at.force * at.normal + tangential * at.across) / self.mass
        spin1, spin2 = at.arm1 * tangential / self.inertia1, at.arm2 * tangential / self.inertia2
        return np.array([-y[2], -y[3], *push, spin1, spin2, 0.0 if sense else self.elastic_rate(y, at)])

    def growth(self, y: FloatArray, sense: float) -> float:
        """How fast a sliding contact would exceed the limit if it stuck, N/s; negative where it would not."""
        y = np.concatenate((y[:6], [self.kept(y, sense)]))
        step = 1e-7 * self.overlap / max(math.hypot(*y[2:4]), 1e-300)
        slope = self.rates(y, sense)
        slope[6] = self.elastic_rate(y, self.loads(y))

        def excess(state: FloatArray) -> float:
            at = self.loads(state)
            return sense * (at.gamma * at.slip - state[6]) - self.friction * at.force

        return (excess(y + step * slope) - excess(y - step * slope)) / (2.0 * step)

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
            at = self.loads(y)
            return (abs(y[6] - at.gamma * at.slip) - self.friction * at.force) / force

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

    Args:
        contact: the bodies.
        velocity: ``(2,)`` of the first relative to the second, (x, z) m/s; must approach.
        spin: of the first and the second about y, rad/s.

    Raises:
        RuntimeError: an integration that does not end.
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
    time, longest, stuck = 0.0, 20.0 * (1.0 + equations.alpha), False

    def parted(_: float, y: FloatArray) -> float:
        return equations.loads(y).overlap - 0.5 * touch

    def unloaded(_: float, y: FloatArray) -> float:
        at = equations.loads(y)
        drag = equations.alpha * math.sqrt(equations.mass / equations.K) * at.closing
        return (max(at.overlap, 0.0) ** 1.25 + drag) / overlap**1.25

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
