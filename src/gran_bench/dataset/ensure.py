"""Make the cases that are missing, once each, several at a time, and keep the ones that are there."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from gran_bench.dataset.case_file import read_attributes
from gran_bench.dataset.case_spec import CaseSpec, DatasetError
from gran_bench.dataset.generation import Job
from gran_bench.dataset.progress import SimulatedTimeBar
from gran_bench.dataset.workers import run_in_workers


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
