"""A ball that falls and bounces, and two balls squeezed between walls: DEM01–DEM03 of the MFiX-DEM verification manual.

The manual (mfix.netl.doe.gov/doc/vvuq-manual; Chen et al. 2007, Garg et al. 2012) has linear springs and two densities;
the contacts here are Hertzian and the balls alike, and so is what is expected.
"""

import math
from collections.abc import Iterator
from itertools import product

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from gran_bench.scene import Material, Plane
from gran_bench.state import FloatArray
from gran_bench.verification import laboratory as lab
from gran_bench.verification.case import Case, Check
from gran_bench.verification.theory import Contact

MANUAL = "MFiX-DEM verification manual"
BOUNCES = 3


def _apexes(contact: Contact, height: float) -> list[float]:
    """Heights of the centre at the top of each bounce, m: free flight, and the contact by DOP853 at 1e-10."""
    mass, radius, apexes = contact.effective_mass, contact.first.radius, [height]
    for _ in range(BOUNCES):
        speed = math.sqrt(2.0 * lab.GRAVITY * (apexes[-1] - radius))
        deepest, contact_time = contact.largest_overlap(speed), contact.duration(speed)
        # The force over δ^{1/4}; without damping it only touches zero, so it is lifted off by a trifle.
        tiny = 1e-9 * contact.stiffness * deepest**1.25

        def motion(_: float, y: FloatArray) -> tuple[float, float]:
            return y[1], lab.GRAVITY - contact.force(*y) / mass

        def unloaded(_: float, y: FloatArray, tiny: float = tiny) -> float:
            return contact.stiffness * max(y[0], 0.0) ** 1.25 + contact.damper * y[1] - tiny

        unloaded.terminal, unloaded.direction = True, -1.0
        part = solve_ivp(
            motion, (0.0, 20.0 * contact_time), (0.0, speed), "DOP853", events=unloaded,
            rtol=1e-10, atol=(deepest * 1e-12, 1e-12 * speed), max_step=0.05 * contact_time,
        )  # fmt: skip
        overlap, velocity = part.y_events[0][0]
        apexes.append(radius - overlap + velocity**2 / (2.0 * lab.GRAVITY))
    return apexes[1:]


def bounce() -> Iterator[Check]:
    """A ball (0.1 m radius, dropped from 0.5 m) between bounces, and how high each one takes it."""
    radius, height, number = 0.1, 0.5, np.arange(1, BOUNCES + 1)
    at, drop = [f"bounce {k}" for k in number], height - radius
    for modulus, e in product((lab.SOFT, lab.STIFF), (0.6, 0.8, 1.0)):
        contact = lab.on_wall(Material(modulus, 0.3, 2600.0, e, 0.0), radius)
        step = contact.duration(math.sqrt(2.0 * lab.GRAVITY * drop)) / 200
        fall = math.sqrt(2.0 * drop / lab.GRAVITY)
        stop = fall * (1.0 + 2.0 * sum(e**k for k in range(1, BOUNCES))) + e**BOUNCES * fall + 0.02
        scene = lab.laboratory(contact.first.material, (lab.FLOOR,), gravity=lab.DOWN, radius=radius)
        trajectory = lab.watch(scene, lab.spheres([0, 0, height], [0.3, 0, 0], None, radius), step, stop, 1e-3)
        # Each free flight after a bounce has or would reach z + v²/2g.
        z, speed = trajectory.position[:, 0, 2], trajectory.velocity[:, 0, 2]
        rising = (trajectory.diagnostics["wall_contact_count"] == 0) & (speed > 0.0)
        found = (z + speed**2 / (2.0 * lab.GRAVITY))[1:][rising[1:] & ~rising[:-1]][:BOUNCES]
        found = np.pad(found, (0, BOUNCES - len(found)), constant_values=np.nan)
        label, ode = f"E {modulus:g} Pa, e {e:g}", "Hertz with gravity, ODE, DOP853 at 1e-10"
        quantity, words = f"height of each bounce, m, {label}", (drop, "of the fall", at)
        yield Check(quantity, _apexes(contact, height), found, 2e-3, ode, *words)
        if modulus == lab.STIFF:
            hard, source = radius + drop * e ** (2.0 * number), f"hard sphere, (h₀ − r) e²ᵏ + r, {MANUAL} DEM02"
            yield Check(quantity, hard, found, 5e-3, source, *words)
        falling = trajectory.time < 0.9 * fall
        off = np.abs(z[falling] - height + 0.5 * lab.GRAVITY * trajectory.time[falling] ** 2).max()
        source = f"z = h₀ − ½ g t², {MANUAL} DEM01"
        yield Check(f"height in free fall, m, {label}", 0.0, off, 1e-11, source, 1.0, "m")


def _stack_forces(contact: Contact, pair: Contact, gap: float, y: FloatArray) -> tuple[float, float]:
    """Upward forces on the lower and the upper sphere between two walls; y = (z₁, z₂, ż₁, ż₂)."""
    r, weight = contact.first.radius, contact.first.mass * lab.GRAVITY
    floor, middle, ceiling = (
        max(0.0, one.force(overlap, closing))
        for one, overlap, closing in (
            (contact, r - y[0], -y[2]), (pair, 2.0 * r - (y[1] - y[0]), y[2] - y[3]), (contact, r - (gap - y[1]), y[3])
        )
    )  # fmt: skip
    return floor - middle - weight, middle - ceiling - weight


def _rest_of_stack(contact: Contact, pair: Contact, gap: float) -> tuple[float, float]:
    """Heights at which both spheres are in balance, m."""
    r, weight = contact.first.radius, contact.first.mass * lab.GRAVITY

    def upper_excess(lower: float) -> float:
        middle = contact.stiffness * (r - lower) ** 1.5 - weight
        upper = lower + 2.0 * r - (middle / pair.stiffness) ** (2.0 / 3.0)
        return middle - weight - contact.stiffness * max(0.0, r - (gap - upper)) ** 1.5

    lower = brentq(upper_excess, 0.5 * r, r - contact.resting_overlap(1.0001 * weight), xtol=1e-16)
    return lower, lower + 2.0 * r - pair.resting_overlap(contact.stiffness * (r - lower) ** 1.5 - weight)


def stack() -> Iterator[Check]:
    """Two spheres (0.5 mm radius) squeezed between walls 3.6 r apart: their motion, and where they come to rest."""
    r, names = 5e-4, ("lower", "upper")
    gap = 3.6 * r
    walls = lab.FLOOR, Plane((0.0, 0.0, gap), (0.0, 0.0, -1.0), turns=False)
    start = np.array([0.25 * gap, 0.75 * gap])
    for modulus, (e, periods) in product((lab.SOFT, lab.STIFF), ((1.0, 10), (0.5, 60))):
        contact = lab.on_wall(Material(modulus, 0.3, 2500.0, e, 0.0), r)
        pair, mass = Contact(contact.first, contact.first), contact.first.mass
        step = 2.0 * math.pi * math.sqrt(mass / (1.5 * contact.stiffness * math.sqrt(0.1 * r))) / 400
        scene = lab.laboratory(contact.first.material, walls, gravity=lab.DOWN, radius=r)
        state = lab.spheres(np.stack((np.zeros(2), np.zeros(2), start), axis=1), radius=r)
        trajectory, label = lab.run(scene, state, step, 400 * periods, 20).trajectory, f"E {modulus:g} Pa, e {e:g}"
        if e == 1.0:

            def motion(_: float, y: FloatArray, contact: Contact = contact, pair: Contact = pair) -> list[float]:
                return [y[2], y[3], *(f / contact.first.mass for f in _stack_forces(contact, pair, gap, y))]

            exact = solve_ivp(
                motion, (0.0, trajectory.time[-1]), [*start, 0.0, 0.0], "DOP853",
                t_eval=trajectory.time, rtol=1e-11, atol=1e-14 * r,
            )  # fmt: skip
            for k, name in enumerate(names):
                off, source = np.abs(trajectory.position[:, k, 2] - exact.y[k]).max(), "Hertz, ODE, DOP853 at 1e-11"
                quantity = f"height of the {name} sphere over {periods} swings, m, {label}"
                yield Check(quantity, 0.0, off, 1e-3, f"{source}; {MANUAL} DEM03", r, "of r")
        else:
            rest, source = _rest_of_stack(contact, pair, gap), f"balance of Hertz forces and weight; {MANUAL} DEM03"
            last = trajectory.position[-20:, :, 2]  # a swing; at one instant a sphere may pass through its place
            farthest = last[np.abs(last - rest).argmax(axis=0), (0, 1)]
            yield Check(f"where the spheres rest, m, {label}", rest, farthest, 1e-6, source, r, "of r", names)


CASES = (
    Case("bounce", "a ball falls and bounces (MFiX DEM01, DEM02)", bounce),
    Case("stack", "two balls squeezed between walls (MFiX DEM03)", stack),
)
