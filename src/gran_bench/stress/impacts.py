"""The DEM with a few bodies: impacts beyond all reason, spheres that start overlapping, a mass ratio of a million."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gran_bench.config import DemConfig
from gran_bench.dem.simulate import simulate
from gran_bench.state import ContactHistory, ParticleState
from gran_bench.stress.expectation import Observation
from gran_bench.stress.experiment import Bench, Experiment
from gran_bench.verification.cluster import mass_of
from gran_bench.verification.laboratory import (
    FLOOR,
    RADIUS,
    Impacts,
    collide,
    laboratory,
    on_sphere,
    on_wall,
    run,
    sphere_material,
    spheres,
)
from gran_bench.verification.oblique import at_angles
from gran_bench.verification.suite import CASES, run_case

ANGLES = (0.0, 20.0, 40.0, 60.0, 80.0, 85.0)  # degrees between approach and normal
DEEP = 0.1  # of a radius; a contact circle is then a third of the sphere's, and no small one any more
PHASES = (0.0, 0.3, 0.6, 0.9)  # of a step, when the bodies first touch


def impacts(
    bench: Bench,
    speeds: list[float],
    youngs_moduli: list[float],
    restitutions: list[float],
    frictions: list[float],
    against: str = "sphere",
    radius: float = RADIUS,
    second_radius: float = RADIUS,
    steps_per_contact: float = 200.0,
) -> Observation:
    """Impacts at six angles and four phases of the step, over all of speeds, stiffnesses, e and μ.

    Args:
        speeds: relative speed, m/s.
        youngs_moduli: E, Pa.
        restitutions: e.
        frictions: μ.
        against: ``sphere`` or ``wall``.
        radius, second_radius: m.
        steps_per_contact: t_c over the step.
    """
    error, gain, momentum, deepest = 0.0, -1.0, 0.0, 0.0
    angle, phase = (a.ravel() for a in np.meshgrid(ANGLES, PHASES))
    for modulus in youngs_moduli:
        for e in restitutions:
            for mu in frictions:
                material = sphere_material(modulus, e, mu)
                contact = on_wall(material, radius) if against == "wall" else on_sphere(material, radius, second_radius)
                for speed in speeds:
                    hits = at_angles(contact, angle, speed)
                    found = collide(hits, phase=phase, steps_per_contact=steps_per_contact, stride=10)
                    # Two spheres that meet obliquely turn while they touch; a wall does not.
                    straight = np.full(len(angle), True) if against == "wall" else angle == 0.0
                    error = _worst(error, np.abs(found.normal / hits.normal - e)[straight])
                    gain = _worst(gain, found.energy - 1.0)
                    deepest = _worst(deepest, np.array([found.overlap / min(radius, second_radius)]))
                    if against != "wall":
                        momentum = _worst(momentum, _momentum_change(hits, found.result.final))
    return Observation(
        {
            "restitution_error": error,
            "energy_gain": gain,
            "momentum_change": momentum,
            "overlap": deepest,
        }
    )


def _worst(before: float, values: np.ndarray) -> float:
    """The largest so far; NaN once anything is."""
    return float(np.maximum(before, np.max(values)))


def _momentum_change(hits: Impacts, final: ParticleState) -> np.ndarray:
    """Of each pair, over the momentum of the first before, ``(P,)``."""
    mass, count = mass_of(final.radius), len(hits.normal)
    after = (mass[:, None] * final.velocity).reshape(2, count, 3).sum(axis=0)
    before = mass[:count, None] * np.stack((hits.tangential, np.zeros(count), -hits.normal), axis=1)
    return np.linalg.norm(after - before, axis=1) / np.linalg.norm(before, axis=1)


def start_overlap(bench: Bench, overlap: float, restitution: float = 0.5, engine: str = "numba") -> Observation:
    """Two spheres that start with an overlap and push each other apart.

    Args:
        overlap: of the sum of the radii.
        restitution: e.
        engine: of the DEM.
    """
    contact = on_sphere(sphere_material(restitution=restitution))
    depth = overlap * 2.0 * RADIUS
    state = spheres([[0, 0, 0], [2.0 * RADIUS - depth, 0, 0]])
    scene = laboratory(contact.first.material)
    result = simulate(scene, state, 0.1, dem=DemConfig(engine=engine, time_step=5e-5, allow_unsafe_step=True))
    stored = 0.4 * contact.stiffness * depth**2.5
    kinetic = 0.5 * float(mass_of(state.radius) @ np.square(result.final.velocity).sum(axis=1))
    return Observation({"energy_released": kinetic / stored if stored else kinetic}, result.warnings)


def fast_sphere(
    bench: Bench,
    speed: float,
    against: str,
    youngs_modulus: float = 1.0e7,
    time_step: float | None = None,
    engine: str = "numba",
) -> Observation:
    """One sphere shot at another or at a wall through the usual front door, with all its checks.

    Args:
        speed: m/s.
        against: ``sphere`` or ``wall``.
        youngs_modulus: E, Pa.
        time_step: s; the solver's choice where null.
        engine: of the DEM.
    """
    material = sphere_material(youngs_modulus, 0.5, 0.3)
    walls = (FLOOR,) if against == "wall" else ()
    position, velocity = [[0.0, 0.0, 0.2]], [[0.0, 0.0, -speed]]
    if against == "sphere":
        position, velocity = [*position, [0.0, 0.0, 0.1]], [*velocity, [0.0, 0.0, 0.0]]
    scene = replace(laboratory(material, walls), frame_interval=2e-5)
    state = spheres(position, velocity)
    result = simulate(scene, state, 1e-3, dem=DemConfig(engine=engine, time_step=time_step, allow_unsafe_step=True))
    mass = mass_of(state.radius)
    energy = [0.5 * float(mass @ np.square(s.velocity).sum(axis=1)) for s in (state, result.final)]
    seen = result.trajectory.diagnostics
    deepest = max(seen["overlap_peak"].max(), seen["wall_overlap_peak"].max()) / RADIUS
    flags = result.warnings
    if deepest > DEEP:
        flags = (*flags, f"recorded overlap of {deepest:.3g} r, beyond what Hertz's law is for")
    return Observation({"energy_gain": energy[1] / energy[0] - 1.0, "overlap": float(deepest)}, flags)


def not_a_number(bench: Bench, field: str, engine: str = "numba") -> Observation:
    """A state with a NaN in it, in the middle of a run.

    Args:
        field: of the state.
        engine: of the DEM.
    """
    scene, state = laboratory(sphere_material()), spheres([[0, 0, 0], [0.06, 0, 0]], [[0.1, 0, 0], [0, 0, 0]])
    middle = run(scene, state, 1e-4, 100, engine=engine).final
    values = np.array(getattr(middle, field))
    values[1] = np.nan
    broken = replace(middle, history=ContactHistory.empty(), **{field: values})
    return Observation({"overlap": float(run(scene, broken, 1e-4, 100, engine=engine).time_step)})


def verified(bench: Bench, case: str) -> Observation:
    """A case of the verification suite, with the tolerances that are written there.

    Args:
        case: its name.
    """
    chosen = [one for one in CASES if one.name == case]
    if not chosen:
        raise ValueError(f"with.case={case} is no case of the verification; choose {', '.join(c.name for c in CASES)}")
    outcome = run_case(chosen[0])
    if outcome.failure is not None:
        raise RuntimeError(outcome.failure)
    return Observation(
        {"error_of_tolerance": max(float((check.error / check.tolerance).max()) for check in outcome.findings.checks)}
    )


IMPACTS = {
    "impacts": Experiment(
        impacts, {"restitution_error": "-", "energy_gain": "of before", "momentum_change": "of before", "overlap": "r"}
    ),
    "start_overlap": Experiment(start_overlap, {"energy_released": "of the stored"}),
    "fast_sphere": Experiment(fast_sphere, {"energy_gain": "of before", "overlap": "r"}),
    "not_a_number": Experiment(not_a_number, {"overlap": "r"}),
    "verified": Experiment(verified, {"error_of_tolerance": "of the tolerance"}),
}
