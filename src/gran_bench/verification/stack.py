"""Two balls squeezed between walls.

DEM03 of the MFiX-DEM verification manual (mfix.netl.doe.gov/doc/vvuq-manual; Chen et al. 2007, Garg et al. 2012) uses
linear springs and two densities; the contacts here are Hertzian and the balls alike, and so is what is expected.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from gran_bench.scene import Material, Plane
from gran_bench.state import FloatArray
from gran_bench.verification.bounce import MANUAL
from gran_bench.verification.case import Case, Check, Findings
from gran_bench.verification.laboratory import FLOOR, GRAVITY, SOFT, STIFF, laboratory, on_wall, run, spheres
from gran_bench.verification.theory import Contact, damping


def _stack_forces(contact: Contact, pair: Contact, gap: float, y: FloatArray) -> tuple[float, float]:
    """Upward forces on the lower and the upper sphere between two walls; y = (z₁, z₂, ż₁, ż₂)."""

    def push(c: Contact, overlap: float, closing: float) -> float:
        overlap = max(overlap, 0.0)
        drag = damping(c.second.material.restitution) * math.sqrt(c.effective_mass * c.stiffness) * overlap**0.25
        return max(0.0, c.stiffness * overlap**1.5 + drag * closing)

    r = contact.first.radius
    floor = push(contact, r - y[0], -y[2])
    middle = push(pair, 2.0 * r - (y[1] - y[0]), y[2] - y[3])
    ceiling = push(contact, r - (gap - y[1]), y[3])
    weight = contact.first.mass * GRAVITY
    return floor - middle - weight, middle - ceiling - weight


def stack() -> Findings:
    """Two spheres (0.5 mm radius) squeezed between walls 3.6 r apart: their motion, and where they come to rest."""
    checks, r = [], 5e-4
    gap = 3.6 * r
    walls = (FLOOR, Plane((0.0, 0.0, gap), (0.0, 0.0, -1.0), turns=False))
    for modulus in (SOFT, STIFF):
        for e in (1.0, 0.5):
            material = Material(modulus, 0.3, 2500.0, e, 0.0)
            contact = on_wall(material, r)
            pair = Contact(contact.first, contact.first)
            swing = 2.0 * math.pi * math.sqrt(contact.first.mass / (1.5 * contact.stiffness * math.sqrt(0.1 * r)))
            step, periods = swing / 400, 10 if e == 1.0 else 60
            start = np.array([0.25 * gap, 0.75 * gap])
            scene = laboratory(material, walls, gravity=(0, 0, -GRAVITY), radius=r)
            state = spheres(np.stack((np.zeros(2), np.zeros(2), start), axis=1), radius=r)
            trajectory = run(scene, state, step, 400 * periods, 20).trajectory
            label = f"E {modulus:g} Pa, e {e:g}"
            if e == 1.0:

                def motion(_: float, y: FloatArray, contact=contact, pair=pair) -> list[float]:
                    force = _stack_forces(contact, pair, gap, y)
                    return [y[2], y[3], *(f / contact.first.mass for f in force)]

                exact = solve_ivp(
                    motion, (0.0, trajectory.time[-1]), [*start, 0.0, 0.0], "DOP853",
                    t_eval=trajectory.time, rtol=1e-11, atol=1e-14 * r,
                )  # fmt: skip
                for k, name in enumerate(("lower", "upper")):
                    off = np.abs(trajectory.position[:, k, 2] - exact.y[k]).max()
                    checks.append(
                        Check(
                            f"height of the {name} sphere over {periods} swings, m, {label}", [0.0], [off], 1e-3,
                            f"Hertz, ODE, DOP853 at 1e-11; {MANUAL} DEM03", r, "of r",
                        )
                    )  # fmt: skip
            else:
                rest = _rest_of_stack(contact, pair, gap)
                last = trajectory.position[-20:, :, 2]  # a swing; at one instant a sphere may pass through its place
                farthest = last[np.abs(last - rest).argmax(axis=0), (0, 1)]
                checks.append(
                    Check(
                        f"where the spheres rest, m, {label}", rest, farthest, 1e-6,
                        f"balance of Hertz forces and weight; {MANUAL} DEM03", r, "of r", ("lower", "upper"),
                    )
                )  # fmt: skip
    return Findings(tuple(checks))


def _rest_of_stack(contact: Contact, pair: Contact, gap: float) -> tuple[float, float]:
    """Heights at which both spheres are in balance, m."""
    r, weight = contact.first.radius, contact.first.mass * GRAVITY

    def upper_excess(lower: float) -> float:
        middle = contact.stiffness * (r - lower) ** 1.5 - weight
        upper = lower + 2.0 * r - (middle / pair.stiffness) ** (2.0 / 3.0)
        return middle - weight - contact.stiffness * max(0.0, r - (gap - upper)) ** 1.5

    lower = brentq(upper_excess, 0.5 * r, r - contact.resting_overlap(1.0001 * weight), xtol=1e-16)
    middle = contact.stiffness * (r - lower) ** 1.5 - weight
    return lower, lower + 2.0 * r - pair.resting_overlap(middle)


CASES = (Case("stack", "two balls squeezed between walls (MFiX DEM03)", stack),)
