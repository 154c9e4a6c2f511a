"""Judge one model on one scene: rollouts in which nothing but the model moves a sphere, replicas, a summary."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gran_bench.baselines import ballistic, interpolated_statistics, rigid_rotation
from gran_bench.config import JudgeConfig
from gran_bench.dataset import Case, CaseSpec, dataset_digest, ensure_cases, read_case
from gran_bench.dem.energy_balance import EnergyBalance
from gran_bench.evaluation.plan import Plan, rollout_name
from gran_bench.files import whole_file
from gran_bench.metrics.judge import judge, nearest_case
from gran_bench.metrics.judgement import Judgement
from gran_bench.metrics.position_error import HORIZONS, short_horizon_errors, spread_starts
from gran_bench.metrics.requirements import ANGLES, SPEEDS, WITHOUT_ANGLE
from gran_bench.metrics.summary import TrajectorySummary, summarise
from gran_bench.state import FloatArray, Trajectory
from gran_bench.surrogate.rollout import Rollout, extrapolations, rollout
from gran_bench.surrogate.step import Surrogate

# The distances that stand in the short table, for the model and for the baselines.
COMPARED = (*ANGLES, SPEEDS)


@dataclass(frozen=True)
class Evaluation:
    """What judging a model gave; packings are ``shared`` and ``unseen``, names ``30rpm`` or ``30rpm_unseen``."""

    judgements: dict[str, Judgement]  # of the judged speed, by packing
    rollouts: dict[str, Rollout]  # by name
    cases: dict[str, Case]  # the DEM's runs of the same names
    candidates: dict[str, TrajectorySummary]  # the model's rollout of the judged speed, by packing
    replicas: dict[str, list[TrajectorySummary]]  # the DEM's nudged runs of the judged speed, by packing
    summary: dict[str, Any]  # everything as plain values for ``summary.json``


def evaluate(
    model: Surrogate, plan: Plan, folder: Path, tell: Callable[[str], None], progress: bool = True
) -> Evaluation:
    """Roll a model out, judge it, and sum it up; a rollout that failed is in the evaluation as a failed one.

    The folder keeps the finished rollouts, so that a killed evaluation goes on; ``tell`` gets a line for each stage.
    """
    tell("DEM runs to judge against: cases, replicas, another packing, half the time step")
    ensure_cases(plan.cases, plan.dataset.root, plan.dataset.workers, progress)
    jobs = {rollout_name(rpm): plan.case(rpm) for rpm in plan.speeds_rpm}
    jobs |= {rollout_name(plan.judged_rpm, unseen): plan.case(plan.judged_rpm, unseen) for unseen in plan.packings}
    cases = {name: read_case(spec.path(plan.dataset.root)) for name, spec in jobs.items()}
    judged, rollouts = cases[rollout_name(plan.judged_rpm)], {}
    asked = plan.judge.requirements
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # so that a surrogate's time stands beside one core of the DEM
    try:
        for name, case in cases.items():
            tell(f"rollout of {case.trajectory.frame_count} frames, {name}")
            rollouts[name] = _kept_rollout(model, case, folder / "rollouts" / f"{name}.npz", progress)
            for warning in rollouts[name].warnings:
                tell(f"  unlike the training: {warning}")
    finally:
        torch.set_num_threads(threads)
    judgements, candidates, doubles, apart = {}, {}, {}, {}
    replays = {f"{rpm:g} rpm replayed": _summary(plan.case(rpm), plan, model.velocity_kind)
               for rpm in plan.replayed_rpm}  # fmt: skip
    for unseen in plan.packings:
        packing, name = "unseen" if unseen else "shared", rollout_name(plan.judged_rpm, unseen)
        tell(f"judging {name} against {len(plan.replicas(unseen))} replicas")
        judged_scene = plan.judged_case(unseen).scene
        candidate = candidates[packing] = summarise(rollouts[name].trajectory, judged_scene)
        doubles[packing] = [_summary(spec, plan, candidate.velocity_kind) for spec in plan.replicas(unseen)]
        beside = {}
        if not plan.imported or len(plan.packings) > 1:
            beside["other_packing"] = plan.judged_case(not unseen)
        if not unseen and not plan.imported:
            beside["half_step"] = plan.finer
        beside = {name: _summary(spec, plan, candidate.velocity_kind) for name, spec in beside.items()}
        apart[packing] = [doubles[packing][0], beside["other_packing"]] if "other_packing" in beside else []
        found = judge(candidate, doubles[packing], judged_scene, beside, replays, asked, apart[packing])
        judgements[packing] = found
        candidates[packing] = replace(candidate, phases=found.phases)
        doubles[packing] = [replace(run, phases=found.phases) for run in doubles[packing]]
    steady = next(iter(judgements.values())).phases.steady_from
    summary = {
        "judged_rpm": plan.judged_rpm,
        "judged_as": "validation" if plan.validates else "held out",
        "judged": {packing: judgement.to_dict() for packing, judgement in judgements.items()},
        "baselines": _baselines(plan, judged, doubles["shared"], replays, apart["shared"]),
        "nearest_case": _nearest(plan, rollouts, cases),
        "position_error": _short_horizon(model, judged, plan.judge),
        "rollouts": {name: _rollout_facts(result, cases[name], steady) for name, result in rollouts.items()},
        "data_digest": dataset_digest(list(cases.values())),
    }
    return Evaluation(judgements, rollouts, cases, candidates, doubles, summary)


def _summary(spec: CaseSpec, plan: Plan, velocity_kind: str) -> TrajectorySummary:
    return summarise(read_case(spec.path(plan.dataset.root)).trajectory, spec.scene.fine, velocity_kind)


def _kept_rollout(model: Surrogate, case: Case, path: Path, progress: bool) -> Rollout:
    """The rollout of a case, computed once and kept whole in a file; another case or other weights compute it anew."""
    made_of, arrays = f"{case.digest} {weights_digest(model)}", ("position", "velocity", "angular_velocity")
    kept = _read(path)
    if kept.get("made_of") != made_of:
        result = rollout(model, case.scene, case.settled, case.trajectory.frame_count, progress)
        failed = -1 if result.failed_frame is None else result.failed_frame
        facts = {"seconds_per_frame": result.seconds_per_frame, "failed_frame": failed, "made_of": made_of}
        facts |= {name: found for name in arrays if (found := getattr(result.trajectory, name)) is not None}
        with whole_file(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, **facts)
        kept = _read(path)
    time = case.settled.time + case.scene.frame_interval * np.arange(len(kept["position"]))
    motion, radius = map(kept.get, arrays), np.asarray(case.settled.radius)
    trajectory = Trajectory(time, *motion, radius, velocity_kind=model.velocity_kind)
    failed, warnings = int(kept["failed_frame"]), extrapolations(model, case.scene, case.settled)
    return Rollout(trajectory, None if failed < 0 else failed, kept["seconds_per_frame"], warnings)


def _read(path: Path) -> dict[str, Any]:
    if not path.exists():
        return {}
    with np.load(path) as kept:
        return {**kept}


def weights_digest(model: Surrogate) -> str:
    """16 hex digits over a model's weights."""
    digest = hashlib.sha256()
    for name, value in model.state_dict().items():
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def _baselines(
    plan: Plan, case: Case, doubles: list[TrajectorySummary], replays: dict[str, TrajectorySummary],
    packings: list[TrajectorySummary],
) -> dict[str, Any]:  # fmt: skip
    """What costs next to nothing, held against the same replicas: distances by baseline and name."""
    scene, kind = case.scene.fine, doubles[0].velocity_kind
    candidates = {
        "bed at rest" if scene.rotation.is_still else "rigid rotation": summarise(
            rigid_rotation(scene, case.settled), scene, kind
        ),
        "ballistic": summarise(ballistic(scene, case.settled), scene, kind),
    }
    coarse = f"DEM, {case.scene.spheres}"
    if case.scene.fine_spheres is not None:
        candidates[coarse] = summarise(case.trajectory, scene, kind)
    if plan.neighbours_rpm is not None:
        low, high = plan.neighbours_rpm
        name = f"statistics interpolated between {low:g} and {high:g} rpm"
        candidates[name] = interpolated_statistics(
            plan.judged_rpm, dict(zip(plan.replayed_rpm, replays.values(), strict=True))
        )
    candidates |= replays
    step = "" if plan.imported else f"DEM, steps of {1e3 * plan.coarser.dem.time_step:g} ms"
    if step:
        candidates[step] = _summary(plan.coarser, plan, kind)
    table, rows = {}, COMPARED if scene.has_angle_of_repose else (*COMPARED, *WITHOUT_ANGLE)
    for name, candidate in candidates.items():
        found = judge(candidate, doubles, scene, asked=plan.judge.requirements, packings=packings)
        errors = found.to_dict()["errors"]
        table[name] = {row: errors[row] for row in rows}
    if coarse in table:
        table[coarse]["ms_per_frame"] = _dem_ms_per_frame(case)
    if step:
        table[step]["ms_per_frame"] = _dem_ms_per_frame(read_case(plan.coarser.path(plan.dataset.root)))
    return table


def _nearest(plan: Plan, rollouts: dict[str, Rollout], cases: dict[str, Case]) -> dict[str, Any]:
    """For each judged speed: the DEM case with the nearest speeds, and the distances to all, m/s."""
    if plan.judged_rpm is None:
        return {}
    truth = {rpm: cases[rollout_name(rpm)].trajectory for rpm in plan.speeds_rpm}
    table = {}
    for rpm in plan.speeds_rpm:
        nearest, distances = nearest_case(rollouts[rollout_name(rpm)].trajectory, truth, plan.scene.period)
        table[rollout_name(rpm)] = {
            "own_rpm": rpm,
            "nearest_rpm": nearest,
            "is_own": nearest == rpm,
            "w1_m_s": {rollout_name(other): distance.value for other, distance in distances.items()},
        }
    return table


def _short_horizon(model: Surrogate, case: Case, config: JudgeConfig) -> dict[str, Any]:
    """Mean position error 1, 3 and 10 frames from many start frames of the DEM's own case, m and d."""
    starts = spread_starts(case.trajectory.frame_count, config.short_horizon_starts)
    found = short_horizon_errors(partial(predict_from, model, case), case.trajectory, starts, period=case.scene.period)
    table = {}
    for horizon in HORIZONS:
        value = found[horizon].value
        diameters = None if value is None else value / case.scene.filling.diameter
        table[f"{horizon}_frames"] = {"m": value, "diameters": diameters, "note": found[horizon].note}
    return table


def predict_from(model: Surrogate, case: Case, start: int, frames: int) -> FloatArray:
    """Positions ``(frames, N, 3)`` m that a model predicts after frame ``start`` of a case."""
    like, motion, scene = next(model.parameters()), case.trajectory, case.scene

    def tensor(array: FloatArray) -> torch.Tensor:
        return torch.as_tensor(array, dtype=like.dtype, device=like.device)

    previous = tensor(motion.position[start - 1]) if start else None
    # What a model remembers follows from the DEM's frames before the start, never from frames after it.
    past = slice(0, start + 1)
    memories = model.memories(scene, motion.time[past], motion.position[past], motion.angular_velocity[past])
    memory = None if memories is None else memories[-1]
    first = (tensor(array[start]) for array in (motion.position, motion.velocity, motion.angular_velocity))
    with torch.no_grad():
        state = model.begin(scene, *first, previous, memory)
        found = []
        for k in range(frames):
            state = model(state, scene, float(motion.time[start]) + k * scene.frame_interval)
            found.append(state.position.cpu().numpy())
    return np.stack(found)


def _rollout_facts(result: Rollout, case: Case, steady_from: float | None) -> dict[str, Any]:
    """How fast a rollout was, beside the DEM's own time for the same frames, and where it failed; and where the DEM's
    energy goes once the flow is steady (else in the whole run), W, if it was counted.
    """
    start = case.scene.start_time if steady_from is None else steady_from
    computed = 1e3 * result.seconds_per_frame[np.isfinite(result.seconds_per_frame)]
    return {
        "failed_frame": result.failed_frame,
        "warnings": list(result.warnings),
        "ms_per_frame_median": float(np.median(computed)) if len(computed) else None,
        "ms_per_frame_90th": float(np.percentile(computed, 90)) if len(computed) else None,
        "dem_ms_per_frame": _dem_ms_per_frame(case),
        "dem_energy": EnergyBalance.of(case.trajectory).figures(start) if case.trajectory.energy else {},
    }


def _dem_ms_per_frame(case: Case) -> float | None:
    """Wall time of the DEM for a frame, ms: one core, while another case was made on the other; None where unknown."""
    time = 1e3 * float(case.attributes["wall_seconds"]) / (case.trajectory.frame_count - 1)
    return time if np.isfinite(time) else None
