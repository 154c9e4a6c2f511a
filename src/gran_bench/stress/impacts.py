"""The DEM with a few bodies: impacts beyond all reason, spheres that start overlapping, a mass ratio of a million."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from gran_bench.config import DemConfig
from gran_bench.dem.simulate import simulate
from gran_bench.state import ContactHistory, FloatArray, ParticleState
from gran_bench.stress.expectation import Bench, Experiment, Observation
from gran_bench.verification import CASES, run_case
from gran_bench.verification import laboratory as lab
from gran_bench.verification.impacts import at_angles

ANGLES = (0.0, 20.0, 40.0, 60.0, 80.0, 85.0)  # degrees between approach and normal
DEEP = 0.1  # of a radius; a contact circle is then a third of the sphere's, and no small one any more
PHASES = (0.0, 0.3, 0.6, 0.9)  # of a step, when the bodies first touch


def impacts(
    bench: Bench, speeds: list[float], youngs_moduli: list[float], restitutions: list[float], frictions: list[float],
    against: str = "sphere", radius: float = lab.RADIUS, second_radius: float = lab.RADIUS,
) -> Observation:  # fmt: skip
    """Impacts at six angles and four phases of the step, over all of speeds (m/s), stiffnesses (Pa), e and μ.

    ``against`` is ``sphere`` or ``wall``; both radii are in m.
    """
    worst = {"restitution_error": 0.0, "energy_gain": -1.0, "momentum_change": 0.0, "overlap": 0.0}
    angle, phase = (a.ravel() for a in np.meshgrid(ANGLES, PHASES))
    on_a_wall = against == "wall"
    # Two spheres that meet obliquely turn while they touch; a wall does not.
    straight = np.full(len(angle), True) if on_a_wall else angle == 0.0
    for modulus, e, mu, speed in product(youngs_moduli, restitutions, frictions, speeds):
        material = lab.sphere_material(modulus, e, mu)
        hits = at_angles(
            lab.on_wall(material, radius) if on_a_wall else lab.on_sphere(material, radius, second_radius), angle, speed
        )
        found = lab.collide(hits, phase=phase, stride=10)
        now = {
            "restitution_error": np.abs(found.normal / hits.normal - e)[straight],
            "energy_gain": found.energy - 1.0,
            "overlap": found.overlap / min(radius, second_radius),
        } | ({} if on_a_wall else {"momentum_change": _momentum_change(hits, found.result.final)})
        # The largest so far; NaN once anything is.
        worst |= {name: float(np.maximum(worst[name], np.max(values))) for name, values in now.items()}
    return Observation(worst)


def _momentum_change(hits: lab.Impacts, final: ParticleState) -> FloatArray:
    """Of each pair, over the momentum of the first before, ``(P,)``."""
    mass, count = lab.mass_of(final.radius), len(hits.normal)
    after = (mass[:, None] * final.velocity).reshape(2, count, 3).sum(axis=0)
    before = mass[:count, None] * np.stack((hits.tangential, np.zeros(count), -hits.normal), axis=1)
    return np.linalg.norm(after - before, axis=1) / np.linalg.norm(before, axis=1)


def start_overlap(bench: Bench, overlap: float, restitution: float = 0.5) -> Observation:
    """Two spheres that start with an overlap, of the sum of their radii, and push each other apart."""
    contact, depth = lab.on_sphere(lab.sphere_material(restitution=restitution)), overlap * 2.0 * lab.RADIUS
    state = lab.spheres([[0, 0, 0], [2.0 * lab.RADIUS - depth, 0, 0]])
    dem = DemConfig(time_step=5e-5, allow_unsafe_step=True)
    result = simulate(lab.laboratory(contact.first.material), state, 0.1, dem=dem)
    stored, kinetic = 0.4 * contact.stiffness * depth**2.5, _moving(result.final)
    return Observation({"energy_released": kinetic / stored if stored else kinetic}, result.warnings)


def _moving(state: ParticleState) -> float:
    """Translational energy, J."""
    return 0.5 * float(lab.mass_of(state.radius) @ np.square(state.velocity).sum(axis=1))


def fast_sphere(bench: Bench, speed: float, against: str, time_step: float | None = None) -> Observation:
    """One sphere shot (m/s) at another or at a wall through the usual front door, with all its checks.

    ``against`` is ``sphere`` or ``wall``; ``time_step`` (s) is the solver's choice where null.
    """
    count = 1 if against == "wall" else 2
    scene = lab.laboratory(lab.sphere_material(lab.SOFT, 0.5, 0.3), (lab.FLOOR,) if count == 1 else ())
    state = lab.spheres([[0.0, 0.0, 0.2], [0.0, 0.0, 0.1]][:count], [[0.0, 0.0, -speed], [0.0, 0.0, 0.0]][:count])
    dem = DemConfig(time_step=time_step, allow_unsafe_step=True)
    result = simulate(replace(scene, frame_interval=2e-5), state, 1e-3, dem=dem)
    deepest, flags = deepest_overlap(result.trajectory.diagnostics) / lab.RADIUS, result.warnings
    if deepest > DEEP:
        flags = (*flags, f"recorded overlap of {deepest:.3g} r, beyond what Hertz's law is for")
    return Observation({"energy_gain": _moving(result.final) / _moving(state) - 1.0, "overlap": deepest}, flags)


def deepest_overlap(diagnostics: dict[str, FloatArray]) -> float:
    """The largest overlap of a run, of pairs and walls, m."""
    return float(max(diagnostics[name].max() for name in ("overlap_peak", "wall_overlap_peak")))


def with_nan(state: ParticleState, field: str, particle: int) -> ParticleState:
    """The state with a NaN for one particle in one of its arrays."""
    values = np.array(getattr(state, field))
    values[particle] = np.nan
    return replace(state, **{field: values})


def not_a_number(bench: Bench, field: str) -> Observation:
    """A state with a NaN in one of its fields, in the middle of a run."""
    scene, state = (
        lab.laboratory(lab.sphere_material()),
        lab.spheres([[0, 0, 0], [0.06, 0, 0]], [[0.1, 0, 0], [0, 0, 0]]),
    )
    middle = lab.run(scene, state, 1e-4, 100).final
    broken = with_nan(replace(middle, history=ContactHistory.empty()), field, 1)
    return Observation({"overlap": float(lab.run(scene, broken, 1e-4, 100).time_step)})


def verified(bench: Bench, case: str) -> Observation:
    """A case of the verification suite, by its name, with the tolerances that are written there."""
    chosen = {one.name: one for one in CASES}
    if case not in chosen:
        raise ValueError(f"with.case={case} is no case of the verification; choose {', '.join(chosen)}")
    outcome = run_case(chosen[case])
    if outcome.failure is not None:
        raise RuntimeError(outcome.failure)
    worst = max(float((check.error / check.tolerance).max()) for check in outcome.checks)
    return Observation({"error_of_tolerance": worst})


IMPACTS = {
    "impacts": Experiment(
        impacts, {"restitution_error": "-", "energy_gain": "of before", "momentum_change": "of before", "overlap": "r"}
    ),
    "start_overlap": Experiment(start_overlap, {"energy_released": "of the stored"}),
    "fast_sphere": Experiment(fast_sphere, {"energy_gain": "of before", "overlap": "r"}),
    "not_a_number": Experiment(not_a_number, {"overlap": "r"}),
    "verified": Experiment(verified, {"error_of_tolerance": "of the tolerance"}),
}
