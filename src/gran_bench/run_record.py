"""One run: its folder, its key, its place in the tracking store, its clock and its logged losses."""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from gran_bench import tracking
from gran_bench.atomic import locked, write_atomically, write_text
from gran_bench.config import EvaluateConfig, TrainConfig
from gran_bench.provenance import code_digest, provenance
from gran_bench.report import read_summary, summary_table, write_summary

CONFIG = "config.json"
CLOCK = "clock.json"
TRACKED = "tracked"  # subfolder of the summary that the store gets; the run's own is written when the store is done


@dataclass(frozen=True)
class RunRecord:
    """What a run is called and what determines it.

    Attributes:
        folder: of its files.
        key: hash of what determines the result of its training; the run's identity in the tracking store.
        judged_by: hash of what determines its judgement; a finished run is judged anew where it has changed.
        config: of the command.
        scene_name: for people.
        data_digest: of the training data.
        clock: wall time of its stages.
    """

    folder: Path
    key: str
    judged_by: str
    config: TrainConfig | EvaluateConfig
    scene_name: str
    data_digest: str
    clock: Clock

    def carry_out(
        self, work: Callable[[tracking.Run], dict[str, Any]], outgrown: Callable[[dict[str, Any]], bool]
    ) -> dict[str, Any]:
        """Do the work in the run's own folder and tracked run, unless it is finished; print the summary.

        Args:
            work: gets the open run; returns the summary.
            outgrown: gets the summary of a finished run; whether the command now asks for more than that.

        Raises:
            TrackingError: the tracking store failed; the summary was written and printed nevertheless.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with locked(self.folder / ".lock", lambda: tell(f"another process works on {self.folder}; waiting for it")):
            for leftover in self.folder.rglob(".*.tmp"):
                leftover.unlink()
            finished = read_summary(self.folder)
            if finished is not None and finished["judged_by"] == self.judged_by and not outgrown(finished):
                return self._say_again(finished)
            summary, failure = self._tracked(work)
            if summary is not None:
                # Last of all: its presence says that the run is finished.
                write_summary(self.folder, summary)
                print(summary_table(summary))
                tell(f"figures and summary in {self.folder}; compare runs with `make ui`")
            if failure is not None:
                raise failure
        return summary

    def _tracked(
        self, work: Callable[[tracking.Run], dict[str, Any]]
    ) -> tuple[dict[str, Any] | None, tracking.TrackingError | None]:
        """The summary of the work, and what the tracking store failed at; a store must not cost a result."""
        summary = None
        self.clock.keep_in(self.folder / CLOCK)
        write_text(self.folder / CONFIG, json.dumps(asdict(self.config), indent=1) + "\n")
        tags = {"data_digest": self.data_digest, "scene": self.scene_name, "folder": str(self.folder), **provenance()}
        # Where a run is kept differs from run to run and decides nothing: as a parameter it would head each comparison.
        params = {name: value for name, value in asdict(self.config).items() if name != "tracking"}
        try:
            with tracking.open_run(self.config.tracking, self.folder.name, self.key, params, tags) as run:
                run.log_dataset(self.scene_name, self.data_digest, str(Path(self.config.dataset.root).resolve()))
                summary = {"judged_by": self.judged_by, **work(run)}
                run.log_artifact(write_summary(self.folder / TRACKED, summary))
        except tracking.TrackingError as failure:
            return summary, failure
        return summary, None

    def _say_again(self, summary: dict[str, Any]) -> dict[str, Any]:
        """A finished run prints its summary again, and says where the code has changed since."""
        print(summary_table(summary))
        tell(f"this run was finished before; its figures and summary are in {self.folder}")
        if {summary["provenance"]["code_digest"], summary["training"]["code_digest"]} != {code_digest()}:
            tell(f"the code has changed since; to run it anew, move {self.folder} away")
        return summary


class Clock:
    """Wall seconds of each stage, by name, across resumes."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._path: Path | None = None

    def keep_in(self, path: Path) -> None:
        """Go on from the times in a file, and keep them there from now on."""
        earlier = json.loads(path.read_text("utf-8")) if path.exists() else {}
        self._path = path
        for name, seconds in earlier.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        self._write()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the block under ``name``; what a killed process spent in an unfinished stage is not known."""
        began = time.monotonic()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - began
            self._write()

    def _write(self) -> None:
        if self._path is not None:
            write_text(self._path, json.dumps(self.seconds) + "\n")


class LossLog:
    """The logged losses of a training as a CSV file that survives any interruption.

    Args:
        path: of the file; rows that are there are kept.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[dict[str, float]] = pd.read_csv(path).to_dict("records") if path.exists() else []

    def add(self, metrics: dict[str, float], step: int) -> None:
        """Append one row and rewrite the file whole."""
        self.rows.append({"step": step} | metrics)
        table = pd.DataFrame(self.rows)
        write_atomically(self.path, lambda file: table.to_csv(file, index=False))

    def drop_after(self, step: int) -> None:
        """Forget rows of updates that a resumed training will do again."""
        self.rows = [row for row in self.rows if row["step"] <= step]


def hash_of(*values: Any) -> str:
    """12 hex digits of the SHA-256 of plain values."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]


def tell(line: str) -> None:
    """One line of progress, on stderr, so that stdout holds the table alone."""
    print(line, file=sys.stderr, flush=True)
