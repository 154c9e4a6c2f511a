"""A ball on a plane or a slope: it slides, starts to roll, rolls, or is stopped and held by rolling friction.

Slip to roll is DEM04 of the MFiX-DEM verification manual (mfix.netl.doe.gov/doc/vvuq-manual; Garg et al. 2012).
"""

from __future__ import annotations

import math

import numpy as np

from gran_bench.scene import Plane
from gran_bench.verification.bounce import MANUAL
from gran_bench.verification.case import Case, Check, Findings
from gran_bench.verification.laboratory import (
    FLOOR,
    GRAVITY,
    RADIUS,
    SOFT,
    STIFF,
    laboratory,
    on_wall,
    run,
    sphere_material,
    spheres,
)
from gran_bench.verification.theory import Contact


def bobbing_period(contact: Contact, load: float) -> float:
    """Period of a sphere that bobs on its contact under a load, 2π √(m/k), k = 3/2 K √δ: its fastest motion, s."""
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
            step = min(bobbing_period(contact, load) / 60, stop / 2000)
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
    step = bobbing_period(contact, load) / 60
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


def rolling_stop() -> Findings:
    """A ball that rolls on a plane: μ_r r m g stops it in a known time, and then it stays at rest."""
    checks, speed, resistances = [], 0.2, (0.02, 0.1, 0.5)
    for modulus in (SOFT, STIFF):
        expected, found, left = [], [], []
        for resistance in resistances:
            contact = on_wall(sphere_material(modulus, 0.5, 0.6, resistance))
            load = contact.first.mass * GRAVITY
            arm = RADIUS - contact.resting_overlap(load)
            rate = resistance * GRAVITY * arm * RADIUS / (arm**2 + 0.4 * RADIUS**2)
            step = bobbing_period(contact, load) / 60
            stride = math.ceil(speed / rate / 100 / step)
            scene = laboratory(contact.first.material, (FLOOR,), gravity=(0, 0, -GRAVITY))
            state = spheres([0, 0, arm], [speed, 0, 0], [0, speed / arm, 0])
            trajectory = run(scene, state, step, 200 * stride, stride).trajectory
            t, u = trajectory.time, trajectory.velocity[:, 0, 0]
            rolls = slice(20, 90)
            expected.append(-rate)
            found.append(float(np.polyfit(t[rolls], u[rolls], 1)[0]))
            left.append(float(np.linalg.norm(trajectory.velocity[-20:, 0], axis=1).max()))
        label, at = f"E {modulus:g} Pa", [f"μ_r {resistance:g}" for resistance in resistances]
        checks += [
            Check(
                f"deceleration by rolling friction, m/s², {label}", expected, found, 1e-3,
                "5/7 μ_r g, with the arm a = R − δ: μ_r g R a/(a² + ⅖R²)", at=at,
            ),
            Check(
                f"speed left after twice the time to stop, m/s, {label}", [0.0] * len(left), left, 1e-3,
                "it stays at rest (Ai et al. 2011, model C with a critical dashpot)", speed, "of the first speed", at,
            ),
        ]  # fmt: skip
    return Findings(tuple(checks))


CASES = (
    Case("slip-to-roll", "a sliding ball starts to roll (MFiX DEM04)", slip_to_roll),
    Case("rolling-stop", "rolling friction stops a ball, which then stays at rest", rolling_stop),
    Case("incline", "a ball rolls, slides or is held on a slope", incline),
)
