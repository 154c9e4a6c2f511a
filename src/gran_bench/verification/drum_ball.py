"""One ball in a drum: how it swings in a resting one, and where and how fast it spins in a turning one."""

from __future__ import annotations

import math

import numpy as np

from gran_bench.scene import Cylinder, Rotation
from gran_bench.state import FloatArray
from gran_bench.verification.case import Case, Check, Findings
from gran_bench.verification.laboratory import (
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
from gran_bench.verification.rolling_ball import bobbing_period

DRUM = 0.5  # m
WALL = Cylinder((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), DRUM)


def _crossings(time: FloatArray, angle: FloatArray) -> FloatArray:
    """Times at which an angle passes zero on its way up, interpolated, s."""
    k = np.flatnonzero((angle[:-1] < 0.0) & (angle[1:] >= 0.0))
    return time[k] - angle[k] * (time[k + 1] - time[k]) / (angle[k + 1] - angle[k])


def swing() -> Findings:
    """Period of a ball that rolls to and fro at the bottom of a resting drum, and of one that slides (μ = 0)."""
    checks = []
    amplitude = 0.05  # rad
    finite = 1.0 + amplitude**2 / 16.0
    for modulus in (SOFT, STIFF):
        expected, found = [], []
        for friction in (0.8, 0.0):
            contact = on_wall(sphere_material(modulus, 0.3, friction))
            overlap = contact.resting_overlap(contact.first.mass * GRAVITY)
            arm, reach = RADIUS - overlap, DRUM - RADIUS + overlap
            turning = 0.4 * (RADIUS / arm) ** 2 if friction else 0.0
            expected.append(2.0 * math.pi * math.sqrt(reach * (1.0 + turning) / GRAVITY) * finite)
            step = bobbing_period(contact, contact.first.mass * GRAVITY) / 40
            scene = laboratory(contact.first.material, (WALL,), gravity=(0, 0, -GRAVITY))
            start = reach * np.array([math.sin(amplitude), 0.0, -math.cos(amplitude)])
            stride = max(1, round(5e-3 / step))
            steps = math.ceil(4.2 * expected[-1] / step / stride) * stride
            trajectory = run(scene, spheres(start), step, steps, stride).trajectory
            angle = np.arctan2(trajectory.position[:, 0, 0], -trajectory.position[:, 0, 2])
            passed = _crossings(trajectory.time, angle)
            found.append((passed[-1] - passed[0]) / (len(passed) - 1))
        checks.append(
            Check(
                f"period of a small swing, s, E {modulus:g} Pa", expected, found, 1e-3,
                "ω² = 5g/7(R − r) rolling, g/(R − r) sliding; arm and reach with the overlap, amplitude 0.05 rad",
                at=("rolling, μ 0.8", "sliding, μ 0"),
            )
        )  # fmt: skip
    return Findings(tuple(checks))


def steady_place() -> Findings:
    """A ball in a drum at 30 rpm: its spin at the bottom, and where rolling friction takes it."""
    checks, rpm = [], 30.0
    speed = rpm * 2.0 * math.pi / 60.0
    for modulus in (SOFT, STIFF):
        places, spins, wanted_places, wanted_spins, at = [], [], [], [], []
        for resistance in (0.0, 0.05, 0.1):
            contact = on_wall(sphere_material(modulus, 0.3, 0.8, resistance))
            load = contact.first.mass * GRAVITY
            arm = RADIUS - contact.resting_overlap(load)
            # Torque balance: friction m g sin θ on the arm carries the rolling moment μ_r R m g cos θ.
            place = math.atan(resistance * RADIUS / arm)
            overlap = contact.resting_overlap(load * math.cos(place))
            arm, reach = RADIUS - overlap, DRUM - RADIUS + overlap
            place = math.atan(resistance * RADIUS / arm)
            spin = speed * DRUM / arm
            step = bobbing_period(contact, contact.first.mass * GRAVITY) / 40
            scene = laboratory(
                contact.first.material, (WALL,), gravity=(0, 0, -GRAVITY), rotation=Rotation((0.0,), (rpm,))
            )
            # The bed of a drum that turns with +y climbs towards −x.
            start = reach * np.array([-math.sin(place), 0.0, -math.cos(place)])
            stride = max(1, round(5e-3 / step))
            swing_period = 2.0 * math.pi * math.sqrt(1.4 * reach / (GRAVITY * math.cos(place)))
            steps = math.ceil(3.0 * swing_period / step / stride) * stride
            trajectory = run(scene, spheres(start, None, [0.0, spin, 0.0]), step, steps, stride).trajectory
            late = trajectory.time > swing_period
            angle = np.arctan2(-trajectory.position[late, 0, 0], -trajectory.position[late, 0, 2])
            places.append(float(angle.mean()))
            spins.append(float(trajectory.angular_velocity[late, 0, 1].mean()))
            wanted_places.append(place)
            wanted_spins.append(spin)
            at.append(f"μ_r {resistance:g}")
        checks += [
            Check(
                f"spin at 30 rpm, rad/s, E {modulus:g} Pa", wanted_spins, spins, 1e-3,
                "ω = Ω R/(r − δ), no slip", at=at,
            ),
            Check(
                f"angle of its place at 30 rpm, rad, E {modulus:g} Pa", wanted_places, places, 1e-3,
                "tan θ = μ_r r/(r − δ), balance of moments", 1.0, "rad", at,
            ),
        ]  # fmt: skip
    return Findings(tuple(checks))


def set_going() -> Findings:
    """A ball at rest in a drum that starts at once: while it slips, the wall drags it with μ g and spins it up."""
    checks, friction, rpm = [], 0.1, 60.0
    for modulus in (SOFT, STIFF):
        contact = on_wall(sphere_material(modulus, 0.3, friction))
        overlap = contact.resting_overlap(contact.first.mass * GRAVITY)
        arm, reach = RADIUS - overlap, DRUM - RADIUS + overlap
        step, time = bobbing_period(contact, contact.first.mass * GRAVITY) / 60, 0.05
        steps = math.ceil(time / step)
        scene = laboratory(contact.first.material, (WALL,), gravity=(0, 0, -GRAVITY), rotation=Rotation((0.0,), (rpm,)))
        final = run(scene, spheres([0.0, 0.0, -reach]), step, steps).final
        time = steps * step
        # Along the wall: s̈ = μ (g cos φ + ṡ²/reach) − g sin φ, φ = s/reach; to this order in t.
        pull = friction * GRAVITY
        speed = pull * time * (1.0 - GRAVITY * time**2 / (6.0 * reach))
        checks += [
            Check(
                f"speed towards −x after 0.05 s, m/s, E {modulus:g} Pa", -speed, final.velocity[0, 0], 0.01,
                "Coulomb: ẍ = −μ g while it slips, and the wall's slope", at=(f"{rpm:g} rpm",),
            ),
            Check(
                f"spin after 0.05 s, rad/s, E {modulus:g} Pa",
                2.5 * pull * time * arm / RADIUS**2, final.angular_velocity[0, 1], 0.01,
                "Coulomb: ω̇ = 5/2 μ g a/r² while it slips", at=(f"{rpm:g} rpm",),
            ),
        ]  # fmt: skip
    return Findings(tuple(checks))


CASES = (
    Case("drum-swing", "a ball swings in a resting drum", swing),
    Case("drum-spin", "a ball in a turning drum: its spin and its place", steady_place),
    Case("drum-start", "a ball that slips when the drum starts", set_going),
)
