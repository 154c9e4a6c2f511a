"""Small sweeps that run from their command line, are killed, and are compared by what they have left."""

from __future__ import annotations

import hashlib
import json
import re
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from overrides import override

from gran_bench.processes import kill_group, start_program
from gran_bench.run.record import MODEL
from gran_bench.run.summary import SUMMARY
from gran_bench.surrogate.checkpoint import load_card
from gran_bench.sweep.runs import FINISHED, SWEEPS, read_runs
from gran_bench.tracking.store import DATABASE

SWEEP = "kills"  # name of the sweep
RADII = (0.06, 0.065)  # m
PATIENCE = 900.0  # s, of a sweep that would otherwise be waited for for ever
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
JUDGED = ("judged_rpm", "judged", "nearest_case", "position_error", "data_digest")  # of a summary; no times
# What a run's row says of times, of the machine and of the file that holds the weights, which has times in it.
TIMED_FIGURE = re.compile("wall_seconds/|.*ms_per_frame|.*ms per frame|.*minutes")
UNTIMED_FACTS = ("judged", "broken_rollouts", "data_digest", "made_with", "model", "budget")


def sweep_command(data: Path, jobs: int, launcher: str = "local") -> list[str]:
    """The command line of a sweep of ``jobs`` quick jobs, two at a time where `local` starts them."""
    radii = RADII if jobs % len(RADII) == 0 else RADII[:1]
    seeds = ",".join(str(seed) for seed in range(jobs // len(radii)))
    return [
        *(sys.executable, "-m", "gran_bench.train", "-m", "+experiment=smoke", f"hydra/launcher={launcher}"),
        *("scene.end_time=1.7", "trainer.steps=12", "trainer.checkpoint_steps=2", "threads=1"),
        *("judge.speeds_rpm=[]", "judge.short_horizon_starts=2", override("dataset.root", data.resolve())),
        *(f"model.radius_m={','.join(map(str, radii))}", f"seed={seeds}", f"tracking.sweep={SWEEP}"),
    ]


@contextmanager
def group(command: list[str], folder: Path) -> Iterator[subprocess.Popen]:
    """A command in a process group of its own, which ends with the block; ``said.txt`` gets what it says."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "said.txt", "ab") as said:
        process = start_program(
            command, ENVIRONMENT, cwd=folder, stdin=subprocess.DEVNULL, stdout=said, stderr=said
        )  # fmt: skip
    try:
        yield process
    finally:
        kill_group(process)


def finish(command: list[str], folder: Path) -> None:
    """Run a command to its end, which must be a good one."""
    with group(command, folder) as process:
        assert process.wait(PATIENCE) == 0, (folder / "said.txt").read_text("utf-8", errors="replace")[-3000:]


def kill_at(command: list[str], folder: Path, done: int, after: float) -> None:
    """Start a command, and kill its process group when ``done`` runs are finished and ``after`` seconds have passed.

    Where one more run finishes first, that is the moment.
    """
    with group(command, folder) as process:
        began = time.monotonic()
        while True:
            elapsed, finished = time.monotonic() - began, len(list(folder.glob(f"results/runs/*/{SUMMARY}")))
            if (finished >= done and elapsed >= after) or finished > done:
                break
            assert process.poll() is None, (folder / "said.txt").read_text("utf-8", errors="replace")[-3000:]
            assert elapsed < PATIENCE
            time.sleep(0.01)
        kill_group(process)


def finished_work(folder: Path) -> dict[str, Any]:
    """What finished runs have left, and when: digest and time of their files, and their records in the sweep.

    A run that is done again ends with the same weights and the same key. When its files were written does tell.
    """
    found: dict[str, Any] = {}
    for summary in folder.glob(f"results/runs/*/{SUMMARY}"):
        for path in (summary, summary.parent / MODEL):
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            found[str(path.relative_to(folder))] = (digest, path.stat().st_mtime_ns)
    runs = read_runs(folder / "results" / SWEEPS / SWEEP)
    return found | {f"record of {run.run}": asdict(run) for run in runs if run.status == FINISHED}


def results_of(folder: Path) -> dict[str, dict[str, Any]]:
    """What each run of a sweep found, by its folder's name: hash of its weights, and every figure but times."""
    found = {}
    for path in sorted(folder.glob(f"results/runs/*/{SUMMARY}")):
        _, weights = load_card(path.parent / MODEL)
        digest = hashlib.sha256()
        for name, value in sorted(weights.items()):
            digest.update(name.encode() + value.contiguous().numpy().tobytes())
        summary = json.loads(path.read_text("utf-8"))
        found[path.parent.name] = {"weights": digest.hexdigest(), **{name: summary[name] for name in JUDGED}}
    return found


def records_of(folder: Path) -> dict[str, dict[str, Any]]:
    """What the sweep's record says of each run, by its name; no times."""
    records = {}
    for run in read_runs(folder / "results" / SWEEPS / SWEEP):
        said = asdict(run)
        del said["ended_at"]
        said["training"].pop("seconds", None)
        said["figures"] = {name: value for name, value in run.figures.items() if not TIMED_FIGURE.match(name)}
        said["facts"] = {name: text for name, text in run.facts.items() if name in UNTIMED_FACTS}
        records[run.run] = said
    return records


def stored(root: Path) -> dict[str, tuple[str, str | None]]:
    """Status and parent's name of every run in a store, by name; none is there twice."""
    name = "(select name from runs as parents where run_uuid = tags.value)"
    parent = f"(select {name} from tags where run_uuid = runs.run_uuid and key = 'mlflow.parentRunId')"
    with sqlite3.connect(root / DATABASE) as store:
        rows = store.execute(f"select name, status, {parent} from runs").fetchall()
    assert len({row[0] for row in rows}) == len(rows)
    return {row[0]: row[1:] for row in rows}


def statuses(root: Path) -> list[str]:
    """Of the children, in the order of their names."""
    return [status for _, (status, parent) in sorted(stored(root).items()) if parent is not None]
