"""A ball on a plane, a slope or in a drum; slip to roll is DEM04 of the MFiX-DEM manual (Garg et al. 2012)."""

import math
from collections.abc import Iterator

import numpy as np

from gran_bench.scene import Cylinder, Plane, Scene, Wall
from gran_bench.state import FloatArray
from gran_bench.verification import laboratory as lab
from gran_bench.verification.bouncing import MANUAL
from gran_bench.verification.case import Case, Check

DRUM = 0.5  # m, radius
WALL = Cylinder((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), DRUM)


class Ball:
    """A ball that lies on a soft wall, sloped by rad, under its weight; arm and reach depend on the overlap."""

    def __init__(self, modulus: float, e: float, friction: float, resistance: float = 0.0, slope: float = 0.0) -> None:
        self.material = lab.sphere_material(modulus, e, friction, resistance)
        self.contact = lab.on_wall(self.material)
        self.load = self.contact.first.mass * lab.GRAVITY * math.cos(slope)
        self.overlap = self.contact.resting_overlap(self.load)
        self.arm = lab.RADIUS - self.overlap
        self.reach = DRUM - lab.RADIUS + self.overlap  # from the axis of a drum
        stiffness = 1.5 * self.contact.stiffness * math.sqrt(self.overlap)
        self.period = 2.0 * math.pi * math.sqrt(self.contact.first.mass / stiffness)  # bobbing, its fastest motion

    def on(self, wall: Wall, rpm: float | None = None) -> Scene:
        return lab.laboratory(self.material, (wall,), gravity=lab.DOWN, rpm=rpm)


def slip_to_roll() -> Iterator[Check]:
    """A ball that slides starts to roll: u = u₀ − μ g t until t = 2u₀/7μg, then u = 5/7 u₀ (for a rigid one)."""
    # Fast, so that it slides for long beside the time in which the contact takes up its load.
    speed, frictions = 5.0, (0.1, 0.3, 0.6, 1.0)
    source = f"u = u₀ − μgt, then rolling, with the arm a = R − δ; {MANUAL} DEM04"
    quantities = (
        ("deceleration while it slides, m/s²", 1e-3), ("when it rolls, s", 1e-2),
        ("speed when it rolls, m/s", 1e-3), ("spin when it rolls, rad/s", 1e-3),
    )  # fmt: skip
    for modulus in (lab.SOFT, lab.STIFF):
        expected, found = [], []
        for friction in frictions:
            ball = Ball(modulus, 0.5, friction)
            lever = 2.5 * (ball.arm / lab.RADIUS) ** 2
            stop = speed / (friction * lab.GRAVITY * (1.0 + lever))
            step, state = min(ball.period / 60, stop / 2000), lab.spheres([0, 0, ball.arm], [speed, 0, 0])
            trajectory = lab.watch(ball.on(lab.FLOOR), state, step, 1.6 * stop, stop / 1000)
            t, u, w = trajectory.time, trajectory.velocity[:, 0, 0], trajectory.angular_velocity[:, 0, 1]
            early, late, settled = np.searchsorted(t, 0.1 * stop), np.searchsorted(t, 0.9 * stop), t > 1.3 * stop
            slip = u - ball.arm * w
            first = int(np.flatnonzero(slip <= 0.0)[0]) if (slip <= 0.0).any() else len(slip) - 1
            share = slip[first - 1] / (slip[first - 1] - slip[first])
            rolls = t[first - 1] + share * (t[first] - t[first - 1])
            after = speed * lever / (1.0 + lever)
            expected.append((-friction * lab.GRAVITY, stop, after, after / ball.arm))
            found.append(((u[late] - u[early]) / (t[late] - t[early]), rolls, u[settled].mean(), w[settled].mean()))
        at = [f"μ {friction:g}" for friction in frictions]
        for (name, tolerance), wanted, got in zip(quantities, np.transpose(expected), np.transpose(found), strict=True):
            yield Check(f"{name}, E {modulus:g} Pa", wanted, got, tolerance, source, at=at)


def rolling_stop() -> Iterator[Check]:
    """A ball that rolls on a plane: μ_r r m g stops it in a known time, and then it stays at rest."""
    speed, resistances = 0.2, (0.02, 0.1, 0.5)
    for modulus in (lab.SOFT, lab.STIFF):
        expected, found, left = [], [], []
        for resistance in resistances:
            ball = Ball(modulus, 0.5, 0.6, resistance)
            rate = resistance * lab.GRAVITY * ball.arm * lab.RADIUS / (ball.arm**2 + 0.4 * lab.RADIUS**2)
            step, state = ball.period / 60, lab.spheres([0, 0, ball.arm], [speed, 0, 0], [0, speed / ball.arm, 0])
            stride = math.ceil(speed / rate / 100 / step)
            trajectory = lab.run(ball.on(lab.FLOOR), state, step, 200 * stride, stride).trajectory
            expected.append(-rate)
            found.append(np.polyfit(trajectory.time[20:90], trajectory.velocity[20:90, 0, 0], 1)[0])
            left.append(np.linalg.norm(trajectory.velocity[-20:, 0], axis=1).max())
        label, at = f"E {modulus:g} Pa", [f"μ_r {resistance:g}" for resistance in resistances]
        source = "5/7 μ_r g, with the arm a = R − δ: μ_r g R a/(a² + ⅖R²)"
        yield Check(f"deceleration by rolling friction, m/s², {label}", expected, found, 1e-3, source, at=at)
        yield Check(
            f"speed left after twice the time to stop, m/s, {label}", [0.0] * len(left), left, 1e-3,
            "it stays at rest (Ai et al. 2011, model C with a critical dashpot)", speed, "of the first speed", at,
        )  # fmt: skip


def _down_the_slope(modulus: float, slope_deg: float, friction: float, resistance: float = 0.0) -> FloatArray:
    """Acceleration along the slope, spin rate, and distance gone in 0.4 s, of a ball put on it at rest, SI."""
    angle = math.radians(slope_deg)
    along, normal = np.array([math.cos(angle), 0.0, -math.sin(angle)]), (math.sin(angle), 0.0, math.cos(angle))
    ball = Ball(modulus, 0.3, friction, resistance, angle)
    step = ball.period / 60
    stride = math.ceil(0.4 / 80 / step)
    scene = ball.on(Plane((0.0, 0.0, 0.0), normal, turns=False))
    trajectory = lab.run(scene, lab.spheres(ball.arm * np.array(normal)), step, 80 * stride, stride).trajectory
    # The slope of a straight line through the later half, in which the first jolt has died away.
    late = slice(len(trajectory.time) // 2, None)
    speed, spin = trajectory.velocity[:, 0] @ along, trajectory.angular_velocity[:, 0, 1]
    rates = (np.polyfit(trajectory.time[late], values[late], 1)[0] for values in (speed, spin))
    return np.array([*rates, (trajectory.position[-1, 0] - trajectory.position[0, 0]) @ along])


def incline() -> Iterator[Check]:
    """A ball on a slope: rolls with 5/7 g sin θ, slides with g (sin θ − μ cos θ), or is held by rolling friction."""
    friction, resistance = 0.1, 0.17
    for modulus in (lab.SOFT, lab.STIFF):
        label = f"E {modulus:g} Pa"

        def arm_of(slope: float, modulus: float = modulus) -> float:
            return 1.0 - Ball(modulus, 1.0, 0.0, slope=slope).overlap / lab.RADIUS

        slopes = np.radians([2.0, 10.0, 25.0])
        rolling = [lab.GRAVITY * math.sin(s) / (1.0 + 0.4 / arm_of(s) ** 2) for s in slopes]
        found = [_down_the_slope(modulus, s, 0.8)[0] for s in np.degrees(slopes)]
        at = [f"{s:g}°" for s in np.degrees(slopes)]
        source = "5/7 g sin θ, with the arm R − δ: g sin θ/(1 + ⅖R²/a²)"
        yield Check(f"acceleration of a rolling ball, m/s², {label}", rolling, found, 1e-3, source, at=at)
        slopes = np.radians([30.0, 45.0])
        found, turned, _ = np.transpose([_down_the_slope(modulus, s, friction) for s in np.degrees(slopes)])
        sliding = [lab.GRAVITY * (math.sin(s) - friction * math.cos(s)) for s in slopes]
        turning = [2.5 * friction * lab.GRAVITY * math.cos(s) * arm_of(s) / lab.RADIUS for s in slopes]
        at = [f"{s:g}°" for s in np.degrees(slopes)]
        source = "g (sin θ − μ cos θ)"
        yield Check(f"acceleration of a sliding ball, m/s², {label}", sliding, found, 1e-3, source, at=at)
        source = "5/2 μ g cos θ a/R²"
        yield Check(f"spin rate of a sliding ball, rad/s², {label}", turning, turned, 1e-3, source, at=at)
        held, slope = _down_the_slope(modulus, 5.0, 0.8, resistance)[2], math.radians(15.0)
        free = 0.5 * 5.0 / 7.0 * lab.GRAVITY * math.sin(math.radians(5.0)) * 0.4**2
        name = f"way of a ball that rolling friction holds (5°, μ_r 0.17), m, {label}"
        yield Check(name, 0.0, held, 1e-2, "held where tan θ < μ_r (Ai et al. 2011)", free, "of the free way")
        rolls = _down_the_slope(modulus, 15.0, 0.8, resistance)[0]
        resisted = lab.GRAVITY * (math.sin(slope) - resistance * math.cos(slope) / arm_of(slope))
        resisted /= 1.0 + 0.4 / arm_of(slope) ** 2
        name = f"acceleration against rolling friction (15°, μ_r 0.17), m/s², {label}"
        yield Check(name, resisted, rolls, 1e-3, "5/7 g (sin θ − μ_r cos θ), with the arm R − δ")


def swing() -> Iterator[Check]:
    """Period of a ball that rolls to and fro at the bottom of a resting drum, and of one that slides (μ = 0)."""
    amplitude = 0.05  # rad
    source = "ω² = 5g/7(R − r) rolling, g/(R − r) sliding; arm and reach with the overlap, amplitude 0.05 rad"
    for modulus in (lab.SOFT, lab.STIFF):
        expected, found = [], []
        for friction in (0.8, 0.0):
            ball = Ball(modulus, 0.3, friction)
            turning = 0.4 * (lab.RADIUS / ball.arm) ** 2 if friction else 0.0
            period = 2.0 * math.pi * math.sqrt(ball.reach * (1.0 + turning) / lab.GRAVITY) * (1.0 + amplitude**2 / 16.0)
            start = lab.spheres(ball.reach * np.array([math.sin(amplitude), 0.0, -math.cos(amplitude)]))
            trajectory = lab.watch(ball.on(WALL), start, ball.period / 40, 4.2 * period, 5e-3)
            t, angle = trajectory.time, np.arctan2(trajectory.position[:, 0, 0], -trajectory.position[:, 0, 2])
            k = np.flatnonzero((angle[:-1] < 0.0) & (angle[1:] >= 0.0))
            passed = t[k] - angle[k] * (t[k + 1] - t[k]) / (angle[k + 1] - angle[k])  # zero on its way up
            expected.append(period)
            found.append((passed[-1] - passed[0]) / (len(passed) - 1))
        at = ("rolling, μ 0.8", "sliding, μ 0")
        yield Check(f"period of a small swing, s, E {modulus:g} Pa", expected, found, 1e-3, source, at=at)


def steady_place() -> Iterator[Check]:
    """A ball in a drum at 30 rpm: its spin at the bottom, and where rolling friction takes it."""
    rpm, resistances = 30.0, (0.0, 0.05, 0.1)
    for modulus in (lab.SOFT, lab.STIFF):
        wanted, found = [], []
        for resistance in resistances:
            ball = Ball(modulus, 0.3, 0.8, resistance)
            step = ball.period / 40
            # Torque balance: friction m g sin θ on the arm carries the rolling moment μ_r R m g cos θ.
            ball = Ball(modulus, 0.3, 0.8, resistance, math.atan(resistance * lab.RADIUS / ball.arm))
            place = math.atan(resistance * lab.RADIUS / ball.arm)
            spin = rpm * 2.0 * math.pi / 60.0 * DRUM / ball.arm
            # The bed of a drum that turns with +y climbs towards −x.
            start = ball.reach * np.array([-math.sin(place), 0.0, -math.cos(place)])
            period = 2.0 * math.pi * math.sqrt(1.4 * ball.reach / (lab.GRAVITY * math.cos(place)))
            state = lab.spheres(start, None, [0.0, spin, 0.0])
            trajectory = lab.watch(ball.on(WALL, rpm), state, step, 3.0 * period, 5e-3)
            late = trajectory.time > period
            angle = np.arctan2(-trajectory.position[late, 0, 0], -trajectory.position[late, 0, 2])
            wanted.append((spin, place))
            found.append((trajectory.angular_velocity[late, 0, 1].mean(), angle.mean()))
        (spins, places), (turned, went) = np.transpose(wanted), np.transpose(found)
        at, source = [f"μ_r {resistance:g}" for resistance in resistances], "ω = Ω R/(r − δ), no slip"
        yield Check(f"spin at 30 rpm, rad/s, E {modulus:g} Pa", spins, turned, 1e-3, source, at=at)
        source = "tan θ = μ_r r/(r − δ), balance of moments"
        yield Check(f"angle of its place at 30 rpm, rad, E {modulus:g} Pa", places, went, 1e-3, source, 1.0, "rad", at)


def set_going() -> Iterator[Check]:
    """A ball at rest in a drum that starts at once: while it slips, the wall drags it with μ g and spins it up."""
    friction, rpm = 0.1, 60.0
    for modulus in (lab.SOFT, lab.STIFF):
        ball = Ball(modulus, 0.3, friction)
        step = ball.period / 60
        steps = math.ceil(0.05 / step)
        final = lab.run(ball.on(WALL, rpm), lab.spheres([0.0, 0.0, -ball.reach]), step, steps).final
        time, pull = steps * step, friction * lab.GRAVITY
        # Along the wall: s̈ = μ (g cos φ + ṡ²/reach) − g sin φ, φ = s/reach; to this order in t.
        speed = pull * time * (1.0 - lab.GRAVITY * time**2 / (6.0 * ball.reach))
        at, label = (f"{rpm:g} rpm",), f"E {modulus:g} Pa"
        source = "Coulomb: ẍ = −μ g while it slips, and the wall's slope"
        yield Check(f"speed towards −x after 0.05 s, m/s, {label}", -speed, final.velocity[0, 0], 0.01, source, at=at)
        spin, source = 2.5 * pull * time * ball.arm / lab.RADIUS**2, "Coulomb: ω̇ = 5/2 μ g a/r² while it slips"
        yield Check(f"spin after 0.05 s, rad/s, {label}", spin, final.angular_velocity[0, 1], 0.01, source, at=at)


CASES = (
    Case("slip-to-roll", "a sliding ball starts to roll (MFiX DEM04)", slip_to_roll),
    Case("rolling-stop", "rolling friction stops a ball, which then stays at rest", rolling_stop),
    Case("incline", "a ball rolls, slides or is held on a slope", incline),
    Case("drum-swing", "a ball swings in a resting drum", swing),
    Case("drum-spin", "a ball in a turning drum: its spin and its place", steady_place),
    Case("drum-start", "a ball that slips when the drum starts", set_going),
)
