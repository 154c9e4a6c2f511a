"""The files of a sweep: its jobs in ``sweep.json``, its runs that have ended in ``runs.csv``; they make all pages."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gran_bench.files import write_text

if TYPE_CHECKING:
    from gran_bench.config import TrainConfig
    from gran_bench.run.identity import RunIdentity

SWEEPS = "sweeps"  # folder below the results
SWEEP, TABLE, LOGS = "sweep.json", "runs.csv", "logs"  # in the folder of a sweep
FINISHED, FAILED = "finished", "failed"
TEXTS = ("run", "key", "judged_by", "status", "ended_at", "reason")  # columns that every row has, beside the seed
CHOICE, TRAINING = "choice.", "training."  # beginnings of columns; a name with a / in it is a figure's


class SweepFileError(RuntimeError):
    """A file of a sweep that cannot be read; the message names it and the remedy."""


@dataclass(frozen=True)
class Planned:
    """A run of a sweep as it is known before it starts."""

    run: str  # name, as of its folder and its MLflow run, without the key
    choices: dict[str, str]  # what the command line changed, by key (``model.radius``: ``0.08``), the seed included
    seed: int  # of weights and windows
    key: str = ""  # hash of what determines its training; empty where its data could not be made
    judged_by: str = ""  # hash of what determines its judgement; empty likewise

    @property
    def choice(self) -> tuple[object, ...]:
        """What tells the run from the others of its sweep."""
        return tuple(sorted(self.choices.items())), self.seed

    @property
    def whole(self) -> tuple[object, ...]:  # with what determines training and judgement
        return self.choice, self.key, self.judged_by

    @property
    def log_name(self) -> str:
        """Its log, below the sweep's folder; no other run of the sweep has it."""
        return f"{LOGS}/{self.run}-{self.key[:8]}.log"


@dataclass(frozen=True)
class SweepJob(Planned):
    """One job of a sweep."""

    made_with: str = ""  # hash of code, data, judge and budget: runs that share it may stand in one table
    config: TrainConfig | None = None  # checked; None where the job was read from a file
    identity: RunIdentity | None = None  # of its run; None where the data could not be made


@dataclass(frozen=True)
class SweepRun(Planned):
    """A run of a sweep that has ended."""

    status: str = FINISHED  # ``finished`` or ``failed``
    ended_at: str = ""  # ISO 8601, UTC
    reason: str = ""  # why it failed; else empty
    training: dict[str, Any] = field(default_factory=dict)  # updates, seconds, loss, …, as in ``training.json``
    figures: dict[str, float] = field(default_factory=dict)  # by their names in MLflow; an undefined one is absent
    # In words: on what it was judged, rollouts that broke down, model, budget, code, data, provenance.
    facts: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class SweepFile:
    """A sweep as its folder knows it."""

    name: str  # of the folder
    key: str  # its identity in the tracking store
    command: str  # that goes on with it
    experiment: str  # MLflow experiment that its parent run is in
    jobs: list[SweepJob] = field(default_factory=list)  # of its last command, in the order of their numbers

    def write(self, folder: Path) -> None:
        """Write ``sweep.json``, whole or not at all."""
        kept = [entry.name for entry in fields(SweepJob) if entry.name not in ("config", "identity")]
        values = vars(self) | {"jobs": [{name: getattr(job, name) for name in kept} for job in self.jobs]}
        write_text(folder / SWEEP, json.dumps(values, indent=1, ensure_ascii=False) + "\n")


def read_sweep(folder: Path) -> SweepFile | None:
    """The sweep of a folder; None where it holds runs alone; a `SweepFileError` where the file is damaged."""
    path = folder / SWEEP
    if not path.exists():
        return None
    try:
        values = json.loads(path.read_text("utf-8"))
        return SweepFile(**values | {"jobs": [SweepJob(**job) for job in values["jobs"]]})
    except (ValueError, TypeError, KeyError) as error:
        raise SweepFileError(f"{path} is no file of a sweep ({error}); delete it or restore it") from error


def sweep_folders(root: Path) -> list[Path]:
    """The folders of all sweeps below a results folder."""
    folders = sorted((root / SWEEPS).glob("*"))
    return [folder for folder in folders if any((folder / name).exists() for name in (SWEEP, TABLE))]


def write_runs(folder: Path, runs: Iterable[SweepRun]) -> Path:
    """Write the table of a sweep's runs, by name, whole or not at all."""
    rows = [
        (  # parts of a row that stand beside each other
            {name: getattr(run, name) for name in ("run", "key", "judged_by", "status", "seed", "ended_at", "reason")},
            {f"{CHOICE}{key}": value or "''" for key, value in run.choices.items()},  # an empty cell is no choice
            {f"{TRAINING}{name}": value for name, value in run.training.items()},
            run.figures,
            run.facts,
        )
        for run in sorted(runs, key=lambda run: (run.run, run.key))
    ]
    columns = [name for part in zip(*rows, strict=True) for name in dict.fromkeys(name for row in part for name in row)]
    text = io.StringIO()
    table = csv.DictWriter(text, columns, lineterminator="\n")
    table.writeheader()
    table.writerows({name: value for part in row for name, value in part.items()} for row in rows)
    write_text(folder / TABLE, text.getvalue())
    return folder / TABLE


def read_runs(folder: Path) -> list[SweepRun]:
    """The runs of a sweep that its table has, by name; a `SweepFileError` where the table is damaged."""
    path = folder / TABLE
    if not path.exists():
        return []
    try:
        with open(path, newline="", encoding="utf-8") as file:
            return [_run_of(row) for row in csv.DictReader(file, strict=True)]
    except (ValueError, TypeError, KeyError, AttributeError, csv.Error) as error:
        raise SweepFileError(f"{path} is no table of a sweep's runs ({error}); delete it or restore it") from error


def _run_of(row: dict[str, str]) -> SweepRun:
    if None in row.values():
        raise ValueError("a row is too short")
    texts, seed = {name: row.pop(name) for name in TEXTS}, int(row.pop("seed"))
    parts: dict[str, dict[str, Any]] = {"choices": {}, "training": {}, "figures": {}, "facts": {}}
    for name, text in row.items():
        if text == "":
            continue
        if name.startswith(CHOICE):
            parts["choices"][name.removeprefix(CHOICE)] = text
        elif name.startswith(TRAINING):
            name = name.removeprefix(TRAINING)
            parts["training"][name] = text if name == "stopped_by" else json.loads(text)
        elif "/" in name:
            parts["figures"][name] = float(text)
        else:
            parts["facts"][name] = text
    return SweepRun(**texts, seed=seed, **parts)
