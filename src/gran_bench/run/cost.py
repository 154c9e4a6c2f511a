"""What a command will do and take, told before the work: flow, step, cases, updates, time, memory and disk.

All times come from a pace that is measured here and now (`pace.py`), so they are "about".
"""

from __future__ import annotations

import heapq
import math
import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from gran_bench.config import DemConfig, GenerateConfig, TrainConfig
from gran_bench.dataset import CaseSpec, has_splits, own_case, split_cases
from gran_bench.dataset.mixture import Mixture
from gran_bench.dem.simulate import choose_time_step
from gran_bench.dem.time_step import step_bound
from gran_bench.evaluation.plan import Plan
from gran_bench.metrics.outside import counted
from gran_bench.run.pace import dem_pace, emulator_pace, rollout_pace, summary_pace, update_pace
from gran_bench.scene import Scene, build_scene

STARTING = 2.5  # s until the process of a case simulates: libraries, compiled kernels
FIGURES = {False: 3.0, True: 20.0}  # s, without and with a moving picture
SETTLING = 1.6  # times its least that a bed takes to come to rest
FRAME_BYTES = 36  # of a sphere in a stored frame: position, velocity and spin in single precision
BED_BYTES = 600  # of a sphere in the state that a case starts from, contact history included
# That a process of the DEM, or one with PyTorch, has before it does anything.
PROCESS_BYTES = {"dem": 3.0e8, "torch": 1.0e9}
# Beyond these a value was as a rule given in another unit.
LARGE_SPHERE, DENSITIES, SOFT_SOLID = 0.5, (100.0, 25_000.0), 1.0e4  # m, kg/m³, Pa
# What a softer sphere costs and changes was measured in the paper's drum at 30 rpm alone (results/verification).
SOFT, STIFF, STIFF_MINUS_SOFT = 1.0e7, 1.0e8, "1.1 ± 0.3"  # Pa, Pa, degrees of the centre-of-mass angle (95 %)


@dataclass
class Cost:
    """What a command will do, in lines, and what it will take."""

    lines: list[str]
    seconds: dict[str, float] = field(default_factory=dict)  # expected, by stage
    memory: float = 0.0  # of all processes together at the largest moment, bytes
    disk: float = 0.0  # bytes
    cheaper: list[str] = field(default_factory=list)  # what would cost less, and what it would change

    def __add__(self, other: Cost) -> Cost:
        seconds = {
            name: self.seconds.get(name, 0.0) + other.seconds.get(name, 0.0) for name in self.seconds | other.seconds
        }
        lines, cheaper = [*self.lines, *other.lines], [*self.cheaper, *other.cheaper]
        return Cost(lines, seconds, max(self.memory, other.memory), self.disk + other.disk, cheaper)

    def __str__(self) -> str:
        stages = ", ".join(f"{name} {duration(seconds)}" for name, seconds in self.seconds.items() if seconds >= 0.5)
        total = f"takes about {duration(sum(self.seconds.values()))}" + f" ({stages})" * (len(self.seconds) > 1)
        memory, disk = self.memory / 1e9, self.disk / 1e9
        return "\n".join([*self.lines, f"{total}, {memory:.2g} GB of memory, {disk:.2g} GB of disk", *self.cheaper])

    def tell(self, dry_run: bool) -> bool:
        """Say it, on stdout where that is all that is wanted; whether it is."""
        print(self, file=sys.stdout if dry_run else sys.stderr, flush=True)
        return dry_run


def duration(seconds: float) -> str:
    """``40 s``, ``12 min`` or ``3.4 h``."""
    for unit, length in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 1.5 * length:
            return f"{float(f'{seconds / length:.2g}'):g} {unit}"
    return f"{seconds:.0f} s"


def makespan(durations: Iterable[float], lanes: int) -> float:
    """When the last of some jobs ends that are started in order, ``lanes`` at a time."""
    ends = [0.0] * lanes
    for each in durations:
        heapq.heapreplace(ends, ends[0] + each)
    return max(ends)


def flow_cost(scene: Scene, dem: DemConfig) -> Cost:
    """What flows: spheres, filling, step and why that one; it takes nothing yet."""
    step = choose_time_step(scene, dem.time_step, dem.allow_unsafe_step)[0]
    share, (largest, why) = filled_share(scene), step_bound(scene)
    filled = f", {100 * share:.0f} % of the room by volume, without the gaps" * (share > 0)
    why = f"the automatic step, {why}" if dem.time_step is None else f"dem.time_step; {largest:.3g} s, {why}, is safe"
    of_a_frame = f"{round(scene.frame_interval / step)} for a frame of {scene.frame_interval:g} s"
    if scene.gravity_strength > 0.0 and scene.filling.count:
        of_a_frame += f" = {scene.frame_interval / scene.fall_time:.2g} √(d/g)"
    lines = [f"scene {scene.name}: {scene.spheres}{filled}; {scene.needs}"]
    lines += [f"step: {step:.3g} s, {of_a_frame}: {why}"]
    lines += unusual(scene)
    return Cost(lines, cheaper=softer(scene) if dem.time_step is None else [])


def unusual(scene: Scene) -> list[str]:
    """A line for each value that looks as if it was given in another unit."""
    filling, lines = scene.fine.filling, []
    if filling.count and filling.diameter > LARGE_SPHERE:
        lines.append(f"warning: scene.filling.diameter={filling.diameter:g} m is unusual; lengths are in m")
    for place, material in zip(("material", "second_material"), scene.materials, strict=False):
        if not DENSITIES[0] <= material.density <= DENSITIES[1]:
            given = f"scene.{place}.density={material.density:g} kg/m³"
            lines.append(f"warning: {given} is unusual; densities are in kg/m³")
        if material.youngs_modulus < SOFT_SOLID:
            given = f"scene.{place}.youngs_modulus={material.youngs_modulus:g} Pa"
            lines.append(f"warning: {given} is unusual; moduli are in Pa")
    return lines


def filled_share(scene: Scene) -> float:
    """Volume of the spheres over that of the drum, or of the room that they start in; 0 where there is none."""
    if scene.drum_radius is not None and scene.length is not None:
        volume = math.pi * scene.drum_radius**2 * scene.length
    elif (room := scene.room) is not None:
        width, depth, height = np.subtract(room.upper, room.lower)
        volume = height * (width * depth if room.radius is None else math.pi * room.radius**2)
    else:
        return 0.0
    filling, rng = scene.filling, np.random.default_rng(0)
    radius = np.array(filling.radii or filling.radius * filling.sizes.sample(filling.count, rng))
    return float(4.0 / 3.0 * math.pi * np.sum(radius**3) / volume)


def softer(scene: Scene) -> list[str]:
    """How much less softer spheres would cost, and what is known of what they change."""
    material = scene.material
    if material.youngs_modulus <= 1.01 * SOFT or scene.more_materials:
        return []
    soft = replace(scene, material=replace(material, youngs_modulus=SOFT))
    ratio = step_bound(soft)[0] / step_bound(scene)[0]
    said = (
        f"E = {material.youngs_modulus:.2g} Pa costs {ratio:.0f} times as much as {SOFT:.0e} "
        f"(scene.material.youngs_modulus); in the paper's drum at 30 rpm the bed at E = {STIFF:.0e} Pa is "
        f"{STIFF_MINUS_SOFT} ° steeper than at {SOFT:.0e}, and as fast within chance (results/verification); nothing "
        "stiffer was measured"
    )
    return [said.replace("e+0", "e").replace("e+", "e")]


def data_cost(
    scene: Scene, dem: DemConfig, specs: Iterable[CaseSpec], root: Path | str, workers: int,
    settled: Iterable[CaseSpec] = (),
) -> Cost:  # fmt: skip
    """What the missing cases among ``specs``, and the settled beds of further ones, will take."""
    cases = {spec.path(root): spec for spec in specs}
    missing = {path: spec for path, spec in cases.items() if not path.exists()}
    beds = {spec.settled_path(root): spec for spec in (*missing.values(), *settled)}
    beds = {path: spec for path, spec in beds.items() if not path.exists()}
    cost = Cost([f"data: {counted(len(cases), 'case')}, {len(cases) - len(missing)} of them in {Path(root).resolve()}"])
    if not (missing or beds):
        return cost
    pace, frames = dem_pace(scene, replace(dem, time_step=None)), scene.frame_count
    cores = os.cpu_count() or 1
    lanes = max(1, min(workers, cores))
    settling = [STARTING + pace * _steps(spec, settles=True) for spec in beds.values()]
    moving = [STARTING + pace * _steps(spec, settles=False) for spec in missing.values()]
    cost.lines[0] += f"; {len(missing)} to make, and {counted(len(beds), 'settled bed')}, {lanes} at a time"
    cost.seconds["data"] = makespan(settling, lanes) + makespan(moving, lanes)
    spheres = sum(
        spec.scene.filling.count * (FRAME_BYTES * spec.scene.frame_count + BED_BYTES) for spec in missing.values()
    )
    cost.disk = spheres + BED_BYTES * sum(spec.scene.filling.count for spec in beds.values())
    # A process keeps its frames in double precision, and copies them once when it writes them.
    cost.memory = min(lanes, len(missing)) * (PROCESS_BYTES["dem"] + 3.0 * FRAME_BYTES * frames * scene.filling.count)
    if workers < min(cores, max(len(missing), len(beds))):
        more = makespan(settling, cores) + makespan(moving, cores)
        said = f"dataset.workers={cores} would make the same data in about {duration(more)}"
        cost.cheaper.append(f"{said} instead of {duration(cost.seconds['data'])}")
    return cost


def _steps(spec: CaseSpec, settles: bool) -> float:
    """Steps of all spheres of a case, or of the bed that it starts from, which may take longer."""
    dem, scene = spec.bed_dem if settles else spec.dem, spec.scene
    settling = SETTLING * scene.start_time * scene.filling.settles
    simulated = settling if settles else scene.end_time - scene.start_time
    return simulated / choose_time_step(scene, dem.time_step, dem.allow_unsafe_step)[0] * scene.filling.count


def generate_cost(config: GenerateConfig) -> Cost:
    """What `python -m gran_bench.generate` will take."""
    scene, data = build_scene(config.scene), config.dataset
    split = has_splits(scene, data)
    specs = split_cases(scene, config.dem, data).all if split else [own_case(scene, config.dem, data)]
    return flow_cost(scene, config.dem) + data_cost(scene, config.dem, specs, data.root, data.workers)


def training_cost(config: TrainConfig, plan: Plan, training: Sequence[CaseSpec], done: int | None = 0) -> Cost:
    """What training and judging will take; ``done`` updates are there, and all that are wanted where it is None."""
    from gran_bench.trainer.start import make_model

    budget, scene, name = config.trainer, build_scene(config.scene), config.model.name
    model, minutes = make_model(config, scene), math.inf if config.trainer.minutes is None else config.trainer.minutes
    cost = judging_cost(plan, rollout_pace(model, scene))
    cases = FRAME_BYTES * sum(spec.scene.frame_count * spec.scene.filling.count for spec in training)
    cost.memory += 2.0 * cases
    if done is None:
        return Cost([f"training: {name}, finished before"]) + cost
    threads = min(config.threads, config.optim.accumulate)
    seconds, words = 60.0 * minutes / threads, f"{minutes:g} minutes of the processor's time"
    if budget.budget == "steps":
        from gran_bench.trainer import work_of_updates

        mixture = Mixture(training, budget.mixture.shares, budget.mixture.until) if budget.mixture.scenes else None
        needed = update_pace(config, model, scene) * sum(work_of_updates(config.rollout, budget.steps, mixture, done))
        seconds = min(60.0 * minutes, needed)
        words = counted(budget.steps - done, "update") + f" after {done}" * (done > 0)
        words += f", cut at {minutes:g} minutes (trainer.minutes)" * (seconds < needed)
    ahead = max(config.rollout.frames, config.rollout.final_frames or 0)
    windows, frames = counted(config.optim.accumulate, "window"), counted(ahead, "frame")
    words += f", each of {windows} of up to {frames} ahead, {counted(config.threads, 'thread')}"
    scenes = dict.fromkeys(spec.scene.name for spec in training)
    words += f"; windows of {', '.join(scenes)}" * (len(scenes) > 1)
    return Cost([f"training: {name}, {words}"], {"training": seconds}) + cost


def emulator_cost(
    config: TrainConfig, training: Sequence[CaseSpec], replicas: Sequence[CaseSpec], trainings: int = 1
) -> Cost:
    """What an emulator's runs of the DEM, its trainings and their judgement will take."""
    from gran_bench.emulator.runs import QUANTILES, run_path

    scene, data, dem = build_scene(config.scene), config.dataset, config.dem
    budget, cost = config.trainer, flow_cost(scene, dem)
    pace, summing, lanes = dem_pace(scene, replace(dem, time_step=None)), summary_pace(scene), max(1, data.workers)
    for stage, specs in (("data", training), ("judging", replicas)):
        missing = [spec for spec in specs if not run_path(spec, data.root).exists()]
        beds = {spec.settled_path(data.root): spec for spec in missing}
        settling = [spec for path, spec in beds.items() if not path.exists()]
        steps = sum(_steps(spec, settles=False) for spec in missing) + sum(_steps(one, True) for one in settling)
        work = pace * steps + summing * scene.frame_count * len(missing)
        cost.seconds[stage] = work / min(lanes, os.cpu_count() or 1)
        cost.lines.append(f"{stage}: statistics of {len(specs)} runs, {len(missing)} to make, {lanes} at a time")
        cost.disk += 8.0 * (QUANTILES + 4) * scene.frame_count * len(missing)
        cost.disk += BED_BYTES * sum(spec.scene.filling.count for spec in settling)
    cap = math.inf if budget.minutes is None else 60.0 * budget.minutes
    seconds = min(cap, budget.steps * emulator_pace(config, scene))
    cost.seconds["training"] = trainings * seconds
    words = f"{trainings} × {budget.steps} updates" if trainings else "finished before"
    cost.lines.append(f"training: emulator, {words}" + f", cut at {cap / 60.0:g} minutes" * (cap < math.inf))
    cost.memory = PROCESS_BYTES["torch"] + lanes * (
        PROCESS_BYTES["dem"] + 3.0 * FRAME_BYTES * scene.frame_count * scene.filling.count
    )
    return cost


def judging_cost(plan: Plan, frame: float) -> Cost:
    """What rollouts, judgement and figures will take; ``frame`` is the wall time of a frame of the model, s."""
    rollouts, count = len(plan.speeds_rpm) + plan.judge.unseen_packing, plan.scene.frame_count
    frames = rollouts * (count - 1)
    line = f"judging: {counted(rollouts, 'rollout')} of {count} frames, against "
    line += f"{counted(plan.dataset.replicas, 'replica')} of the DEM"
    # Of each packing replicas, rollout and the other packing are summed up; once the finer step and the baselines.
    sums = len(plan.packings) * (plan.dataset.replicas + 2) + 6
    # Errors after 1, 3 and 10 frames come from rollouts of 10 frames.
    seconds = frame * (frames + 10 * plan.judge.short_horizon_starts)
    seconds += summary_pace(plan.judged_case().scene) * count * sums
    stages = {"judging": seconds, "figures": FIGURES[plan.judge.gif]}
    return Cost([line], stages, PROCESS_BYTES["torch"], FRAME_BYTES * frames * plan.scene.filling.count)
