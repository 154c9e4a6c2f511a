"""Make the cases that are missing, once each, several at a time, and keep the ones that are there."""

from __future__ import annotations

import json
import pickle
import subprocess
import tempfile
import threading
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

from gran_bench.dataset.case_file import read_attributes
from gran_bench.dataset.case_spec import CaseSpec, DatasetError
from gran_bench.dataset.generation import Job
from gran_bench.processes import ONE_THREAD, start_module
from gran_bench.progress import Progress


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
        progress: one bar of simulated time for all.

    Returns:
        A path for each spec, in order.

    Raises:
        DatasetError: a file is damaged, or cases could not be made; the others were made nevertheless.
    """
    specs, root = list(specs), Path(root)
    cases = {spec.path(root): spec for spec in specs}
    missing = [spec for path, spec in cases.items() if not _is_there(path)]
    beds = {spec.settled_path(root): spec for spec in missing}
    settling = [Job(spec, root, settles=True) for path, spec in beds.items() if not _is_there(path)]
    moving = [Job(spec, root, settles=False) for spec in missing]
    make_files([settling, moving], workers, progress)
    return [spec.path(root) for spec in specs]


def ensure_beds(specs: Iterable[CaseSpec], root: Path | str, workers: int = 2, progress: bool = True) -> None:
    """Make the settled beds of cases that are missing, as :func:`ensure_cases`."""
    beds = {spec.settled_path(root): spec for spec in specs}
    missing = [Job(spec, Path(root), settles=True) for path, spec in beds.items() if not _is_there(path)]
    make_files([missing], workers, progress)


def make_files(stages: Sequence[Sequence[Job]], workers: int, progress: bool) -> None:
    """Run the jobs of one stage after another, ``workers`` processes at a time.

    A job is a `Job` or what has its ``spec``, ``path``, ``simulated_seconds`` and ``run``, and can be pickled.

    Raises:
        DatasetError: jobs that failed; the others of their stage were done nevertheless.
    """
    with SimulatedTimeBar([job for stage in stages for job in stage], show=progress) as bar:
        for jobs in stages:
            apart = workers > 1 and len(jobs) > 1
            troubles = _in_processes(jobs, workers, bar) if apart else [_here(job, bar) for job in jobs]
            lines = [f"{job.spec.label}: {words}" for job, words in zip(jobs, troubles, strict=True) if words]
            if lines:
                many = f"{len(lines)} of {len(jobs)} files of the data set could not be made: " if len(jobs) > 1 else ""
                raise DatasetError(many + "; ".join(lines))


def _is_there(path: Path) -> bool:
    """Whether a finished file is there; a quick look at it finds one that was cut short afterwards."""
    if not path.exists():
        return False
    read_attributes(path)
    return True


def _here(job: Job, bar: SimulatedTimeBar) -> str | None:
    """Run a job in this process; what went wrong, or None."""
    try:
        job.run(lambda seconds: bar.reached(job, seconds), lambda: bar.waits(job))
    except DatasetError as error:
        return str(error)
    bar.finished(job)
    return None


def _in_processes(jobs: Sequence[Job], workers: int, bar: SimulatedTimeBar) -> list[str | None]:
    """Run jobs in processes that end with this one, ``workers`` at a time; what went wrong with each, or None."""
    started: list[subprocess.Popen] = []
    stopped = threading.Event()

    def run(job: Job) -> str | None:
        with tempfile.TemporaryFile() as complaints:
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": complaints}
            process = start_module("gran_bench.dataset.worker", environment=ONE_THREAD, **pipes)
            started.append(process)
            if stopped.is_set():
                process.kill()
            with suppress(BrokenPipeError), process.stdin:
                pickle.dump((job, job.path), process.stdin)
            trouble = None
            with process.stdout:
                for word in map(json.loads, process.stdout):
                    if word is None:
                        bar.waits(job)
                    elif isinstance(word, str):
                        trouble = word
                    else:
                        bar.reached(job, word)
            if process.wait() and trouble is None:
                trouble = _last_words(process.returncode, complaints)
        if trouble is None:
            bar.finished(job)
        return trouble

    pool = ThreadPoolExecutor(workers)
    try:
        return list(pool.map(run, jobs))
    finally:  # after an interruption finished files stay, unfinished ones never had their name
        stopped.set()
        for process in started:
            process.kill()
        pool.shutdown(cancel_futures=True)


def _last_words(status: int, complaints: BinaryIO) -> str:
    """Why a process ended in the middle of a job, from its exit status and the end of what it wrote."""
    complaints.seek(0)
    lines = complaints.read().decode(errors="replace").strip().splitlines()
    why = lines[-1] if lines else f"its process ended with status {status}"
    if status < 0:
        why = f"its process was ended by signal {-status} (9: often a lack of memory; try dataset.workers=1)"
    return f"{why}; run the same command again, finished files are kept"


class SimulatedTimeBar:
    """A bar over the simulated seconds of all jobs; safe to feed from several threads.

    Args:
        jobs: everything that will run, each with its ``simulated_seconds``; none draws no bar.
        show: False never draws.
    """

    def __init__(self, jobs: list[Any], show: bool) -> None:
        self._expected = {id(job): job.simulated_seconds for job in jobs}
        self._covered = dict.fromkeys(self._expected, 0.0)
        self._done, self._lock = -1, threading.Lock()
        self._bar = Progress(
            total=round(sum(self._expected.values()), 6),
            desc=self._one_more(),
            show=show and bool(jobs),
            bar_format="{desc}: {percentage:3.0f}%|{bar}| {n:.1f}/{total:.1f} s simulated "
            "[{elapsed}<{remaining}{postfix}]",
        )

    def __enter__(self) -> SimulatedTimeBar:
        return self

    def __exit__(self, *exception: Any) -> None:
        self._bar.close()

    def reached(self, job: Any, seconds: float) -> None:
        """``job`` has simulated ``seconds`` so far; a bed that takes longer than expected stretches the bar."""
        with self._lock:
            self._bar.total += max(0.0, seconds - self._expected[id(job)])
            self._expected[id(job)] = max(seconds, self._expected[id(job)])
            self._bar.update(seconds - self._covered[id(job)])
            self._covered[id(job)] = seconds

    def finished(self, job: Any) -> None:
        """``job`` is done, whoever did it."""
        self.reached(job, self._expected[id(job)])
        with self._lock:
            self._bar.set_postfix_str("", refresh=False)
            self._bar.set_description_str(self._one_more())

    def waits(self, job: Any) -> None:
        """``job`` waits for another process that is making the same file."""
        with self._lock:
            self._bar.set_postfix_str("waiting for another process")

    def _one_more(self) -> str:
        self._done += 1
        return f"data {self._done}/{len(self._expected)} files"
