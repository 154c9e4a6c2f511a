"""What a method does when it is its turn, from plain data: prepared once, run as often as it is timed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gran_bench.baselines import ballistic, interpolated_statistics, rigid_rotation
from gran_bench.config import DemConfig
from gran_bench.dataset import from_document, read_case, read_settled
from gran_bench.dataset.case_spec import NUDGE
from gran_bench.dataset.generation import nudged
from gran_bench.dem.simulate import SimulationError, simulate
from gran_bench.metrics.summary import summarise
from gran_bench.scene import Scene
from gran_bench.state import ParticleState, Trajectory

STAGE = 0.05  # s that a bed is given to relax after each step towards a stiffer material
BASELINES = {"rigid rotation": rigid_rotation, "ballistic": ballistic}


@dataclass(frozen=True)
class Outcome:
    """What one run gave.

    Attributes:
        trajectory: its frames; None for statistics without particles.
        failure: why it could not go on; empty for a run that reached its end.
        reached: frames that a run which failed had computed before.
    """

    trajectory: Trajectory | None
    failure: str = ""
    reached: int = 0


# Called with the number of frames to compute, and with the seed of a nudge: each round starts from its own, because one
# chaotic run is one sample.
Run = Callable[[int, int], Outcome]


def prepare(job: dict[str, Any]) -> Run:
    """Load whatever a method needs, so that a run of it is nothing but its own work.

    Args:
        job: ``does`` names the method; the rest is what it needs, as plain data.
    """
    makers = {"dem": _dem, "surrogate": _surrogate, "interpolation": _interpolation}
    return (makers | dict.fromkeys(BASELINES, _baseline))[job["does"]](job)


def with_modulus(scene: Scene, modulus: float) -> Scene:
    """The same scene with another Young's modulus (Pa) of every material, walls included."""
    return replace(
        scene,
        material=replace(scene.material, youngs_modulus=modulus),
        wall_material=replace(scene.wall_material, youngs_modulus=modulus),
        more_materials=tuple(replace(material, youngs_modulus=modulus) for material in scene.more_materials),
    )


def _dem(job: dict[str, Any]) -> Run:
    scene, dem = from_document(job["scene"]), DemConfig(**job["dem"])
    bed, _ = read_settled(job["bed"])
    # A bed of softer spheres overlaps too much for a stiffer material to take at once: it would fly apart.
    for modulus in job["stages"]:
        bed = simulate(with_modulus(scene, modulus), bed, bed.time + STAGE, dem=DemConfig(threads=1)).final

    def run(frames: int, nudge_seed: int) -> Outcome:
        start, end = _start(bed, nudge_seed), bed.time + frames * scene.frame_interval
        try:
            return Outcome(simulate(scene, start, end, dem=dem).trajectory)
        except SimulationError as error:
            return Outcome(error.trajectory, str(error), max(0, error.trajectory.frame_count - 2))

    return run


def _surrogate(job: dict[str, Any]) -> Run:
    # Imported here, so that the memory of a DEM does not have PyTorch in it.
    import torch

    from gran_bench.surrogate.checkpoint import load_model
    from gran_bench.surrogate.rollout import rollout

    torch.set_num_threads(1)
    scene, (bed, _) = from_document(job["scene"]), read_settled(job["bed"])
    model, _ = load_model(job["model"])

    def run(frames: int, nudge_seed: int) -> Outcome:
        result = rollout(model, scene, _start(bed, nudge_seed), frames + 1)
        if result.failed_frame is None:
            return Outcome(result.trajectory)
        reason = f"not finite from frame {result.failed_frame} on"
        return Outcome(result.trajectory, reason, result.failed_frame - 1)

    return run


def _baseline(job: dict[str, Any]) -> Run:
    scene, (bed, _) = from_document(job["scene"]), read_settled(job["bed"])
    return lambda frames, nudge_seed: Outcome(BASELINES[job["does"]](_cut(scene, bed, frames), _start(bed, nudge_seed)))


def _interpolation(job: dict[str, Any]) -> Run:
    cases = {float(rpm): read_case(path) for rpm, path in job["cases"].items()}
    training = {rpm: summarise(case.trajectory, case.scene) for rpm, case in cases.items()}

    def run(frames: int, nudge_seed: int) -> Outcome:
        interpolated_statistics(job["rpm"], training)
        return Outcome(None)

    return run


def _start(bed: ParticleState, nudge_seed: int) -> ParticleState:
    return nudged(bed, NUDGE, nudge_seed)


def _cut(scene: Scene, bed: ParticleState, frames: int) -> Scene:
    """The scene, ended ``frames`` frames after the state of the bed."""
    end = bed.time + frames * scene.frame_interval
    return scene if np.isclose(end, scene.end_time) else replace(scene, end_time=end)
