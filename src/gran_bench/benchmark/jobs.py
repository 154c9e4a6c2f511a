"""What a method does when it is its turn, from plain data; as a module, a process of its own that runs one method."""

import resource
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gran_bench.baselines import ballistic, interpolated_statistics, rigid_rotation
from gran_bench.config import DemConfig
from gran_bench.dataset import from_document, read_case, read_settled
from gran_bench.dataset.case_spec import replica_nudge
from gran_bench.dataset.generation import nudged
from gran_bench.dem.simulate import SimulationError, simulate
from gran_bench.files import write_atomically
from gran_bench.metrics.bed import OVERLAPS
from gran_bench.metrics.ensembles import SPEEDS, Claims
from gran_bench.metrics.summary import TrajectorySummary, summarise
from gran_bench.scene import Scene
from gran_bench.state import ParticleState, Trajectory
from gran_bench.workers import serve

STAGE = 5  # frames that a bed is given to relax after each step towards a stiffer material
WARM_UP = 2  # frames: they compile, or load what was compiled before
BASELINES = {"rigid rotation": rigid_rotation, "ballistic": ballistic}


class Outcome(NamedTuple):
    """What one run gave."""

    trajectory: Trajectory | None  # its frames; None for statistics without particles
    failure: str = ""  # why it could not go on; empty for a run that reached its end
    reached: int = 0  # frames that a run which failed had computed before


# Called with the number of frames to compute, and with the seed of a nudge: each round starts from its own, because one
# chaotic run is one sample. Seeds of rounds are consecutive, so rounds take turns with the beds, where there are many.
Run = Callable[[int, int], Outcome]


def prepare(job: dict[str, Any]) -> Run:
    """Load whatever the method of a job (plain data) needs, so that a run of it is nothing but its own work."""
    if job["does"] == "interpolation":
        training = training_summaries(job)

        def interpolated(frames: int, seed: int) -> Outcome:
            interpolated_statistics(job["rpm"], training)
            return Outcome(None)

        return interpolated
    scene, beds = from_document(job["scene"]), [read_settled(path)[0] for path in job["beds"]]
    if job["does"] == "dem":
        return _dem(scene, beds, DemConfig(**job["dem"]), job["stages"])
    if job["does"] == "surrogate":
        return _surrogate(scene, beds, job["model"])
    if job["does"] == "emulator":
        return _emulator(scene, beds, job["model"])

    def run(frames: int, seed: int) -> Outcome:
        bed = _start(scene, beds, seed)
        end = bed.time + frames * scene.frame_interval
        cut = scene if np.isclose(end, scene.end_time) else replace(scene, end_time=end)
        return Outcome(BASELINES[job["does"]](cut, bed))

    return run


def _start(scene: Scene, beds: list[ParticleState], seed: int) -> ParticleState:
    return nudged(beds[seed % len(beds)], replica_nudge(scene), seed)


def training_summaries(job: dict[str, Any]) -> dict[float, TrajectorySummary]:
    """What the interpolation of a job lies between, by speed in rpm."""
    cases = {float(rpm): read_case(path) for rpm, path in job["cases"].items()}
    return {rpm: summarise(case.trajectory, case.scene) for rpm, case in cases.items()}


def with_modulus(scene: Scene, modulus: float) -> Scene:
    """The same scene with another Young's modulus (Pa) of every material, walls included."""
    materials = (scene.material, scene.wall_material, *scene.more_materials)
    first, wall, *more = (replace(material, youngs_modulus=modulus) for material in materials)
    return replace(scene, material=first, wall_material=wall, more_materials=tuple(more))


def _dem(scene: Scene, beds: list[ParticleState], dem: DemConfig, stages: list[float]) -> Run:
    def led(bed: ParticleState) -> ParticleState:
        # A bed of softer spheres overlaps too much for a stiffer material to take at once: it would fly apart.
        for modulus in stages:
            stage, end = with_modulus(scene, modulus), bed.time + STAGE * scene.frame_interval
            bed = simulate(stage, bed, end, dem=DemConfig(threads=1)).final
        return bed

    beds = [led(bed) for bed in beds]

    def run(frames: int, seed: int) -> Outcome:
        start = _start(scene, beds, seed)
        try:
            return Outcome(simulate(scene, start, start.time + frames * scene.frame_interval, dem=dem).trajectory)
        except SimulationError as error:
            return Outcome(error.trajectory, str(error), max(0, error.trajectory.frame_count - 2))

    return run


def _surrogate(scene: Scene, beds: list[ParticleState], path: str) -> Run:
    # Imported here, so that the memory of a DEM does not have PyTorch in it.
    import torch

    from gran_bench.surrogate.checkpoint import load_model
    from gran_bench.surrogate.rollout import rollout

    torch.set_num_threads(1)
    model, _ = load_model(path)

    def run(frames: int, seed: int) -> Outcome:
        result = rollout(model, scene, _start(scene, beds, seed), frames + 1)
        failed = result.failed_frame
        reason = () if failed is None else (f"not finite from frame {failed} on", failed - 1)
        return Outcome(result.trajectory, *reason)

    return run


def _emulator(scene: Scene, beds: list[ParticleState], path: str) -> Run:
    import torch

    from gran_bench.emulator.network import load_emulator

    torch.set_num_threads(1)
    emulator = load_emulator(path)

    def run(frames: int, seed: int) -> Outcome:
        _emulated(emulator, scene, _start(scene, beds, seed), seed)  # of the whole scene, however few are asked for
        return Outcome(None)

    return run


def emulated(job: dict[str, Any], seed: int) -> Claims:
    """What the emulator of a job claims from the bed of a round, by key of a row of the judgement."""
    from gran_bench.emulator.network import load_emulator

    scene, beds = from_document(job["scene"]), [read_settled(path)[0] for path in job["beds"]]
    said = _emulated(load_emulator(job["model"]), scene, _start(scene, beds, seed), seed)
    series = {name: said.members[..., place.start] for name, place in said.columns.items() if name != "speed"}
    return series | {SPEEDS: said.members[..., said.columns["speed"]]}


def _emulated(emulator: Any, scene: Scene, bed: ParticleState, seed: int) -> Any:
    from gran_bench.emulator.network import settled_angles

    return emulator.statistics(scene, settled_angles(scene, bed), seed=seed)


def _timed(run: Run, frames: int, seed: int, keep: str | None) -> dict[str, Any]:
    """Wall and processor time of a run, s, the largest memory of this process, and what came on top of it, bytes."""
    with suppress(OSError):  # the peak starts anew, where the system can: what compiling took is not the method's
        Path("/proc/self/clear_refs").write_text("5")
    before, wall, cpu = _resident_memory("VmRSS"), time.perf_counter(), time.process_time()
    outcome = run(frames, seed)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = _resident_memory("VmHWM")
    if outcome.failure:
        return {"failure": outcome.failure, "wall_seconds": wall, "reached": outcome.reached}
    if keep and outcome.trajectory is not None:
        keep_trajectory(Path(keep), outcome.trajectory)
    own = max(0, peak - before)
    return {"wall_seconds": wall, "cpu_seconds": cpu, "peak_bytes": peak, "own_bytes": own}


def keep_trajectory(path: Path, frames: Trajectory) -> None:
    """Write the frames of a run in single precision, as data sets hold them, whole or not at all."""
    arrays = {name: getattr(frames, name) for name in ("position", "velocity", "angular_velocity")}
    single = {name: np.asarray(array, np.float32) for name, array in arrays.items() if array is not None}
    facts = {"time": frames.time, "radius": frames.radius, "velocity_kind": frames.velocity_kind}
    # The engine's own overlaps: whoever judges need not look for all pairs again.
    facts |= {name: frames.diagnostics[name] for name in OVERLAPS if name in frames.diagnostics}
    write_atomically(path, lambda file: np.savez(file, **facts, **single))


def read_trajectory(path: Path) -> Trajectory:
    """The frames that a run kept."""
    with np.load(path) as kept:
        arrays = {name: kept[name] for name in kept.files}
    spin = arrays.pop("angular_velocity", None)
    own = {name: arrays.pop(name) for name in OVERLAPS if name in arrays}
    kind = {"velocity_kind": str(arrays["velocity_kind"])}
    return Trajectory(**arrays | kind, angular_velocity=spin, diagnostics=own)


def _resident_memory(field: str) -> int:
    """``VmRSS``, the resident memory of this process, or ``VmHWM``, its peak; bytes."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith(f"{field}:"):
                return 1024 * int(line.split()[1])
    # It counts the memory of the parent at the start, too.
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _server() -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Prepares a method at the first request, and runs it at every further one."""
    ready: list[Any] = []

    def answer(request: dict[str, Any]) -> dict[str, Any]:
        try:
            if ready:
                return _timed(*ready, request["nudge_seed"], request["keep"])
            ready[:] = prepare(request["job"]), request["frames"]
            ready[0](min(WARM_UP, request["frames"]), request["nudge_seed"])
            return {"ready": True}
        except Exception as error:  # whatever a method dies of is its failure, not the benchmark's
            return {"died": f"{type(error).__name__}: {error}"}

    return answer


if __name__ == "__main__":
    serve(_server())
