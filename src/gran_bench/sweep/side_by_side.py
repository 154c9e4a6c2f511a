"""Models of a sweep measured side by side: the time of a frame in turns, and what the DEM errs from the same states."""

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from gran_bench.config import DemConfig
from gran_bench.config.registry import MODELS
from gran_bench.dataset import Case, read_case
from gran_bench.dem.simulate import SimulationResult, simulate
from gran_bench.files import write_text
from gran_bench.metrics.position_error import HORIZONS, short_horizon_errors, spread_starts
from gran_bench.processes import tell
from gran_bench.run.identity import hash_of, judging_plan
from gran_bench.run.summary import finished_summary, ranked_errors
from gran_bench.state import ParticleState
from gran_bench.sweep.runs import SweepFileError, SweepJob
from gran_bench.sweep.table import axes_of

FILE = "side_by_side.json"  # in the folder of a sweep
WARM_UP = 2  # frames before the measured ones: the state itself, and a frame that loads what was compiled


@dataclass(frozen=True)
class SideBySide:
    """What was measured in one process, on one thread."""

    key: str  # hash of the runs whose models were timed
    ms: dict[str, float]  # median wall time of a frame, by key of a run
    dem_ms: float  # of the DEM, in the same turns
    dem_error: dict[str, float | None]  # m, mean position error of `dem_ahead` by horizon (``10_frames``)
    starts: int  # states that the DEM started from, and frames of each model
    frames: int  # of a whole run
    ranked: list[str]  # errors that the DEM itself has in this scene, by which methods are ranked


def read_side_by_side(folder: Path) -> SideBySide | None:
    """What was measured for the sweep of a folder, or None; a `SweepFileError` where the file is damaged."""
    path = folder / FILE
    try:
        return SideBySide(**json.loads(path.read_text("utf-8"))) if path.exists() else None
    except (ValueError, TypeError) as error:
        raise SweepFileError(f"{path} holds no measurements of a sweep ({error}); delete it or restore it") from error


def dem_ahead(case: Case, dem: DemConfig, start: int, frames: int) -> SimulationResult:
    """The DEM, ``frames`` on from a stored frame of its own run: positions, velocities, spins, and no contact springs.

    A surrogate starts from no more than this.
    """
    motion, settled = case.trajectory, case.settled
    then = (array[start] for array in (motion.position, motion.velocity, motion.angular_velocity))
    state = ParticleState(*then, settled.radius, time=float(motion.time[start]), material=settled.material)
    return simulate(case.scene, state, state.time + frames * case.scene.frame_interval, dem=replace(dem, threads=1))


def measure(folder: Path, jobs: Sequence[SweepJob]) -> None:
    """Time one finished model of each choice, and the DEM, in turns on one thread; what is measured stays measured.

    Raises:
        CheckpointError: a model file that cannot be read.
        SimulationError: the DEM cannot go on from its own stored frames.
    """
    import torch

    from gran_bench.surrogate.checkpoint import MODEL, load_model
    from gran_bench.surrogate.rollout import step_frames

    axes, chosen = axes_of(jobs), {}
    for job in jobs:
        known = job.identity is not None and MODELS[job.config.model.name].particles
        if known and (job.identity.folder / MODEL).exists() and (summary := finished_summary(job.identity)) is not None:
            shared = summary["judged"]["shared"]
            ranked = [name for name in ranked_errors(shared) if shared["errors"][name]["floor"] is not None]
            chosen.setdefault(tuple(job.choices.get(axis) for axis in axes), (job, ranked))
    key, kept = hash_of([(job.key, job.judged_by) for job, _ in chosen.values()]), read_side_by_side(folder)
    if not chosen or (kept is not None and kept.key == key):
        return
    tell(f"time of a frame of {len(chosen)} models and of the DEM, in turns")
    (config, ranked), threads = next((job.config, ranked) for job, ranked in chosen.values()), torch.get_num_threads()
    plan = judging_plan(config)
    case = read_case(plan.case(plan.judged_rpm).path(config.dataset.root))
    starts = spread_starts(case.trajectory.frame_count, config.judge.short_horizon_starts)
    torch.set_num_threads(1)
    try:
        models = {job.key: load_model(job.identity.folder / MODEL)[0] for job, _ in chosen.values()}
        walks = {key: step_frames(model, case.scene, case.settled) for key, model in models.items()}
        for walk in walks.values():
            for _ in zip(range(WARM_UP), walk, strict=False):
                pass
        ahead, seconds = {}, {name: [] for name in ("", *walks)}  # "" of the DEM
        for start in starts:
            found = dem_ahead(case, config.dem, start, max(HORIZONS))
            ahead[start] = found.trajectory.position[1:]
            seconds[""].append(found.wall_seconds / max(HORIZONS))
            for name, walk in walks.items():
                began = time.perf_counter()
                next(walk)
                seconds[name].append(time.perf_counter() - began)
    finally:
        torch.set_num_threads(threads)
    errors = short_horizon_errors(lambda start, frames: ahead[start], case.trajectory, starts, period=case.scene.period)
    ms = {name: 1e3 * float(np.median(found)) for name, found in seconds.items()}
    dem_error = {f"{horizon}_frames": error.value for horizon, error in errors.items()}
    measured = SideBySide(key, ms, ms.pop(""), dem_error, len(starts), case.trajectory.frame_count - 1, ranked)
    write_text(folder / FILE, json.dumps(asdict(measured), indent=1) + "\n")
