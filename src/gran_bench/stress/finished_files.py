"""What the runs of a sweep have finished, and what of it was done again, though it needed not be.

A finished run that is trained again ends with the same weights and, in the store, under the same key: neither the
results nor the store tell. When its files were written does.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gran_bench.run.record import MODEL
from gran_bench.run.run_file import FINISHED, RUNS, SWEEPS, RunFile, read_run, read_runs
from gran_bench.run.summary import SUMMARY

# What a run's file says of times, of the machine and of the file that holds the weights, which has times in it.
TIMED = {
    "figures": ("ms_per_frame", "training_minutes"),
    "training": ("seconds",),
    "facts": ("wall_seconds", "dem_ms_per_frame", "model_sha256", "provenance"),
}
TIMED_HEADLINES = ("rollout ms per frame", "training minutes")


@dataclass(frozen=True)
class Written:
    """A file that a finished run has left.

    Attributes:
        run: its name.
        digest: SHA-256.
        at: when it was written, ns.
    """

    run: str
    digest: str
    at: int


def finished_files(results: Path) -> dict[Path, Written]:
    """The weights, the summary and the sweep's record of every finished run below a results folder."""
    found = {}
    for summary in sorted(results.glob(f"runs/*/{SUMMARY}")):
        found |= {path: _written(path, summary.parent.name) for path in (summary, summary.parent / MODEL)}
    for path in sorted(results.glob(f"{SWEEPS}/*/{RUNS}/*.json")):
        record = read_run(path)
        if record.status == FINISHED:
            found[path] = _written(path, record.run)
    return found


def done_again(before: Mapping[Path, Written], after: Mapping[Path, Written]) -> list[str]:
    """What became of files that were finished, a line for each that is not as it was.

    Args:
        before: as each was when it was first seen.
        after: all of them at the end.
    """
    told = []
    for path, first in before.items():
        if (last := after.get(path)) is None:
            told.append(f"{first.run}: {path.name} was finished and is gone")
        elif last.digest != first.digest:
            told.append(f"{first.run}: {path.name} was finished and has changed")
        elif last.at != first.at:
            told.append(f"{first.run}: {path.name} was finished and is written again, with the same content")
    return told


def records_of(sweep: Path) -> dict[str, dict[str, Any]]:
    """What the record of each run in a sweep's folder says, by the run's name; no times."""
    return {record.run: _timeless(record) for record in read_runs(sweep)}


def _timeless(record: RunFile) -> dict[str, Any]:
    said = asdict(record)
    del said["ended_at"]
    for part, names in TIMED.items():
        said[part] = {name: value for name, value in said[part].items() if name not in names}
    headline = said["facts"].get("headline", {})
    said["facts"]["headline"] = {name: value for name, value in headline.items() if name not in TIMED_HEADLINES}
    return said


def _written(path: Path, run: str) -> Written:
    return Written(run, hashlib.sha256(path.read_bytes()).hexdigest(), path.stat().st_mtime_ns)
