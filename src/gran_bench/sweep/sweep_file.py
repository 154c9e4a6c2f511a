"""What a sweep is: its name, its jobs, the command that goes on with it; kept in ``sweep.json`` in its folder."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

from gran_bench.files import write_text
from gran_bench.run.run_file import RUNS, SWEEPS, SweepFileError

SWEEP = "sweep.json"
LOGS = "logs"  # folder below a sweep's


@dataclass(frozen=True)
class SweepJob:
    """One job of a sweep.

    Attributes:
        run: name of its run, without the key.
        key: hash of what determines its result; empty where its data could not be made.
        judged_by: hash of what determines its judgement; empty likewise.
        choices: what the command line changed, by key.
        seed: of the run.
    """

    run: str
    key: str
    judged_by: str
    choices: dict[str, str]
    seed: int

    @property
    def file_name(self) -> str:
        """Of the file that it leaves."""
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
        key: hash of what its jobs are; its identity in the tracking store.
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
        write_text(folder / SWEEP, json.dumps(asdict(self), indent=1, ensure_ascii=False) + "\n")
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
    return sorted(path for path in (root / SWEEPS).glob("*") if (path / RUNS).is_dir() or (path / SWEEP).exists())
