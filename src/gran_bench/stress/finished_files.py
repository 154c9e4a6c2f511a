"""What the runs of a sweep have finished, and what of it was done again, though it needed not be.

A finished run that is trained again ends with the same weights and, in the store, under the same key: neither the
results nor the store tell. When its files were written does.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gran_bench.run.record import MODEL
from gran_bench.run.summary import SUMMARY
from gran_bench.sweep.runs import SweepRun, read_runs

# What a run's row says of times, of the machine and of the file that holds the weights, which has times in it.
TIMED_TRAINING = ("seconds",)
TIMED_FIGURE = re.compile("wall_seconds/|.*ms_per_frame|.*ms per frame|.*minutes")
UNTIMED_FACTS = ("judged", "broken_rollouts", "data_digest", "made_with", "model", "budget")


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
    """The weights and the summary of every finished run below a results folder."""
    found = {}
    for summary in sorted(results.glob(f"runs/*/{SUMMARY}")):
        found |= {path: _written(path, summary.parent.name) for path in (summary, summary.parent / MODEL)}
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


def _timeless(record: SweepRun) -> dict[str, Any]:
    said = asdict(record)
    del said["ended_at"]
    said["training"] = {name: value for name, value in record.training.items() if name not in TIMED_TRAINING}
    said["figures"] = {name: value for name, value in record.figures.items() if not TIMED_FIGURE.match(name)}
    said["facts"] = {name: text for name, text in record.facts.items() if name in UNTIMED_FACTS}
    return said


def _written(path: Path, run: str) -> Written:
    return Written(run, hashlib.sha256(path.read_bytes()).hexdigest(), path.stat().st_mtime_ns)
