"""Where energy goes, in experiments that say how much it is: an impact, a ball that slips and rolls, a drum."""

import math
from collections.abc import Iterator

import numpy as np

from gran_bench.dem.energy import KINDS, LOSSES, SPECTRA, spectrum_edges
from gran_bench.dem.energy_balance import KINETIC, EnergyBalance
from gran_bench.dem.simulate import SimulationResult
from gran_bench.scene import Cylinder, Plane
from gran_bench.verification import laboratory as lab
from gran_bench.verification.case import Case, Check
from gran_bench.verification.rolling import Ball

SPEED = 1.0  # m/s


def _lost(result: SimulationResult) -> dict[str, float]:
    """Joules that a run lost, by name."""
    interval = np.diff(result.trajectory.time)
    names = [f"{kind}loss_{name}" for kind in KINDS for name in LOSSES]
    return {name: float(result.trajectory.energy[name][1:] @ interval) for name in names}


def _kinetic(result: SimulationResult) -> float:
    return float(sum(result.trajectory.diagnostics[name][-1] for name in KINETIC))


def impact() -> Iterator[Check]:
    """A ball hits a wall, or a ball at rest: normal damping takes ½ m* v² (1 − e²), and one impact is counted."""
    restitutions = (0.1, 0.5, 0.9, 1.0)
    for kind, words in zip(KINDS, ("ball on a ball", "ball on a wall"), strict=True):
        expected, found, counted, other = [], [], [], []
        for e in restitutions:
            material = lab.sphere_material(lab.SOFT, e, 0.3)
            contact = lab.on_wall(material) if kind else lab.on_sphere(material)
            step = contact.duration(SPEED) / lab.STEPS_PER_CONTACT
            steps = math.ceil((1.6 + 4.0 * (1.0 - e)) * contact.duration(SPEED) / step)
            heights = [1.0 + 1e-9] if kind else [1.0 + 1e-9, -1.0]
            place = np.outer(heights, [0.0, 0.0, lab.RADIUS])
            velocity = np.outer([1.0, 0.0][: len(heights)], [0.0, 0.0, -SPEED])
            scene = lab.laboratory(material, (lab.FLOOR,) if kind else ())
            result = lab.run(scene, lab.spheres(place, velocity), step, steps, steps, power=True)
            lost = _lost(result)
            mass = lab.mass_of(lab.RADIUS) * (1.0 if kind else 0.5)
            energy = 0.5 * mass * SPEED**2
            expected.append(energy * (1.0 - e**2))
            found.append(lost.pop(f"{kind}loss_damping"))
            other.append(sum(map(abs, lost.values())))
            rates = result.trajectory.energy[f"{kind}spectrum_{SPECTRA[0]}"][-1] * np.diff(result.trajectory.time)
            place = int(np.searchsorted(spectrum_edges(), energy)) - 1
            counted.append(rates[place] if abs(rates.sum() - 1.0) < 1e-6 else np.nan)
        at, scale = [f"e {e:g}" for e in restitutions], energy
        yield Check(f"lost by damping, J, {words}", expected, found, 3e-3, "½ m* v² (1 − e²)", scale, "of ½ m* v²", at)
        yield Check(f"lost otherwise, J, {words}", np.zeros(len(at)), other, 1e-9, "a head-on impact does not slip",
                    scale, "of ½ m* v²", at)  # fmt: skip
        yield Check(f"impacts in the bin of ½ m* v², {words}", np.ones(len(at)), counted, 1e-6, "one first touch",
                    at=at)  # fmt: skip


def friction_heat() -> Iterator[Check]:
    """A ball that slides until it rolls: friction takes ½ m u₀²/(1 + m a²/I), a seventh of m u₀² for a rigid ball."""
    speed = 2.0
    for modulus in (lab.SOFT, lab.STIFF):
        expected, found, whole, lost_in_all, frictions = [], [], [], [], (0.1, 0.3, 0.6)
        for friction in frictions:
            ball = Ball(modulus, 0.5, friction)
            lever = 2.5 * (ball.arm / lab.RADIUS) ** 2
            stop = speed / (friction * lab.GRAVITY * (1.0 + lever))
            step = min(ball.period / 60, stop / 2000)
            steps = math.ceil(1.6 * stop / step)
            result = lab.run(ball.on(lab.FLOOR), lab.spheres([0, 0, ball.arm], [speed, 0, 0]), step, steps, power=True)
            lost, mass = _lost(result), float(lab.mass_of(lab.RADIUS))
            expected.append(0.5 * mass * speed**2 / (1.0 + lever))
            found.append(lost["wall_loss_sliding"])
            whole.append(0.5 * mass * speed**2 - _kinetic(result))
            lost_in_all.append(sum(lost.values()))
        at, source = [f"μ {friction:g}" for friction in frictions], "½ m u₀²/(1 + m a²/I), with the arm a = R − δ"
        yield Check(f"heat of sliding friction, J, E {modulus:g} Pa", expected, found, 5e-3, source, at=at)
        yield Check(f"all losses, J, E {modulus:g} Pa", whole, lost_in_all, 2e-3, "kinetic energy before and after",
                    at=at)  # fmt: skip


def rolling_heat() -> Iterator[Check]:
    """A ball that rolling friction stops: the rolling spring and its dashpot take all of its kinetic energy."""
    speed, expected, found, resistances = 0.2, [], [], (0.05, 0.2)
    for resistance in resistances:
        ball = Ball(lab.SOFT, 0.5, 0.6, resistance)
        rate = resistance * lab.GRAVITY * ball.arm * lab.RADIUS / (ball.arm**2 + 0.4 * lab.RADIUS**2)
        step = ball.period / 60
        state = lab.spheres([0, 0, ball.arm], [speed, 0, 0], [0, speed / ball.arm, 0])
        result = lab.run(ball.on(lab.FLOOR), state, step, math.ceil(2.0 * speed / rate / step), power=True)
        mass = float(lab.mass_of(lab.RADIUS))
        expected.append(0.5 * mass * speed**2 * (1.0 + 0.4 * (lab.RADIUS / ball.arm) ** 2))
        found.append(sum(_lost(result).values()))
    yield Check("lost by a ball that comes to rest, J", expected, found, 1e-2, "its kinetic energy",
                at=[f"μ_r {resistance:g}" for resistance in resistances])  # fmt: skip


def drum() -> Iterator[Check]:
    """A few balls in a drum at constant speed: over whole turns the walls give what the contacts lose."""
    rpm, wall = 30.0, Cylinder((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.25)
    caps = Plane((0.0, -0.1, 0.0), (0.0, 1.0, 0.0)), Plane((0.0, 0.1, 0.0), (0.0, -1.0, 0.0))
    lines = [0.051 * (np.arange(n) - 0.5 * (n - 1)) for n in (5, 3, 3)]
    place = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    expected, found, resistances = [], [], (0.0, 0.1)
    for resistance in resistances:
        scene = lab.laboratory(lab.sphere_material(lab.SOFT, 0.5, 0.5, resistance), (wall, *caps), gravity=lab.DOWN,
                               rpm=rpm)  # fmt: skip
        result = lab.run(scene, lab.spheres(place), 1e-4, 60_000, 100, power=True)
        balance = EnergyBalance.of(result.trajectory).figures(2.0)  # two turns, after one
        expected.append(balance["power_W"])
        found.append(balance["loss_W"] + balance["storing_W"])
    yield Check("power of the walls and losses over two turns, W", expected, found, 1e-2, "balance of energy",
                at=[f"μ_r {resistance:g}" for resistance in resistances])  # fmt: skip


CASES = (
    Case("energy_impact", "what an impact loses, and its place in the spectrum", impact),
    Case("energy_sliding", "what a ball that slips loses until it rolls", friction_heat),
    Case("energy_rolling", "what a ball loses to rolling friction", rolling_heat),
    Case("energy_drum", "the balance of energy in a drum", drum, quick=False),
)
