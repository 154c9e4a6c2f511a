"""Several processes at once: two on one data set, eight on one tracking store."""

from __future__ import annotations

import sqlite3
import subprocess
import time
from pathlib import Path

from gran_bench.dataset import read_case
from gran_bench.stress import victim
from gran_bench.stress.expectation import Observation
from gran_bench.stress.experiment import Bench, Experiment
from gran_bench.stress.kills import PATIENCE
from gran_bench.stress.tiny import tiny_specs


def two_on_one_dataset(bench: Bench, processes: int = 2, seconds: float = 1.0) -> Observation:
    """Processes that want the same cases at the same time: each is made once, and all find the same data.

    Args:
        processes: how many.
        seconds: of rotation of each case.
    """
    root, specs = bench.folder / "data", tiny_specs(seconds=seconds)
    crew = [victim.launch("data", root=str(root), workers=1, seconds=seconds) for _ in range(processes)]
    made: dict[Path, set[int]] = {}
    deadline = time.monotonic() + PATIENCE
    while any(process.poll() is None for process in crew) and time.monotonic() < deadline:
        _look(root, made)
        time.sleep(0.005)
    _look(root, made)
    failed = _failed(crew)
    digests = {read_case(spec.path(root)).digest for spec in specs}
    again = sum(len(versions) - 1 for versions in made.values())
    return Observation(
        {"made_again": float(again), "failed": float(len(failed)), "cases": float(len(digests))}, tuple(failed)
    )


def _look(root: Path, made: dict[Path, set[int]]) -> None:
    """Notes which file carries which final name: one that is made twice is another file."""
    for path in root.rglob("*.h5"):
        if not path.name.startswith("."):
            made.setdefault(path, set()).add(path.stat().st_mtime_ns)


def _failed(crew: list[subprocess.Popen[str]]) -> list[str]:
    """What the processes that did not end well said last."""
    told = []
    for process in crew:
        try:
            _, errors = process.communicate(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            _, errors = process.communicate()
        if process.returncode:
            told.append(f"exit code {process.returncode}: {' '.join(errors.strip().splitlines()[-1:])}")
    return told


def one_tracking_store(bench: Bench, jobs: int = 8, steps: int = 10) -> Observation:
    """Jobs that open one tracking store at the same moment, the first time it is opened, and all record.

    Args:
        jobs: processes.
        steps: recorded by each, each step on its own.
    """
    root, gate = bench.folder / "results", bench.folder / "gate"
    root.mkdir()
    crew = [
        victim.start("tracking", root=str(root), number=number, steps=steps, gate=str(gate)) for number in range(jobs)
    ]
    gate.touch()
    warned = []
    failed = []
    for process in crew:
        _, errors = process.communicate(timeout=PATIENCE)
        warned += [line for line in errors.splitlines() if "locked" in line or line.startswith("warning:")]
        if process.returncode:
            failed.append(f"exit code {process.returncode}: {' '.join(errors.strip().splitlines()[-1:])}")
    with sqlite3.connect(f"{(root / 'mlflow.db').resolve().as_uri()}?mode=ro", uri=True) as store:
        finished = store.execute("select count(*) from runs where status = 'FINISHED'").fetchone()[0]
        points = store.execute("select count(*) from metrics").fetchone()[0]
    return Observation(
        {
            "runs": float(finished), "points": float(points), "failed": float(len(failed)),
            "complaints": float(len(warned)),
        },
        tuple(failed + warned[:3]),
    )  # fmt: skip


SHARING = {
    "two_on_one_dataset": Experiment(
        two_on_one_dataset, {"made_again": "files", "failed": "processes", "cases": "cases"}, alone=True
    ),
    "one_tracking_store": Experiment(
        one_tracking_store,
        {"runs": "runs", "points": "points", "failed": "processes", "complaints": "complaints"},
        alone=True,
    ),
}
