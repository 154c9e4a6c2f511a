"""Judging the emulator among statistics: against the replicas' own leave-one-out mean, never as one more sample.

The mean of runs lies closer to each run than another run does. So an expectation is held against what the other
replicas' mean would have scored, and an ensemble by its energy score and by its spread.
"""

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from gran_bench.dataset import CaseSpec, read_settled
from gran_bench.dem.simulate import choose_time_step, simulate
from gran_bench.emulator.network import Emulator, Statistics
from gran_bench.emulator.rivals import Rival
from gran_bench.emulator.runs import COMPARED, FIGURES, RunStatistics, columns_of, measure, read_run
from gran_bench.emulator.schedules import Judged
from gran_bench.metrics.floor import REPLICAS
from gran_bench.metrics.judgement import ErrorRow, Judgement, Requirement
from gran_bench.metrics.measured import LEAST_VALID_SHARE, Measured
from gran_bench.metrics.position_error import HORIZONS
from gran_bench.metrics.statistics import energy_score, spread_ratio
from gran_bench.state import FloatArray

WORST = {False: 1.25, True: 1.5}  # times the leave-one-out mean that pass, from the shared and the unseen packing
SPREAD = (0.8, 1.25)  # of the ensemble over that of the replicas
FASTER = 100.0  # than the fastest DEM of the DEM's own accuracy
STEPS = (1.0, 2.0, 10.0 / 3.0)  # of the DEM as a rival in speed, in automatic steps
DEM_WORST = 1.25  # floors of a figure that such a DEM may be away from the replicas
NO_PARTICLES = "statistics without particles"
TIMED = 5  # runs of the emulator whose median time counts


@dataclass(frozen=True)
class JudgedRun:
    """A judged schedule: the replicas' figures, what the emulator says, and how far everybody is away."""

    judged: Judged
    replicas: FloatArray  # (R, F, C)
    said: Statistics
    row: dict[str, dict[str, Any]]  # by figure: error, floor, leave_one_out, energy, energy_of_runs, spread, rivals


def judge_schedules(
    emulator: Emulator, plan: Sequence[Judged], rivals: Mapping[str, Rival], root: str, tell: Callable[[str], None]
) -> list[JudgedRun]:
    """Hold the emulator against the replicas of every judged schedule; the files of their statistics are there."""
    runs = []
    for judged in plan:
        series = [read_run(spec, root) for spec in judged.replicas]
        runs.append(judge_schedule(emulator, judged, series, rivals))
        row = runs[-1].row
        tell(f"{judged.label}: " + ", ".join(f"{name} × {_shown(row[name]['ratio'])}" for name in COMPARED))
    return runs


def judge_schedule(
    emulator: Emulator, judged: Judged, series: Sequence[RunStatistics], rivals: Mapping[str, Rival]
) -> JudgedRun:
    """Hold the emulator, and rivals by name, against the replicas of one schedule."""
    truth, first = np.stack([one.columns for one in series]), series[0].columns[0]
    scene, places = judged.replicas[0].scene, columns_of(series[0].figures)
    said = emulator.statistics(scene, first[[places["surface_angle"].start, places["com_angle"].start]])
    others = {name: rival(scene, first) for name, rival in rivals.items()}
    row = {}
    for name, place in places.items():
        runs, mean, members = truth[..., place], said.mean[:, place], said.members[..., place]
        rests = [np.delete(runs, k, axis=0) for k in range(len(runs))]
        found = {
            "error": np.mean([distance(mean, run) for run in runs]),
            "floor": np.mean([distance(a, b) for i, a in enumerate(runs) for b in runs[:i]]),
            "leave_one_out": np.mean([distance(_mean(r), run) for r, run in zip(rests, runs, strict=True)]),
            "energy": energy_score(members, runs),
            "energy_of_runs": np.mean([energy_score(r, run[None]) for r, run in zip(rests, runs, strict=True)]),
            "spread": spread_ratio(members, runs),
        }
        found["ratio"] = found["error"] / found["leave_one_out"] if found["leave_one_out"] else math.nan
        found = {key: float(value) if math.isfinite(value) else None for key, value in found.items()}
        far = {rival: np.mean([distance(x[:, place], run) for run in runs]) for rival, x in others.items()}
        found["rivals"] = {rival: _ratio(value, found["leave_one_out"]) for rival, value in far.items()}
        row[name] = {"unit": FIGURES[name][1], **found}
    return JudgedRun(judged, truth, said, row)


def distance(a: FloatArray, b: FloatArray) -> float:
    """Mean |a − b| over the frames valid in both, and over columns; NaN below 90 % of the frames, ``(F, Q)`` each."""
    valid = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    return float(np.abs(a - b)[valid].mean()) if valid.mean() >= LEAST_VALID_SHARE else math.nan


def _mean(runs: FloatArray) -> FloatArray:
    """Of runs, where all have a figure."""
    return runs.mean(axis=0)


def _ratio(value: float, unit: float | None) -> float | None:
    return float(value / unit) if unit and math.isfinite(value) else None


def _shown(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.2f}"


def averages(runs: Iterable[JudgedRun], unseen: bool) -> dict[str, dict[str, Any]]:
    """Means over the schedules of a packing, by figure; None where one of them is undefined, because none drops out.

    ``ratio`` is the mean error over the mean of the replicas' own, also of rivals. A mean of the schedules' ratios,
    ``mean_ratio``, would be ruled by those whose replicas have hardly come apart yet.
    """
    rows = [run.row for run in runs if run.judged.unseen == unseen]
    table: dict[str, dict[str, Any]] = {}
    for name in rows[0] if rows else ():
        keys = ("spread", "error", "floor", "leave_one_out", "energy", "energy_of_runs")
        found = {key: _average(row[name][key] for row in rows) for key in keys}
        own = found["leave_one_out"]
        found["ratio"] = _ratio(_number(found["error"]), own)
        found["mean_ratio"] = _average(row[name]["ratio"] for row in rows)
        found["rivals"] = {
            rival: _ratio(_number(_average(_product(row[name], rival) for row in rows)), own)
            for rival in rows[0][name]["rivals"]
        }
        table[name] = found
    return table


def _product(row: Mapping[str, Any], rival: str) -> float | None:
    """A rival's error on a schedule."""
    ratio = row["rivals"][rival]
    return None if ratio is None else ratio * row["leave_one_out"]


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _average(values: Iterable[float | None]) -> float | None:
    found = list(values)
    return None if None in found else float(np.mean(found))


def judgement(runs: Sequence[JudgedRun], unseen: bool, faster: float | None = None) -> Judgement:
    """Distances at the held-out speed, the first schedule, and the requirements on all schedules from a packing."""
    held = next(run for run in runs if run.judged.unseen == unseen)
    table, label = averages(runs, unseen), {name: FIGURES[name][0] for name in FIGURES}
    errors = [
        ErrorRow(
            "speed_w1" if name == "speed" else name, f"{label[name]}, over the series", row["unit"],
            _measured(row["error"], row["unit"]), _measured(row["floor"], row["unit"]),
        )
        for name, row in held.row.items()
    ]  # fmt: skip
    requirements = []
    for name in COMPARED:
        words = f"{label[name]}, mean error at most {WORST[unseen]:g} × that of the other replicas' mean"
        requirements.append(_at_most(f"{name}_mean", words, table[name]["ratio"], WORST[unseen]))
    for name in COMPARED:
        found, (low, high) = table[name]["spread"], SPREAD
        good = found is not None and low <= found <= high
        words = f"{label[name]}, spread of the ensemble {low:g} to {high:g} × the replicas'"
        requirements.append(
            Requirement(f"{name}_spread", words, _measured(found, "-"), high, "pass" if good else "fail")
        )
    if not unseen:
        good = faster is not None and faster >= FASTER
        words = f"at least {FASTER:g} × faster than the fastest DEM within {DEM_WORST:g} floors"
        requirements.append(Requirement("faster", words, _measured(faster, "×"), FASTER, "pass" if good else "fail"))
    return Judgement(errors, [], requirements, None, None, "instantaneous", len(held.replicas), None, REPLICAS)


def _measured(value: float | None, unit: str) -> Measured:
    reason = "fewer than 90 % of the states have a figure, or nothing to compare with"
    return Measured.undefined(unit, reason) if value is None else Measured(value, unit)


def _at_most(key: str, label: str, value: float | None, bound: float) -> Requirement:
    good = value is not None and value <= bound
    return Requirement(key, label, _measured(value, "-"), bound, "pass" if good else "fail")


def emulator_seconds(emulator: Emulator, run: JudgedRun) -> float:
    """Median wall time of a second of simulated time, ensemble included, on one thread, s."""
    scene, settled = run.judged.replicas[0].scene, run.replicas[0, 0, :2]
    threads, took = torch.get_num_threads(), []
    torch.set_num_threads(1)
    try:
        for _ in range(TIMED + 1):  # the first warms up
            began = time.perf_counter()
            emulator.statistics(scene, settled)
            took.append(time.perf_counter() - began)
    finally:
        torch.set_num_threads(threads)
    return float(np.median(took[1:])) / (scene.end_time - scene.start_time)


def dem_rivals(run: JudgedRun, root: str) -> list[dict[str, Any]]:
    """The DEM at larger steps on the held-out schedule, timed here on one thread: error in floors, s a second.

    Each starts from the bed of the replicas and is judged as a sample of the flow.
    """
    spec: CaseSpec = replace(run.judged.replicas[0], nudge=0.0, nudge_seed=0)
    scene, bed = spec.scene, read_settled(spec.settled_path(root))[0]
    automatic, _ = choose_time_step(scene, spec.dem.time_step, spec.dem.allow_unsafe_step)
    places, rows = columns_of(run.row), []
    for multiple in STEPS:
        step = scene.frame_interval / max(1, round(scene.frame_interval / (multiple * automatic)))
        dem = replace(spec.dem, time_step=step, allow_unsafe_step=True, threads=1)
        result = simulate(scene, bed, scene.end_time, dem=dem)
        found = measure(result.trajectory, scene)
        errors = {
            name: _ratio(
                float(np.mean([distance(found[name], other[:, places[name]]) for other in run.replicas])),
                run.row[name]["floor"],
            )
            for name in COMPARED
        }
        seconds = result.wall_seconds / (scene.end_time - scene.start_time)
        rows.append({"time_step": step, "seconds_a_second": seconds, "floors": errors})
    return rows


def fastest(rows: Iterable[Mapping[str, Any]]) -> float | None:
    """Seconds a simulated second of the fastest DEM that is as right as the DEM itself; None where there is none."""
    good = [
        row["seconds_a_second"]
        for row in rows
        if all(value is not None and value <= DEM_WORST for value in row["floors"].values())
    ]
    return min(good, default=None)


def summary_of(
    runs: Sequence[JudgedRun], own: float, dem: Sequence[Mapping[str, Any]], emulator: Emulator, judged_as: str
) -> dict[str, Any]:
    """Everything as plain values for ``summary.json``, in the shape that every judged model has.

    Args:
        runs: judged schedules, the constant speed first.
        own: wall time of the emulator for a second of simulated time, s.
        dem: as `dem_rivals` gives it.
        emulator, judged_as: who is judged, and whether on the held-out or the validation speed.
    """
    held, best = runs[0], fastest(dem)
    packings = {"unseen" if unseen else "shared": unseen for unseen in sorted({run.judged.unseen for run in runs})}
    speed = abs(held.judged.replicas[0].scene.rotation.speeds_rpm[0])
    frame_ms = 1e3 * emulator.scene.frame_interval
    automatic = dem[0]["seconds_a_second"] * frame_ms
    rollout = {"failed_frame": None, "ms_per_frame_median": own * frame_ms, "ms_per_frame_90th": None}
    rollout["warnings"] = emulator.extrapolations(held.judged.replicas[0].scene)
    return {
        "judged_rpm": speed,
        "judged_as": judged_as,
        "judged": {
            name: judgement(runs, unseen, best / own if best is not None else None).to_dict()
            for name, unseen in packings.items()
        },
        "baselines": {},
        "nearest_case": {},
        "position_error": {f"{k}_frames": {"m": None, "diameters": None, "note": NO_PARTICLES} for k in HORIZONS},
        "rollouts": {f"{speed:g}rpm": rollout | {"dem_ms_per_frame": automatic}},
        "statistics": {
            "averages": {name: averages(runs, unseen) for name, unseen in packings.items()},
            "schedules": {run.judged.label: run.row for run in runs},
            "seconds_a_second": own,
            "dem": list(dem),
            "times_faster": best / own if best is not None else None,
        },
    }
