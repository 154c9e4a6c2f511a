"""How fast this machine is at a scene, measured here and now, so that a cost can be told before the work.

The spheres stand on a lattice and just touch: they have about as many contacts and neighbours as a bed, and no bed has
to be made first.
"""

from __future__ import annotations

import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gran_bench.baselines import rigid_rotation
from gran_bench.config import DemConfig, TrainConfig
from gran_bench.dataset import Case, Windows
from gran_bench.dem.simulate import choose_time_step, simulate
from gran_bench.metrics.bed import OVERLAPS
from gran_bench.metrics.summary import summarise
from gran_bench.scene import Scene, SceneError
from gran_bench.state import ParticleState

if TYPE_CHECKING:  # these load PyTorch, which the DEM alone does not need
    from gran_bench.surrogate.step import Surrogate

SAMPLE_STEPS = {"numba": 200, "numpy": 20, "lammps": 200}  # that the pace of the DEM is measured over
SAMPLE_FRAMES = 3  # of a model
# Of neighbours in the sample, in diameters, at this E; of stiffer spheres less, for the same force.
OVERLAP, OVERLAP_MODULUS, LARGEST_OVERLAP = 1.0e-3, 1.0e7, 0.05
NO_CONTACT = ("contact_count", "overlap_mean", "wall_contact_count", "wall_overlap_mean")


def touching_bed(scene: Scene) -> ParticleState:
    """The spheres of a scene on a lattice where neighbours just touch, at rest and at time 0; placed ones as placed."""
    filling = replace(scene.filling, jitter=0.0)
    try:
        state = replace(scene, filling=filling).fresh_filling(0)
    except SceneError:  # an imported bed can be denser than a lattice: half of it then
        if filling.count < 2 or filling.positions:
            raise
        return touching_bed(replace(scene, filling=replace(filling, count=filling.count // 2)))
    if filling.positions or not state.count:
        return state
    overlap = min(LARGEST_OVERLAP, OVERLAP * (OVERLAP_MODULUS / scene.material.youngs_modulus) ** (2.0 / 3.0))
    middle, diameters = state.position.mean(axis=0), state.position.T / (2.0 * filling.largest_radius)
    gaps = [np.diff(np.unique(np.round(line, 7))).min(initial=np.inf) for line in diameters]
    return replace(state, position=middle + (1.0 - overlap) * (state.position - middle) / gaps)


def dem_pace(scene: Scene, dem: DemConfig) -> float:
    """Measured wall time of a step of one sphere on one thread, s."""
    step, _ = choose_time_step(scene, dem.time_step, dem.allow_unsafe_step)
    steps = SAMPLE_STEPS[dem.engine]
    short = replace(scene, start_time=0.0, end_time=steps * step, frame_interval=steps * step)
    dem, bed = replace(dem, time_step=step, threads=1), touching_bed(scene)
    return simulate(short, bed, short.end_time, dem=dem).wall_seconds / (steps * max(bed.count, 1))


def summary_pace(scene: Scene, overlaps: bool = False) -> float:
    """Measured wall time that a frame of a trajectory takes to be summed up, s; with its ``overlaps`` known, or not."""
    short = replace(scene, start_time=0.0, end_time=(SAMPLE_FRAMES - 1) * scene.frame_interval)
    bed = touching_bed(scene)
    motion = rigid_rotation(short, bed)
    if overlaps:
        motion = replace(motion, diagnostics={name: np.zeros(motion.frame_count) for name in OVERLAPS})
    for _ in range(2):  # the first loads what was compiled
        began = time.perf_counter()
        summarise(motion, short)
    return (time.perf_counter() - began) / SAMPLE_FRAMES * scene.filling.count / bed.count


def rollout_pace(model: Surrogate, scene: Scene) -> float:
    """Measured wall time of a frame on one thread, s."""
    import torch

    from gran_bench.surrogate.rollout import step_frames

    bed, threads = touching_bed(scene), torch.get_num_threads()
    frames = step_frames(model, scene, bed)
    torch.set_num_threads(1)
    for _ in zip(range(2), frames, strict=False):  # the state itself, and a frame that loads what was compiled
        began = time.perf_counter()
    for _ in zip(range(SAMPLE_FRAMES), frames, strict=False):
        last = time.perf_counter()
    torch.set_num_threads(threads)
    return (last - began) / SAMPLE_FRAMES * scene.filling.count / bed.count


def update_pace(config: TrainConfig, model: Surrogate, scene: Scene) -> float:
    """Measured wall time of an update for each frame that it looks ahead, s; spoils the weights of the model."""
    import torch

    from gran_bench.trainer import Trainer, TrainingDiverged

    ahead, bed = config.rollout.frames, touching_bed(scene)
    short = replace(scene, start_time=0.0, end_time=(ahead + 1) * scene.frame_interval)
    nothing = {name: np.zeros(ahead + 2) for name in NO_CONTACT}
    case = Case(short, replace(rigid_rotation(short, bed), diagnostics=nothing), bed, {}, "", Path("sample"))
    still = replace(config, optim=replace(config.optim, learning_rate=1e-12, final_learning_rate=1e-12))
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(model, Windows([case]), still, Path(folder))
        with ThreadPoolExecutor(trainer.workers, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            for _ in range(2):
                began = time.perf_counter()
                with suppress(TrainingDiverged):
                    trainer.update(pool)
    return (time.perf_counter() - began) / ahead * scene.filling.count / bed.count


def emulator_pace(config: TrainConfig, scene: Scene) -> float:
    """Measured wall time of an update of an emulator, s."""
    import torch

    from gran_bench.emulator.network import INPUTS
    from gran_bench.emulator.runs import FIGURES
    from gran_bench.emulator.training import make_emulator

    emulator = make_emulator(config, scene, list(FIGURES))
    inputs = torch.zeros(config.model.batch, scene.frame_count, len(INPUTS))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    for _ in range(2):  # the first warms up
        began = time.perf_counter()
        sum(found.mean() for found in emulator(inputs)).backward()
    torch.set_num_threads(threads)
    batches = -(-config.optim.accumulate // min(config.threads, config.optim.accumulate))
    # An update takes one part of the strided frames, and shares the series out to the committee; it looks at twins too.
    share = 1.5 / (config.model.stride * config.model.committee)
    return share * batches * (time.perf_counter() - began)
