"""One or two spheres with walls and gravity: the single-particle cases of the MFiX-DEM verification manual.

DEM01–DEM04 of the manual (mfix.netl.doe.gov/doc/vvuq-manual; Garg et al. 2012; Chen et al. 2007 for the stack) use a
linear spring; the contacts here are Hertzian, so the expected curves of bounce and stack are of that law.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from gran_bench.scene import Material, Plane
from gran_bench.state import FloatArray
from gran_bench.verification.case import Case, Check, Findings
from gran_bench.verification.laboratory import (
    FLOOR,
    RADIUS,
    SOFT,
    STIFF,
    laboratory,
    on_wall,
    run,
    sphere_material,
    spheres,
)
from gran_bench.verification.theory import Contact, damping

GRAVITY = 9.81  # m/s²
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


def _flights(trajectory) -> FloatArray:
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
                checks.append(
                    Check(
                        f"where the spheres rest, m, {label}", rest, trajectory.position[-1, :, 2], 1e-6,
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


def _swing_period(contact: Contact, load: float) -> float:
    """Period of a sphere that bobs on its contact under a load, 2π √(m/k), k = 3/2 K √δ, s."""
    overlap = contact.resting_overlap(load)
    return 2.0 * math.pi * math.sqrt(contact.first.mass / (1.5 * contact.stiffness * math.sqrt(overlap)))


def slip_to_roll() -> Findings:
    """A ball that slides starts to roll: u = u₀ − μ g t until t = 2u₀/7μg, then u = 5/7 u₀ (for a rigid one)."""
    # Fast, so that it slides for long beside the time in which the contact takes up its load.
    checks, speed = [], 5.0
    source = f"u = u₀ − μgt, then rolling, with the arm a = R − δ; {MANUAL} DEM04"
    frictions = (0.1, 0.3, 0.6, 1.0)
    for modulus in (SOFT, STIFF):
        rows: dict[str, tuple[list[float], list[float]]] = {n: ([], []) for n in ("rate", "time", "speed", "spin")}
        for friction in frictions:
            contact = on_wall(sphere_material(modulus, 0.5, friction))
            load = contact.first.mass * GRAVITY
            arm = RADIUS - contact.resting_overlap(load)
            lever = 2.5 * (arm / RADIUS) ** 2
            stop = speed / (friction * GRAVITY * (1.0 + lever))
            step = min(_swing_period(contact, load) / 60, stop / 2000)
            stride = max(1, round(stop / 1000 / step))
            scene = laboratory(contact.first.material, (FLOOR,), gravity=(0, 0, -GRAVITY))
            state = spheres([0, 0, arm], [speed, 0, 0])
            trajectory = run(scene, state, step, math.ceil(1.6 * stop / step / stride) * stride, stride).trajectory
            t, u, w = trajectory.time, trajectory.velocity[:, 0, 0], trajectory.angular_velocity[:, 0, 1]
            early, late = np.searchsorted(t, 0.1 * stop), np.searchsorted(t, 0.9 * stop)
            slip = u - arm * w
            first = int(np.flatnonzero(slip <= 0.0)[0]) if (slip <= 0.0).any() else len(slip) - 1
            share = slip[first - 1] / (slip[first - 1] - slip[first])
            settled = t > 1.3 * stop
            for name, expected, found in (
                ("rate", -friction * GRAVITY, (u[late] - u[early]) / (t[late] - t[early])),
                ("time", stop, t[first - 1] + share * (t[first] - t[first - 1])),
                ("speed", speed * lever / (1.0 + lever), u[settled].mean()),
                ("spin", speed * lever / (1.0 + lever) / arm, w[settled].mean()),
            ):
                rows[name][0].append(expected)
                rows[name][1].append(float(found))
        label, at = f"E {modulus:g} Pa", [f"μ {friction:g}" for friction in frictions]
        for name, quantity, tolerance in (
            ("rate", "deceleration while it slides, m/s²", 1e-3),
            ("time", "when it rolls, s", 1e-2),
            ("speed", "speed when it rolls, m/s", 1e-3),
            ("spin", "spin when it rolls, rad/s", 1e-3),
        ):
            checks.append(Check(f"{quantity}, {label}", *rows[name], tolerance, source, at=at))
    return Findings(tuple(checks))


def _down_the_slope(
    modulus: float, slope_deg: float, friction: float, rolling_friction: float, duration: float = 0.4
) -> tuple[float, float, float]:
    """Acceleration along the slope, spin rate, and distance gone, of a ball put on it at rest (m/s², rad/s², m)."""
    angle = math.radians(slope_deg)
    along, normal = np.array([math.cos(angle), 0.0, -math.sin(angle)]), (math.sin(angle), 0.0, math.cos(angle))
    contact = on_wall(sphere_material(modulus, 0.3, friction, rolling_friction))
    load = contact.first.mass * GRAVITY * math.cos(angle)
    arm = RADIUS - contact.resting_overlap(load)
    step = _swing_period(contact, load) / 60
    stride = math.ceil(duration / 80 / step)
    scene = laboratory(contact.first.material, (Plane((0.0, 0.0, 0.0), normal, turns=False),), gravity=(0, 0, -GRAVITY))
    trajectory = run(scene, spheres(arm * np.array(normal)), step, 80 * stride, stride).trajectory
    speed, spin, time = trajectory.velocity[:, 0] @ along, trajectory.angular_velocity[:, 0, 1], trajectory.time
    gone = (trajectory.position[-1, 0] - trajectory.position[0, 0]) @ along
    # The slope of a straight line through the later half, in which the first jolt has died away.
    late = slice(len(time) // 2, None)
    rates = (float(np.polyfit(time[late], values[late], 1)[0]) for values in (speed, spin))
    return *rates, float(gone)


def incline() -> Findings:
    """A ball on a slope: rolls with 5/7 g sin θ, slides with g (sin θ − μ cos θ), or is held by rolling friction."""
    checks = []
    for modulus in (SOFT, STIFF):
        label = f"E {modulus:g} Pa"

        def arm_of(slope: float, modulus: float = modulus) -> float:
            contact = on_wall(sphere_material(modulus))
            return 1.0 - contact.resting_overlap(contact.first.mass * GRAVITY * math.cos(slope)) / RADIUS

        slopes = np.radians([2.0, 10.0, 25.0])
        found = [_down_the_slope(modulus, s, 0.8, 0.0)[0] for s in np.degrees(slopes)]
        rolling = [GRAVITY * math.sin(s) / (1.0 + 0.4 / arm_of(s) ** 2) for s in slopes]
        at = [f"{s:g}°" for s in np.degrees(slopes)]
        checks.append(
            Check(
                f"acceleration of a rolling ball, m/s², {label}", rolling, found, 1e-3,
                "5/7 g sin θ, with the arm R − δ: g sin θ/(1 + ⅖R²/a²)", at=at,
            )
        )  # fmt: skip
        slopes, friction = np.radians([30.0, 45.0]), 0.1
        measured = [_down_the_slope(modulus, s, friction, 0.0) for s in np.degrees(slopes)]
        sliding = [GRAVITY * (math.sin(s) - friction * math.cos(s)) for s in slopes]
        turning = [2.5 * friction * GRAVITY * math.cos(s) * arm_of(s) / RADIUS for s in slopes]
        at = [f"{s:g}°" for s in np.degrees(slopes)]
        checks += [
            Check(
                f"acceleration of a sliding ball, m/s², {label}", sliding, [m[0] for m in measured], 1e-3,
                "g (sin θ − μ cos θ)", at=at,
            ),
            Check(
                f"spin rate of a sliding ball, rad/s², {label}", turning, [m[1] for m in measured], 1e-3,
                "5/2 μ g cos θ a/R²", at=at,
            ),
        ]  # fmt: skip
        resistance, slope = 0.17, math.radians(15.0)
        held = _down_the_slope(modulus, 5.0, 0.8, resistance)[2]
        free = 0.5 * 5.0 / 7.0 * GRAVITY * math.sin(math.radians(5.0)) * 0.4**2
        rolls = _down_the_slope(modulus, 15.0, 0.8, resistance)[0]
        resisted = GRAVITY * (math.sin(slope) - resistance * math.cos(slope) / arm_of(slope))
        checks += [
            Check(
                f"way of a ball that rolling friction holds (5°, μ_r 0.17), m, {label}", [0.0], [held], 1e-2,
                "held where tan θ < μ_r (Ai et al. 2011)", free, "of the free way",
            ),
            Check(
                f"acceleration against rolling friction (15°, μ_r 0.17), m/s², {label}",
                resisted / (1.0 + 0.4 / arm_of(slope) ** 2), rolls, 1e-3,
                "5/7 g (sin θ − μ_r cos θ), with the arm R − δ",
            ),
        ]  # fmt: skip
    return Findings(tuple(checks))


CASES = (
    Case("bounce", "a ball falls and bounces (MFiX DEM01, DEM02)", bounce),
    Case("stack", "two balls squeezed between walls (MFiX DEM03)", stack),
    Case("slip-to-roll", "a sliding ball starts to roll (MFiX DEM04)", slip_to_roll),
    Case("incline", "a ball rolls, slides or is held on a slope", incline),
)
