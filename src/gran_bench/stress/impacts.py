"""The DEM with a few bodies, beyond all reason, and its time step: what it costs, errs, and where it blows up."""

from dataclasses import replace
from itertools import product

import numpy as np

from gran_bench.config import DemConfig
from gran_bench.dataset.case_spec import replica_nudge
from gran_bench.dataset.generation import nudged
from gran_bench.dem.simulate import SimulationError, simulate
from gran_bench.dem.time_step import contact_times, dividing_step
from gran_bench.metrics.angle_of_repose import center_of_mass_angles
from gran_bench.shipped import shipped_scene
from gran_bench.state import ContactHistory, FloatArray, ParticleState
from gran_bench.stress.beds import deepest_overlap, settled_bed, with_nan
from gran_bench.stress.expectation import Bench, Experiment, Observation
from gran_bench.verification import CASES, run_case
from gran_bench.verification import laboratory as lab
from gran_bench.verification.convergence import DRIFT_BOUND, elastic_energy, gas, quick_impact
from gran_bench.verification.impacts import at_angles
from gran_bench.verification.laboratory import SOFT, run

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
    """One sphere shot (m/s) at a ``sphere`` or ``wall`` through the usual front door, with all its checks.

    ``time_step`` (s) is the solver's choice where null.
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


def step_ladder(bench: Bench, steps: list[float], production: float, seconds: float = 2.0) -> Observation:
    """Steps (s) from small to far too large on the paper's drum: error of the centre of mass's angle, and cost.

    The smallest step is the reference; the floor is its error against itself, nudged as replicas are, and what
    ``production`` errs more is beyond it. A step that ends with an error has an infinite one. The drum turns for
    ``seconds``, 30 rpm.
    """
    if production not in steps:
        raise ValueError(f"with.production={production:g} is none of with.steps={steps}; choose one of them")
    scene = shipped_scene("drum").at_speed(30.0)
    bed, end = settled_bed(bench, scene), scene.start_time + seconds

    def angles(step: float, state: ParticleState) -> tuple[FloatArray, float, tuple[str, ...]]:
        # One thread, so that its cost stands beside the cost of the others.
        result = simulate(scene, state, end, dem=DemConfig(time_step=step, threads=1, allow_unsafe_step=True))
        found = np.degrees(center_of_mass_angles(result.trajectory.position, result.trajectory.radius, scene))
        return found, 1e3 * result.wall_seconds / (result.trajectory.frame_count - 1), result.warnings

    reference, double = angles(steps[0], bed)[0], angles(steps[0], nudged(bed, replica_nudge(scene), 1))[0]
    floor, silent = float(np.abs(double - reference).mean()), 0
    errors, costs, flags = [], [], []
    for step in steps:
        try:
            found, cost, warnings = angles(step, bed)
            error = float(np.abs(found - reference).mean())
        except SimulationError as failure:
            error, cost, warnings = np.inf, np.nan, (failure,)
        errors.append(error)
        costs.append(cost)
        flags += [f"{step:g} s: {warning}" for warning in warnings]
        # What is off by more than a degree beyond the floor must have been warned of.
        silent += error > floor + 1.0 and not warnings
    off = errors[steps.index(production)]
    largest = max(error for error in errors if np.isfinite(error))
    curves = {"step": list(steps), "error": errors, "cost": costs, "floor": [floor]}
    curves |= {"contact_time": [contact_times(scene)[0]], "production": [production]}
    quantities = {"error": off, "floor": floor, "beyond_floor": off - floor, "largest_error": largest}
    return Observation(quantities, tuple(flags), curves, silent)


def blow_up(bench: Bench) -> Observation:
    """The smallest step, of the ladder of those that divide a frame, at which ``drum_small`` diverges or lets escape.

    Every step of the ladder is tried at 30 rpm, from small to large, until two in a row end with an error.
    """
    place = shipped_scene("drum_small").at_speed(30.0)
    bed, duration = settled_bed(bench, place), contact_times(place)[0]
    survived, failed, flags = [], [], []
    for count in (50, 35, 25, 20, 16, 14, 12, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1):
        step = place.frame_interval / count
        dem = DemConfig(time_step=step, allow_unsafe_step=True)
        try:
            simulate(place, bed, place.start_time + 0.5, dem=dem)
            survived.append(step)
        except SimulationError as error:
            failed.append(step)
            flags.append(f"{step:.3g} s ({step / duration:.2g} t_c): {error}")
            if len(failed) == 2:
                break
    first = min(failed, default=np.inf)
    safe = max((step for step in survived if step < first), default=0.0)
    return Observation({"first_failure": first / duration, "largest_safe": safe / duration}, tuple(flags[:1]))


def energy_drift(bench: Bench, steps_per_contact: list[float], seconds: float = 10.0) -> Observation:
    """Largest change of the energy of an elastic gas in some seconds, against the step, until it diverges.

    Steps are t_c over ``steps_per_contact``, from many to few, with t_c of an impact at three times the mean of both.
    """
    (scene, state), duration = gas(0, SOFT), quick_impact(SOFT)
    changes, worst, flags = [], 0.0, []
    for per_contact in steps_per_contact:
        step = dividing_step(0.01, duration / per_contact)
        stride = round(0.01 / step)
        try:
            trajectory = run(scene, state, step, round(seconds / 0.01) * stride, stride).trajectory
        except SimulationError as error:
            changes.append(np.inf)
            flags.append(f"t_c/{per_contact:g}: {error}")
            continue
        energy = elastic_energy(scene, trajectory)
        changes.append(float(np.abs(energy / energy[0] - 1.0).max()))
        if per_contact >= 10:  # where a contact is resolved; the solver refuses less than five
            worst = max(worst, changes[-1] / (DRIFT_BOUND * (step / duration) ** 2))
    curves = {"steps_per_contact": list(steps_per_contact), "change": changes, "bound": [DRIFT_BOUND]}
    return Observation({"drift": worst, "smallest_step_drift": changes[0]}, tuple(flags), curves)


IMPACTS = {
    "impacts": Experiment(
        impacts, {"restitution_error": "-", "energy_gain": "of before", "momentum_change": "of before", "overlap": "r"}
    ),
    "start_overlap": Experiment(start_overlap, {"energy_released": "of the stored"}),
    "fast_sphere": Experiment(fast_sphere, {"energy_gain": "of before", "overlap": "r"}),
    "not_a_number": Experiment(not_a_number, {"overlap": "r"}),
    "verified": Experiment(verified, {"error_of_tolerance": "of the tolerance"}),
    "step_ladder": Experiment(
        step_ladder, {"error": "°", "floor": "°", "beyond_floor": "°", "largest_error": "°"}, alone=True
    ),
    "blow_up": Experiment(blow_up, {"first_failure": "t_c", "largest_safe": "t_c"}),
    "energy_drift": Experiment(energy_drift, {"drift": "of 3(Δt/t_c)²", "smallest_step_drift": "of the energy"}),
}
