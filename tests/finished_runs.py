"""Summaries of runs and records of sweeps, as they lie on the disk, that the tests of pages and tables share."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from beds import drum, flowing

from gran_bench.config import RequirementsConfig
from gran_bench.metrics import judge
from gran_bench.state import Trajectory
from gran_bench.sweep.runs import FAILED, SweepFile, SweepJob, SweepRun, read_runs, write_runs

SCENE = drum(end_time=1.8)
ANGLE, ANGLE_FLOORS = "headline/angle error deg", "headline/angle error floors"
LENIENT = RequirementsConfig(floors=100.0)  # two random flows are no noise floor
REPLICAS = [flowing(SCENE, seed=1), flowing(SCENE, seed=2)]


def summary_of(*runs: Trajectory, failed_frames: tuple[int | None, ...] = (None, None), own: bool = True) -> dict:
    """A summary as the main job writes it, of a rollout from each packing."""
    judgements = dict(
        zip(("shared", "unseen"), (judge(run, REPLICAS, SCENE, asked=LENIENT) for run in runs), strict=False)
    )
    facts = {"ms_per_frame_median": 2.0, "ms_per_frame_90th": 3.0, "dem_ms_per_frame": 10.0}
    summary = {
        "experiment": "test",
        "judged_rpm": 30.0,
        "judged_as": "held out",
        "model": {"name": "contact"},
        "training": {"parameters": 10, "steps": 5, "seconds": 60.0, "stopped_by": "steps"},
        "judged": {packing: judgement.to_dict() for packing, judgement in judgements.items()},
        "baselines": {"ballistic": judgements["shared"].to_dict()["errors"]},
        "nearest_case": {"30rpm": {"own_rpm": 30.0, "nearest_rpm": 30.0 if own else 35.0, "is_own": own}},
        "position_error": {"10_frames": {"m": 0.004, "diameters": 0.08, "note": ""}},
        "rollouts": {
            name: {"failed_frame": frame, **facts}
            for name, frame in zip(("30rpm", "30rpm_unseen"), failed_frames, strict=True)
        },
        "frame_ms": 10.0,
        "wall_seconds": {"training": 60.0},
    }
    return json.loads(json.dumps(summary, allow_nan=False))


def broken(frame: int) -> Trajectory:
    run = flowing(SCENE, seed=3)
    for array in (run.position, run.velocity, run.angular_velocity):
        array[frame:] = np.nan
    return run


def run(radius: str, seed: int, angle: float, w1: float = 0.1, name: str = "", **changes) -> SweepRun:
    """A finished run by hand, whose figures are easy to average."""
    figures = {
        ANGLE: angle,
        ANGLE_FLOORS: 2 * angle,
        "headline/speed W1 m per s": w1,
        "headline/speed W1 floors": 10 * w1,
        "headline/position error 10 frames mm": 5.0,
        "headline/rollout ms per frame": 1e3 * float(radius),
        "headline/training minutes": 2.0,
        "headline/requirements failed": 1.0,
    }
    choices = {"model.radius": radius, "seed": str(seed)}
    facts = {"judged": "validation, 35 rpm", "made_with": "this"}
    values = {"figures": figures, "facts": facts, "ended_at": "2025-01-01T00:00:00+00:00"}
    key = f"{radius}{seed}".replace(".", "").ljust(12, "0")
    name = name or f"r+model.radius-{radius}+seed-{seed}"
    return SweepRun(name, choices, seed, key, "j", **values | changes)


def lost(radius: str, seed: int, reason: str = "the loss is not finite at update 7") -> SweepRun:
    choices = {"model.radius": radius, "seed": str(seed)}
    name, key = f"r+model.radius-{radius}+seed-{seed}", f"{radius}{seed}"
    facts = {"log": f"logs/{name}-{key}.log", "made_with": "this"}
    return SweepRun(name, choices, seed, key, "j", FAILED, "2025-01-01T00:00:00+00:00", reason, facts=facts)


def job_of(one: SweepRun) -> SweepJob:
    return SweepJob(one.run, one.choices, one.seed, one.key, one.judged_by, one.facts.get("made_with", ""))


def sweep_in(folder: Path, *runs: SweepRun, jobs: int = 0) -> None:
    write_runs(folder, [*read_runs(folder), *runs])
    listed = [job_of(one) for one in runs]
    waiting = ({"model.radius": "0.2", "seed": str(i)} for i in range(jobs))
    listed += [SweepJob(f"waits {i}", choices, i, f"w{i}", "j", "this") for i, choices in enumerate(waiting)]
    SweepFile(folder.name, "k", "python -m gran_bench.train -m ...", "gran-bench", listed).write(folder)
