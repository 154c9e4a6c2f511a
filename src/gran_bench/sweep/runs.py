"""The table of a sweep's runs: who each was, what came out, or why nothing did; one row a run in ``runs.csv``.

A job that ends leaves a small file below ``runs/``, because jobs run beside each other and no two may write to one
file. The sweep folds these files into its table. The table is enough to make page and figures anew and to know that a
run need not be done again, on a machine that has nothing else of it.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from gran_bench.config import TrainConfig
from gran_bench.files import write_text
from gran_bench.run.page import judged_words
from gran_bench.run.summary import broken_rollouts, flat_metrics
from gran_bench.sweep.sweep_file import RUNS, TABLE, SweepFileError, SweepJob, sweep_folders

FINISHED, FAILED = "finished", "failed"
KEPT_OF_TRAINING = ("steps", "planned_steps", "seconds", "stopped_by", "loss", "parameters")
TEXTS = ("run", "key", "judged_by", "status", "ended_at", "reason")  # columns that every row has, beside the seed
CHOICE, TRAINING = "choice.", "training."  # beginnings of columns; a name with a / in it is a figure's


@dataclass(frozen=True)
class SweepRun:
    """A run of a sweep that has ended.

    Attributes:
        run: name, as of its folder and its MLflow run, without the key.
        key: hash of what determines its training.
        judged_by: hash of what determines its judgement.
        status: ``finished`` or ``failed``.
        choices: what the command line changed, by key (``model.radius``: ``0.08``), the seed included.
        seed: of weights and windows.
        ended_at: ISO 8601, UTC.
        reason: why it failed; else empty.
        training: updates done and planned, seconds, what stopped it, last loss, parameters, as in ``training.json``.
        figures: by their names in MLflow; an undefined one is absent.
        facts: in words: on what it was judged, rollouts that broke down, model, budget, code, data, provenance.
    """

    run: str
    key: str
    judged_by: str
    status: str
    choices: dict[str, str]
    seed: int
    ended_at: str = ""
    reason: str = ""
    training: dict[str, Any] = field(default_factory=dict)
    figures: dict[str, float] = field(default_factory=dict)
    facts: dict[str, str] = field(default_factory=dict)

    @property
    def file_name(self) -> str:
        """Of its small file: the run's name and the first digits of its key."""
        return f"{self.run}-{self.key[:8]}.json"

    def write(self, folder: Path) -> Path:
        """Write the small file into a sweep's folder, whole or not at all; an older one of the same run is replaced."""
        path = folder / RUNS / self.file_name
        write_text(path, json.dumps(asdict(self), indent=1, ensure_ascii=False, allow_nan=False) + "\n")
        return path


# ---- what a job leaves -----------------------------------------------------------------------------------


def finished_run(job: SweepJob, summary: Mapping[str, Any]) -> SweepRun:
    """What a finished job leaves.

    Args:
        job: of the sweep.
        summary: of its run, as in ``summary.json``.
    """
    training = summary["training"]
    facts = {
        "judged": judged_words(summary),
        "broken_rollouts": ", ".join(f"{name} at frame {k}" for name, k in broken_rollouts(summary).items()),
        **{name: training.get(name) for name in ("data_digest", "model_sha256")},
        **summary["provenance"],
        **_made(job),
    }
    return replace(
        _ended(job, FINISHED),
        judged_by=summary["judged_by"],
        training={name: training[name] for name in KEPT_OF_TRAINING if training.get(name) is not None},
        figures=flat_metrics(summary),
        facts={name: text for name, text in facts.items() if text},
    )


def failed_run(job: SweepJob, reason: str) -> SweepRun:
    """What a failed job leaves: who it was, and why."""
    return replace(_ended(job, FAILED), reason=reason, facts=_made(job))


def _ended(job: SweepJob, status: str) -> SweepRun:
    return SweepRun(job.run, job.key, job.judged_by, status, dict(job.choices), job.seed, now())


def _made(job: SweepJob) -> dict[str, str]:
    made = {"log": job.log_name, "made_with": job.made_with}
    if job.config is not None:
        made |= {"model": job.config.model.name, "budget": budget_of(job.config)}
    return made


def budget_of(config: TrainConfig) -> str:
    """What ends a training, in words."""
    trainer = config.trainer
    return f"{trainer.minutes:g} min" if trainer.budget == "time" else f"{trainer.steps} updates"


def copied_run(run: SweepRun, job: SweepJob, source: Path) -> SweepRun:
    """What a sweep keeps of a run that another one did.

    Args:
        run: as the other sweep kept it.
        job: of this sweep.
        source: folder of the other sweep, with the log.
    """
    facts = {name: value for name, value in run.facts.items() if name != "log"}
    return replace(
        run, run=job.run, choices=dict(job.choices), facts=facts | {"copied_from": f"{source.name}, {run.run}"}
    )


# ---- the table -------------------------------------------------------------------------------------------


def read_runs(folder: Path) -> list[SweepRun]:
    """The runs of a sweep that have ended, by name: of its table, and of what the table has not yet.

    Raises:
        SweepFileError: a file is no run of a sweep, or no table.
    """
    left = []
    for path in sorted((folder / RUNS).glob("*.json")):
        try:
            left.append(SweepRun(**json.loads(path.read_text("utf-8"))))
        except FileNotFoundError:  # folded meanwhile: the table, which is read after it, has it
            continue
        except (ValueError, TypeError) as error:
            raise SweepFileError(f"{path} is no file of a sweep's run ({error}); delete it or restore it") from error
    found = {run.file_name: run for run in [*_read_table(folder / TABLE), *left]}
    return [found[name] for name in sorted(found)]


def fold_runs(folder: Path) -> None:
    """Put what jobs have left into the table; the caller holds the sweep, so that no other does so at the time.

    Raises:
        SweepFileError: as for `read_runs`.
    """
    files, runs = list((folder / RUNS).glob("*.json")), read_runs(folder)
    if runs:
        write_runs(folder, runs)
    for path in files:
        path.unlink()


def write_runs(folder: Path, runs: list[SweepRun]) -> Path:
    """Write the table of runs, whole or not at all."""
    rows = [_cells(run) for run in runs]
    columns = [name for part in zip(*rows, strict=True) for name in dict.fromkeys(name for row in part for name in row)]
    text = io.StringIO()
    table = csv.DictWriter(text, columns, lineterminator="\n")
    table.writeheader()
    for row in rows:
        table.writerow({name: value for part in row for name, value in part.items()})
    write_text(folder / TABLE, text.getvalue())
    return folder / TABLE


def _cells(run: SweepRun) -> tuple[dict[str, Any], ...]:
    """The cells of a row by column, in parts that stand beside each other."""
    return (
        {name: getattr(run, name) for name in ("run", "key", "judged_by", "status", "seed", "ended_at", "reason")},
        {f"{CHOICE}{key}": value or "''" for key, value in run.choices.items()},  # an empty cell is no choice
        {f"{TRAINING}{name}": value for name, value in run.training.items()},
        run.figures,
        run.facts,
    )


def _read_table(path: Path) -> list[SweepRun]:
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
    cells = {name: text for name, text in row.items() if text != ""}

    def part(beginning: str) -> dict[str, str]:
        return {name.removeprefix(beginning): text for name, text in cells.items() if name.startswith(beginning)}

    others = {name: text for name, text in cells.items() if not name.startswith((CHOICE, TRAINING))}
    return SweepRun(
        **texts,
        seed=seed,
        choices=part(CHOICE),
        training={name: text if name == "stopped_by" else json.loads(text) for name, text in part(TRAINING).items()},
        figures={name: float(text) for name, text in others.items() if "/" in name},
        facts={name: text for name, text in others.items() if "/" not in name},
    )


def recorded_runs(root: Path) -> tuple[dict[tuple[str, str], list[tuple[Path, SweepRun]]], list[SweepFileError]]:
    """Each finished run below a results folder with the folders of the sweeps that have it, by ``(key, judged_by)``.

    Returns:
        The runs, and what could not be read: a damaged file of one sweep stops no other.
    """
    found: dict[tuple[str, str], list[tuple[Path, SweepRun]]] = {}
    damaged = []
    for folder in sweep_folders(root):
        try:
            for run in read_runs(folder):
                if run.status == FINISHED:
                    found.setdefault((run.key, run.judged_by), []).append((folder, run))
        except SweepFileError as error:
            damaged.append(error)
    return found, damaged


def now() -> str:
    """This moment, UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")
