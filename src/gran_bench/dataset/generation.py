"""Make the cases that are missing, once each, several at a time, and keep the ones that are there."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import gran_bench
from gran_bench.dataset.case_file import read_attributes, read_settled, write_case, write_settled
from gran_bench.dataset.case_spec import CaseSpec, DatasetError, dem_source_hash
from gran_bench.dataset.progress import SimulatedTimeBar
from gran_bench.dataset.workers import run_in_workers
from gran_bench.dem.simulate import settle, simulate
from gran_bench.files import locked, remove_leftovers
from gran_bench.state import ParticleState

T = TypeVar("T")
Report = Callable[[float], None]  # called with the simulated time that a job has covered so far, s


@dataclass(frozen=True)
class Job:
    """One file to make: the settled bed of a case, or the case itself from its settled bed."""

    spec: CaseSpec
    root: Path
    settles: bool

    @property
    def path(self) -> Path:
        """The file that the job makes."""
        return self.spec.settled_path(self.root) if self.settles else self.spec.path(self.root)

    @property
    def simulated_seconds(self) -> float:
        """How long the job will simulate, s; of a settling bed the least that it takes."""
        scene = self.spec.scene
        return scene.start_time if self.settles else scene.end_time - scene.start_time

    def run(self, report: Report, waiting: Callable[[], None] = lambda: None) -> None:
        """Make the file unless it is there.

        Args:
            report: gets the simulated time covered, s.
            waiting: called once if another process is making the same file.

        Raises:
            DatasetError: the simulation failed or the file cannot be written or read.
        """
        lock = self.path.parent / ".locks" / f"{self.path.stem}.lock"
        try:
            with locked(lock, waiting):
                if self.path.exists():
                    read_attributes(self.path)
                    return
                remove_leftovers(self.path)
                if self.settles:
                    _make_settled(self, report)
                else:
                    _make_case(self, report)
        except BrokenPipeError:  # of a report: whoever listened is gone
            raise
        except OSError as error:
            raise DatasetError(
                f"{self.path} cannot be made: {error.strerror or error}; free space, or choose another dataset.root"
            ) from error


def ensure_case(spec: CaseSpec, root: Path | str, progress: bool = False) -> Path:
    """The file of a case, made in this process if it is missing; as :func:`ensure_cases`."""
    return ensure_cases([spec], root, workers=1, progress=progress)[0]


def ensure_cases(specs: Iterable[CaseSpec], root: Path | str, workers: int = 2, progress: bool = True) -> list[Path]:
    """The files of cases; those that are missing are made, ``workers`` at a time, each in a process of its own.

    Whatever another process is making at the same moment is waited for, not made twice. A killed run leaves
    the finished files and no half ones, and the same call goes on from there to the same data.

    Args:
        specs: the cases.
        root: folder of the files.
        workers: processes; 1 makes everything in this process.
        progress: one bar of simulated time for all; silent without a terminal.

    Returns:
        A path for each spec, in order.

    Raises:
        DatasetError: a file is damaged, or cases could not be made; the others were made nevertheless.
    """
    specs, root = list(specs), Path(root)
    cases = {spec.path(root): spec for spec in specs}
    missing = [spec for path, spec in cases.items() if not _is_there(path)]
    beds = {spec.settled_path(root): spec for spec in missing}
    stages = [
        [Job(spec, root, settles=True) for path, spec in beds.items() if not _is_there(path)],
        [Job(spec, root, settles=False) for spec in missing],
    ]
    with SimulatedTimeBar([job for stage in stages for job in stage], show=progress) as bar:
        for jobs in stages:
            _run(jobs, workers, bar)
    return [spec.path(root) for spec in specs]


def _is_there(path: Path) -> bool:
    """Whether a finished file is there; a quick look at it finds one that was cut short afterwards."""
    if not path.exists():
        return False
    read_attributes(path)
    return True


def _run(jobs: list[Job], workers: int, bar: SimulatedTimeBar) -> None:
    if workers > 1 and len(jobs) > 1:
        failures = run_in_workers(jobs, min(workers, len(jobs)), bar)
    else:
        failures = []
        for job in jobs:
            try:
                job.run(lambda seconds, job=job: bar.reached(job, seconds), lambda job=job: bar.waits(job))
                bar.finished(job)
            except DatasetError as error:
                failures.append((job, str(error)))
    if failures:
        lines = "; ".join(f"{job.spec.label}: {message}" for job, message in failures)
        several = f"{len(failures)} of {len(jobs)} files of the data set could not be made: " if len(jobs) > 1 else ""
        raise DatasetError(several + lines)


def _make_settled(job: Job, report: Report) -> None:
    spec, began = job.spec, time.perf_counter()
    said: list[str] = []
    state = _simulation(
        lambda: settle(spec.settling_scene, spec.packing_seed, dem=spec.bed_dem, progress=report, warn=said.append)
    )
    facts = _facts(spec) | {"warnings": "\n".join(said), "wall_seconds": time.perf_counter() - began}
    write_settled(job.path, spec.settling_key, state, facts)


def _make_case(job: Job, report: Report) -> None:
    spec, scene = job.spec, job.spec.scene
    bed, bed_facts = read_settled(spec.settled_path(job.root))
    start = nudged(bed, spec.nudge, spec.nudge_seed)
    result = _simulation(
        lambda: simulate(
            scene, start, scene.end_time, dem=spec.dem, progress=lambda clock: report(clock - scene.start_time)
        ),
    )
    key = spec.key
    if result.time_step != key["dem"]["time_step"]:
        raise DatasetError(
            f"the solver took steps of {result.time_step:g} s where {key['dem']['time_step']:g} s name the file; "
            "set dem.time_step"
        )
    facts = _facts(spec) | {
        "time_step": result.time_step,
        "steps": result.steps,
        "nudge": float(spec.nudge),
        "nudge_seed": int(spec.nudge_seed),
        "warnings": "\n".join((*bed_facts["warnings"].splitlines(), *result.warnings)),
        "wall_seconds": float(result.wall_seconds),
        "settling_wall_seconds": float(bed_facts["wall_seconds"]),
        "settled_digest": bed_facts["digest"],
    }
    write_case(job.path, key, scene, result.trajectory, start, facts)


def nudged(state: ParticleState, length: float, seed: int) -> ParticleState:
    """The state with every particle displaced by ``length`` (m) in a random direction of its own."""
    if not length:
        return state
    direction = np.random.default_rng(seed).standard_normal(state.position.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return replace(state, position=state.position + length * direction)


def _simulation(run: Callable[[], T]) -> T:
    """Run the solver; a simulation that fails becomes an error of the data set, which names the case."""
    try:
        return run()
    except (ValueError, RuntimeError) as error:
        raise DatasetError(str(error)) from error


def _facts(spec: CaseSpec) -> dict[str, Any]:
    """Attributes that say who made a file, with what."""
    return {
        "engine": spec.dem.engine,
        "packing_seed": int(spec.packing_seed),
        "code_version": gran_bench.__version__,
        "dem_code": dem_source_hash(),
        "software": f"Python {platform.python_version()}, numpy {version('numpy')}, numba {version('numba')}",
        "machine": platform.platform(),
        "made_at": datetime.now(UTC).isoformat(timespec="seconds"),
    }
