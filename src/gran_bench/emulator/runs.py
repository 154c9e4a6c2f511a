"""Statistics of a run of the DEM, frame by frame: made once, kept in a small file, without the trajectory."""

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gran_bench.dataset import CaseSpec, DatasetError, read_settled
from gran_bench.dataset.case_spec import key_hash
from gran_bench.dataset.ensure import make_files
from gran_bench.dataset.generation import Job, nudged, refusals_of
from gran_bench.dem.simulate import simulate
from gran_bench.files import locked, remove_leftovers, whole_file
from gran_bench.metrics.angle_of_repose import com_angle, surface_angle
from gran_bench.metrics.speeds import mean_speed, sorted_frames, speeds
from gran_bench.provenance.source_digest import source_digest
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, Trajectory

FOLDER = "statistics"  # below the data's root
QUANTILES = 24  # of the speeds, at the levels (k + ½)/24: the mean of their differences is the Wasserstein-1 distance
MEASURING = ("metrics/angle_of_repose.py", "metrics/speeds.py", "emulator/runs.py")  # source that makes the figures
RUNS_A_PROCESS = 6  # a process takes seconds to start
COMPARED = ("surface_angle", "com_angle", "speed")  # that decide
# Figures of a frame in the order of their columns: for people, unit, columns. ``torque`` is there with dem.power=true.
FIGURES = {
    "surface_angle": ("angle of repose", "deg", 1),
    "com_angle": ("centre-of-mass angle", "deg", 1),
    "speed": ("speeds, W1 a frame", "m/s", QUANTILES),
    "mean_speed": ("mean speed", "m/s", 1),
    "torque": ("torque on the drum", "N m", 1),
}


@dataclass(frozen=True)
class RunStatistics:
    """The statistics of one run: the wall's motion, what the flow depends on beside it, and the figures."""

    scene: Scene  # with the rotation of the run
    time: FloatArray  # (F,) s
    figures: dict[str, FloatArray]  # (F, columns) by the names of `FIGURES`; NaN where a frame has none
    seconds: float = float("nan")  # of the DEM's own work on one thread, s
    digest: str = ""  # of the file

    @property
    def columns(self) -> FloatArray:
        """All figures side by side, ``(F, C)``."""
        return np.concatenate(list(self.figures.values()), axis=1)


def columns_of(names: Iterable[str]) -> dict[str, slice]:
    """Where the columns of each figure are."""
    found, first = {}, 0
    for name in names:
        found[name] = slice(first, first + FIGURES[name][2])
        first += FIGURES[name][2]
    return found


def measure(trajectory: Trajectory, scene: Scene) -> dict[str, FloatArray]:
    """The figures of every frame of a trajectory, by name, ``(F, columns)`` each."""
    ordered = sorted_frames(speeds(trajectory.velocity)).astype(np.float64)
    found = {
        "surface_angle": surface_angle(trajectory, scene).value,
        "com_angle": com_angle(trajectory, scene).value,
        "speed": quantiles(ordered),
        "mean_speed": mean_speed(trajectory, scene).value,
    }
    if "wall_torque" in trajectory.energy:
        found["torque"] = trajectory.energy["wall_torque"].sum(axis=1)
    return {name: value.reshape(len(value), -1) for name, value in found.items()}


def quantiles(ordered: FloatArray) -> FloatArray:
    """Quantiles of increasing values, ``(F, N)`` to ``(F, 24)``, at the levels (k + ½)/24, linear between samples."""
    count = ordered.shape[1]
    place = np.clip((np.arange(QUANTILES) + 0.5) / QUANTILES * count - 0.5, 0.0, count - 1.0)
    low = np.minimum(place.astype(np.int64), max(count - 2, 0))
    high = np.minimum(low + 1, count - 1)
    return ordered[:, low] + (ordered[:, high] - ordered[:, low]) * (place - low)


def run_path(spec: CaseSpec, root: Path | str) -> Path:
    """File of the statistics of a case, named by what determines the case."""
    return Path(root) / FOLDER / f"{spec.label}_{key_hash(spec.key | {'measured_by': source_digest(MEASURING)})}.npz"


def ensure_runs(specs: Sequence[CaseSpec], root: Path | str, workers: int = 2, progress: bool = True) -> None:
    """Make the statistics that are missing, ``workers`` processes at a time; finished files stay, whatever happens.

    Raises:
        DatasetError: a run that failed, or a file that cannot be written; the others were made nevertheless.
    """
    missing = list({path: s for s in specs if not (path := run_path(s, root)).exists()}.values())
    # Runs of one bed stand together, so that it is settled once and nobody waits for it.
    missing.sort(key=lambda spec: str(spec.settled_path(root)))
    beds = {spec.settled_path(root): spec for spec in missing}
    shared = [spec for path, spec in beds.items() if sum(s.settled_path(root) == path for s in missing) > 1]
    first = [Job(spec, Path(root), settles=True) for spec in shared if not spec.settled_path(root).exists()]
    share = max(1, min(RUNS_A_PROCESS, -(-len(missing) // workers)))
    batches = [Batch(tuple(missing[k : k + share]), Path(root)) for k in range(0, len(missing), share)]
    make_files([first, batches], workers, progress)


@dataclass(frozen=True)
class Batch:
    """Statistics that one process makes, one run after another."""

    specs: tuple[CaseSpec, ...]
    root: Path

    @property
    def spec(self) -> CaseSpec:
        """The first run, which stands for all in messages."""
        return self.specs[0]

    @property
    def path(self) -> Path:
        """The first file, by which a process sees that it has the code that the parent has."""
        return run_path(self.spec, self.root)

    @property
    def simulated_seconds(self) -> float:
        """How long all will simulate, s."""
        return sum(spec.scene.end_time - spec.scene.start_time for spec in self.specs)

    def run(self, report: Callable[[float], None], waiting: Callable[[], None] = lambda: None) -> None:
        """Make each file unless it is there (`DatasetError`); arguments as of `Job.run`."""
        before = 0.0
        for spec in self.specs:
            self._make(spec, lambda seconds, before=before: report(before + seconds), waiting)
            before += spec.scene.end_time - spec.scene.start_time
            report(before)

    def _make(self, spec: CaseSpec, report: Callable[[float], None], waiting: Callable[[], None]) -> None:
        path, scene, bed = run_path(spec, self.root), spec.scene, spec.settled_path(self.root)
        began = scene.start_time
        with refusals_of(path), locked(path.parent / ".locks" / f"{path.stem}.lock", waiting):
            if path.exists():
                return
            remove_leftovers(path)
            if not bed.exists():
                Job(spec, self.root, settles=True).run(lambda seconds: report(0.0), waiting)
            start = nudged(read_settled(bed)[0], spec.nudge, spec.nudge_seed)
            dem = replace(spec.dem, time_step=spec.key["dem"]["time_step"], threads=1)
            result = simulate(scene, start, scene.end_time, dem=dem, progress=lambda t: report(t - began))
            write_run(path, result.trajectory.time, measure(result.trajectory, scene), result.wall_seconds)


def write_run(path: Path, time: FloatArray, figures: dict[str, FloatArray], seconds: float) -> None:
    """Write statistics, whole or not at all, with a digest of what is in the file."""
    arrays = {"time": time, **figures}
    facts = json.dumps({"seconds": seconds, "figures": list(figures), "digest": _digest(arrays)})
    with whole_file(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, facts=facts, **arrays)


def read_run(spec: CaseSpec, root: Path | str) -> RunStatistics:
    """The statistics of a case; a `DatasetError` where they are not there or damaged."""
    path = run_path(spec, root)
    try:
        with np.load(path) as kept:
            arrays = {**kept}
        facts: dict[str, Any] = json.loads(str(arrays.pop("facts")))
        if _digest(arrays) != facts["digest"]:
            raise ValueError("its digest does not fit")
    except Exception as error:
        raise DatasetError(
            f"{path} cannot be read ({type(error).__name__}: {error}); delete it, and the same command makes it again"
        ) from error
    figures = {name: arrays[name] for name in facts["figures"]}
    return RunStatistics(spec.scene, arrays["time"], figures, facts["seconds"], facts["digest"])


def _digest(arrays: dict[str, FloatArray]) -> str:
    digest = hashlib.sha256()
    for name, array in arrays.items():
        digest.update(f"{name} {array.shape} {array.dtype}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]
