"""A ball that falls and bounces.

DEM01 and DEM02 of the MFiX-DEM verification manual (mfix.netl.doe.gov/doc/vvuq-manual; Garg et al. 2012) use a linear
spring; the contacts here are Hertzian, so the expected heights are of that law, and of the hard sphere that is its
limit.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.integrate import solve_ivp

from gran_bench.scene import Material
from gran_bench.state import FloatArray, Trajectory
from gran_bench.verification.case import Case, Check, Findings
from gran_bench.verification.laboratory import FLOOR, GRAVITY, SOFT, STIFF, laboratory, on_wall, run, spheres
from gran_bench.verification.theory import Contact, damping

MANUAL = "MFiX-DEM verification manual"


def _apexes(contact: Contact, height: float, bounces: int) -> list[float]:
    """Heights of the centre at the top of each bounce, m: free flight, and the contact by DOP853 at 1e-10."""
    mass, stiffness = contact.effective_mass, contact.stiffness
    alpha = damping(contact.second.material.restitution)
    apexes, top = [], height
    for _ in range(bounces):
        speed = math.sqrt(2.0 * GRAVITY * (top - contact.first.radius))

        def motion(_: float, y: FloatArray) -> tuple[float, float]:
            overlap = max(y[0], 0.0)
            drag = alpha * math.sqrt(mass * stiffness) * overlap**0.25
            return y[1], GRAVITY - (stiffness * overlap**1.5 + drag * y[1]) / mass

        def unloaded(_: float, y: FloatArray, speed: float = speed) -> float:
            # The force over δ^{1/4}; without damping it only touches zero, so it is lifted off by a trifle.
            tiny = 1e-9 * contact.largest_overlap(speed) ** 1.25 * math.sqrt(stiffness / mass)
            return max(y[0], 0.0) ** 1.25 * math.sqrt(stiffness / mass) + alpha * y[1] - tiny

        unloaded.terminal, unloaded.direction = True, -1.0
        contact_time = contact.duration(speed)
        touch = contact.largest_overlap(speed) * np.array([1e-12, 1e-12])
        part = solve_ivp(
            motion, (0.0, 20.0 * contact_time), (0.0, speed), "DOP853",
            events=unloaded, rtol=1e-10, atol=(touch[0], 1e-12 * speed), max_step=0.05 * contact_time,
        )  # fmt: skip
        overlap, velocity = part.y_events[0][0]
        top = contact.first.radius - overlap + velocity**2 / (2.0 * GRAVITY)
        apexes.append(top)
    return apexes


def _flights(trajectory: Trajectory) -> FloatArray:
    """Height that each free flight after a bounce has or would reach, z + v²/2g, m."""
    speed, free = trajectory.velocity[:, 0, 2], trajectory.diagnostics["wall_contact_count"] == 0
    energy = trajectory.position[:, 0, 2] + speed**2 / (2.0 * GRAVITY)
    rising = free & (speed > 0.0)
    return energy[1:][rising[1:] & ~rising[:-1]]


def bounce() -> Findings:
    """A ball (0.1 m radius, dropped from 0.5 m) between bounces, and how high each one takes it."""
    checks, radius, height = [], 0.1, 0.5
    for modulus in (SOFT, STIFF):
        for e in (0.6, 0.8, 1.0):
            contact = on_wall(Material(modulus, 0.3, 2600.0, e, 0.0), radius)
            step = contact.duration(math.sqrt(2.0 * GRAVITY * (height - radius))) / 200
            bounces = 3
            fall = math.sqrt(2.0 * (height - radius) / GRAVITY)
            stop = fall * (1.0 + 2.0 * sum(e**k for k in range(1, bounces))) + e**bounces * fall + 0.02
            stride = max(1, round(1e-3 / step))
            steps = math.ceil(stop / step / stride) * stride
            scene = laboratory(contact.first.material, (FLOOR,), gravity=(0, 0, -GRAVITY), radius=radius)
            trajectory = run(scene, spheres([0, 0, height], [0.3, 0, 0], None, radius), step, steps, stride).trajectory
            label, at = f"E {modulus:g} Pa, e {e:g}", [f"bounce {k + 1}" for k in range(bounces)]
            found, expected = _flights(trajectory)[:bounces], _apexes(contact, height, bounces)
            found = np.pad(found, (0, bounces - len(found)), constant_values=np.nan)
            checks.append(
                Check(
                    f"height of each bounce, m, {label}", expected, found, 2e-3,
                    "Hertz with gravity, ODE, DOP853 at 1e-10", height - radius, "of the fall", at,
                )
            )  # fmt: skip
            if modulus == STIFF:
                hard = radius + (height - radius) * e ** (2.0 * np.arange(1, bounces + 1))
                checks.append(
                    Check(
                        f"height of each bounce, m, {label}", hard, found, 5e-3,
                        f"hard sphere, (h₀ − r) e²ᵏ + r, {MANUAL} DEM02", height - radius, "of the fall", at,
                    )
                )  # fmt: skip
            falling = trajectory.time < 0.9 * fall
            t = trajectory.time[falling]
            checks.append(
                Check(
                    f"height in free fall, m, {label}",
                    [0.0],
                    [np.abs(trajectory.position[falling, 0, 2] - height + 0.5 * GRAVITY * t**2).max()],
                    1e-11, f"z = h₀ − ½ g t², {MANUAL} DEM01", 1.0, "m",
                )
            )  # fmt: skip
    return Findings(tuple(checks))


CASES = (Case("bounce", "a ball falls and bounces (MFiX DEM01, DEM02)", bounce),)
