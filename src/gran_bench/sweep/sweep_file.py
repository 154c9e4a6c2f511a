"""What a sweep is: its name, its jobs, the command that goes on with it; kept in ``sweep.json`` in its folder."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gran_bench.files import write_text

if TYPE_CHECKING:
    from gran_bench.config import TrainConfig
    from gran_bench.run.identity import RunIdentity

SWEEPS = "sweeps"  # folder below the results
SWEEP = "sweep.json"
TABLE = "runs.csv"  # of the runs that have ended
RUNS = "runs"  # folder below a sweep's: what jobs leave until the table has it
LOGS = "logs"  # folder below a sweep's
KEPT = ("run", "key", "judged_by", "made_with", "choices", "seed")  # of a job, in sweep.json


class SweepFileError(RuntimeError):
    """A file of a sweep that cannot be read; the message names it and the remedy."""


@dataclass(frozen=True)
class SweepJob:
    """One job of a sweep.

    Attributes:
        run: name of its run, without the key.
        choices: what the command line changed, by key.
        seed: of the run.
        key: hash of what determines its result; empty where its data could not be made.
        judged_by: hash of what determines its judgement; empty likewise.
        made_with: hash of code, data, judge and budget: runs that share it may stand in one table.
        config: checked; None where the job was read from a file.
        identity: of its run; None where the data could not be made.
    """

    run: str
    choices: dict[str, str]
    seed: int
    key: str = ""
    judged_by: str = ""
    made_with: str = ""
    config: TrainConfig | None = None
    identity: RunIdentity | None = None

    @property
    def file_name(self) -> str:
        """Of the small file that it leaves."""
        return f"{self.run}-{self.key[:8]}.json"

    @property
    def log_name(self) -> str:
        """Of its log, below the sweep's folder."""
        return f"{LOGS}/{self.run}-{self.key[:8]}.log"


@dataclass(frozen=True)
class SweepFile:
    """A sweep as its folder knows it.

    Attributes:
        name: of the folder.
        key: its identity in the tracking store.
        command: that goes on with it.
        experiment: MLflow experiment that its parent run is in.
        jobs: in the order of their numbers.
    """

    name: str
    key: str
    command: str
    experiment: str
    jobs: list[SweepJob] = field(default_factory=list)

    def write(self, folder: Path) -> Path:
        """Write ``sweep.json``, whole or not at all."""
        jobs = [{name: getattr(job, name) for name in KEPT} for job in self.jobs]
        values: dict[str, Any] = vars(self) | {"jobs": jobs}
        write_text(folder / SWEEP, json.dumps(values, indent=1, ensure_ascii=False) + "\n")
        return folder / SWEEP


def read_sweep(folder: Path) -> SweepFile | None:
    """The sweep of a folder; None where it holds runs alone.

    Raises:
        SweepFileError: the file is no sweep.
    """
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
    return [folder for folder in folders if any((folder / name).exists() for name in (SWEEP, TABLE, RUNS))]
