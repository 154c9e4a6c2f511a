"""The committed records that the front page is made of, as they lie in the results folder, and where each is from."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from gran_bench.code_identity import COMPARING, JUDGING, MODEL_SOURCES, TRAINING
from gran_bench.comparison.results import read_all
from gran_bench.provenance import read_origin
from gran_bench.run_summary import read_summary
from gran_bench.sweep.run_file import SWEEPS, RunFile
from gran_bench.sweep.standing import read_standing
from gran_bench.sweep.sweep_file import read_sweep

# What is committed. A reader's own runs and sweeps lie beside these and are not on the page.
RUNS = ("holdout30rpm", "paper")
SHIPPED_SWEEPS = ("sweep_loss", "sweep_rollout", "sweep_radius", "sweep_boundary")
VERIFICATION = Path("verification/verification.json")
FLOWS = (Path("verification/drum_flow.csv"), Path("verification/drum_flow_1e8.csv"))
LAMMPS, STRESS, BENCHMARK = Path("dem_speed/lammps.csv"), Path("stress/stress.csv"), Path("benchmark")

# The modules that made a record, as roots whose imports are followed.
SOLVER = ("dem.simulate", "scene.build")
VERIFIED = (*SOLVER, "verification.suite")
NETWORKS = tuple(sorted(set(MODEL_SOURCES.values())))
JUDGED = (*JUDGING, "baselines")
# A stress test goes by its lists through every kind of experiment, and one kind through sweeps as a user starts them.
SWEPT = ("train", "entry", "experiment", "job", "launcher", "sweep_run", "tracking.opening", "tracking.run")
STRESSED = (
    *(*SOLVER, *NETWORKS, *TRAINING, *JUDGED, *SWEPT, "rollout", "dataset.worker", "verification.suite"),
    *("stability.case_list", "stability.registry", "stability.run", "stability.perform", "stability.worker"),
    *("stability.victim", "stability.sweep_kill"),
)


@dataclass(frozen=True)
class Origin:
    """Where one record comes from.

    Attributes:
        record: its name on the page.
        page: what the name links to, below the results folder.
        command, commit, hardware: that made it; empty where nothing says so.
        roots: the modules that made it, as `code_identity.modules_behind` takes them.
        note: what else has to be said; empty where nothing has.
        about_code: whether it tells of the code itself, its times and failures, and not of what comes out alone: then
            it is old after a rewriting that changes no bit, too.
    """

    record: str
    page: str
    command: str
    commit: str
    hardware: str
    roots: tuple[str, ...]
    note: str = ""
    about_code: bool = False


@dataclass(frozen=True)
class Records:
    """Everything that the page says, as read; what is not there is empty.

    Attributes:
        runs: summaries by folder.
        verification: of the DEM.
        flows: by record: steady flow by packing and code (``code``, ``speed_rpm``, ``com_angle_deg``,
            ``mean_speed_m_per_s``).
        lammps: time of a step by solver (``solver``, ``cores``, ``time_step_s``, ``median_us``).
        stress: rows of the stress test.
        benchmarks: results by ``profile/scene``.
        sweeps: the runs that count, by sweep.
        waiting: jobs without a result, by sweep.
        origins: of every record.
    """

    runs: dict[str, dict[str, Any]]
    verification: dict[str, Any] | None
    flows: dict[str, pd.DataFrame]
    lammps: pd.DataFrame | None
    stress: list[dict[str, str]]
    benchmarks: dict[str, dict[str, Any]]
    sweeps: dict[str, list[RunFile]]
    waiting: dict[str, int]
    origins: list[Origin] = field(default_factory=list)

    @property
    def found(self) -> bool:
        """Whether there is any."""
        return bool(self.origins)


def read_records(root: Path) -> Records:
    """The records of a results folder.

    Raises:
        ResultsError, SweepFileError, ValueError: a record that cannot be read.
    """
    runs = {name: summary for name in RUNS if (summary := read_summary(root / name))}
    verification = json.loads((root / VERIFICATION).read_text("utf-8")) if (root / VERIFICATION).exists() else None
    stress = []
    if (root / STRESS).exists():
        with (root / STRESS).open(encoding="utf-8", newline="") as file:
            stress = list(csv.DictReader(file))
    benchmarks, sweeps, waiting = read_all(root / BENCHMARK), {}, {}
    for name in SHIPPED_SWEEPS:
        stands = read_standing(root / SWEEPS / name)
        if stands.counted:
            sweeps[name], waiting[name] = stands.counted, len(stands.waiting)
    origins = [
        *_run_origins(runs),
        *_verification_origin(verification),
        *_table_origins(root),
        *(
            _origin(benchmark_of(place), "benchmark/README.md", found["provenance"], COMPARING, about_code=True)
            for place, found in benchmarks.items()
        ),
        *(origin for name, counted in sweeps.items() for origin in _sweep_origins(root, name, counted)),
    ]
    flows = {path.with_suffix("").as_posix(): pd.read_csv(root / path) for path in FLOWS if (root / path).exists()}
    lammps = pd.read_csv(root / LAMMPS) if (root / LAMMPS).exists() else None
    return Records(runs, verification, flows, lammps, stress, benchmarks, sweeps, waiting, origins)


def training_of(run: str) -> str:
    """Name of the record of a run's training."""
    return f"{run} (training)"


def judgement_of(run: str) -> str:
    """Name of the record of a run's judgement."""
    return f"{run} (judgement)"


def benchmark_of(place: str) -> str:
    """Name of the record of a benchmark."""
    return f"benchmark {place}"


def _verification_origin(found: dict[str, Any] | None) -> Iterator[Origin]:
    if found is not None:
        yield _origin("verification", "verification/README.md", found["provenance"], VERIFIED, about_code=True)


def _run_origins(runs: Mapping[str, dict[str, Any]]) -> Iterator[Origin]:
    for name, summary in runs.items():
        source = MODEL_SOURCES[summary["model"]["name"]]
        page, training = f"{name}/README.md", summary["training"]
        yield _origin(training_of(name), page, training, (*TRAINING, source))
        yield _origin(judgement_of(name), page, summary["provenance"], (*JUDGED, source), about_code=True)


def _table_origins(root: Path) -> Iterator[Origin]:
    """Of the tables that have their origin beside them."""
    for path, page, roots in (
        *((path, path.with_suffix(".md").as_posix(), SOLVER) for path in FLOWS),
        (LAMMPS, "dem_speed/README.md", SOLVER),
        (STRESS, "stress/README.md", STRESSED),
    ):
        if (root / path).exists():
            # An origin of another table with the same name counts as none.
            made = read_origin(root / path) or {}
            yield _origin(path.with_suffix("").as_posix(), page, made, roots, about_code=path in (LAMMPS, STRESS))


def _sweep_origins(root: Path, name: str, runs: list[RunFile]) -> Iterator[Origin]:
    """One for each commit that runs of the sweep were judged at: a sweep may have been gone on with."""
    sweep, counts = read_sweep(root / SWEEPS / name), {}
    for run in runs:
        made = run.facts.get("provenance", {})
        if made.get("commit"):  # a failed run has none; why it failed is on the page
            where = made["commit"], made.get("hardware", "")
            counts[where] = [*counts.get(where, []), run]
    for (commit, hardware), some in counts.items():
        made = {"command": sweep.command if sweep else "", "commit": commit, "hardware": hardware}
        last = max(run.ended_at for run in some)[:10]
        note = f"{len(some)} of {len(runs)} runs, the last on {last}"
        yield _origin(name, f"sweeps/{name}/README.md", made, (*TRAINING, *NETWORKS, *JUDGED), note)


def _origin(
    record: str, page: str, made: Mapping[str, str], roots: tuple[str, ...], note: str = "", about_code: bool = False
) -> Origin:
    command, commit, hardware = (made.get(name, "") for name in ("command", "commit", "hardware"))
    return Origin(record, page, command, commit, hardware, roots, note, about_code)
