"""The DEM's time step: what it costs, what it errs, where it blows up, and what it does to the energy."""

from __future__ import annotations

import numpy as np

from gran_bench.config import DemConfig
from gran_bench.dataset.case_spec import replica_nudge
from gran_bench.dataset.generation import nudged
from gran_bench.dem.simulate import SimulationError, dividing_step, simulate
from gran_bench.dem.time_step import contact_times
from gran_bench.metrics.angle_of_repose import center_of_mass_angles
from gran_bench.shipped import shipped_scene
from gran_bench.state import FloatArray, ParticleState
from gran_bench.stress.beds import settled_bed
from gran_bench.stress.expectation import Observation
from gran_bench.stress.experiment import Bench, Experiment
from gran_bench.verification.convergence import DRIFT_BOUND, elastic_energy, gas, quick_impact
from gran_bench.verification.laboratory import SOFT, run


def step_ladder(bench: Bench, steps: list[float], production: float, seconds: float = 2.0) -> Observation:
    """Steps from small to far too large on the paper's drum: error of the centre of mass's angle, and cost.

    The smallest step is the reference. The floor is the same error of the reference against itself, nudged by 1e-9 m;
    what the production step, one of the steps, errs more than that is beyond the floor. A step that ends with an error
    has an infinite error and stays in the curve. Steps in s; the drum turns for ``seconds`` at 30 rpm.
    """
    if production not in steps:
        raise ValueError(f"with.production={production:g} is none of with.steps={steps}; choose one of them")
    scene = shipped_scene("drum").at_speed(30.0)
    bed, end = settled_bed(bench, scene), scene.start_time + seconds

    def angles(step: float, state: ParticleState) -> tuple[FloatArray, float, tuple[str, ...]]:
        # One thread, so that its cost stands beside that of the others.
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
    """Largest change of the energy of an elastic gas, against the step, until it diverges.

    Args:
        steps_per_contact: t_c over the step, from many to few; t_c of an impact at three times the mean of both.
        seconds: simulated.
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


STEPS = {
    "step_ladder": Experiment(
        step_ladder, {"error": "°", "floor": "°", "beyond_floor": "°", "largest_error": "°"}, alone=True
    ),
    "blow_up": Experiment(blow_up, {"first_failure": "t_c", "largest_safe": "t_c"}),
    "energy_drift": Experiment(energy_drift, {"drift": "of 3(Δt/t_c)²", "smallest_step_drift": "of the energy"}),
}
