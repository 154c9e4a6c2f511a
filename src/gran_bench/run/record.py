"""One run: its folder, its key, its place in the tracking store, its clock and its logged losses."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from gran_bench import tracking
from gran_bench.config import EvaluateConfig, TrainConfig
from gran_bench.files import locked, write_atomically, write_text
from gran_bench.provenance import command, provenance
from gran_bench.run.identity import RunIdentity
from gran_bench.run.page import FIGURES, params_of, record_judgement
from gran_bench.run.summary import read_summary, summary_table, write_summary
from gran_bench.surrogate.checkpoint import MODEL

TRAINING = "training.json"
LOSSES = "losses.csv"
CONFIG = "config.json"
CLOCK = "clock.json"
TRACKED = "tracked"  # subfolder of the summary that the store gets; the run's own is written when the store is done


@dataclass(frozen=True)
class RunRecord:
    """A planned or finished run: its identity, the config of its command, and its times.

    Attributes:
        identity: its folder, and what determines it; the key is its identity in the tracking store.
        config: of the command.
        scene_name: for people.
        clock: wall time of its stages.
    """

    identity: RunIdentity
    config: TrainConfig | EvaluateConfig
    scene_name: str
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
        folder = self.identity.folder
        folder.mkdir(parents=True, exist_ok=True)
        with locked(folder / ".lock", lambda: tell(f"another process works on {folder}; waiting for it")):
            for leftover in folder.rglob(".*.tmp"):
                leftover.unlink()
            finished = finished_summary(self.identity)
            if finished is not None and not outgrown(finished):
                print(summary_table(finished))
                tell(f"this run was finished before; its figures and summary are in {folder}")
                return finished
            summary, failure = self._tracked(work)
            if summary is not None:
                # Last of all: its presence says that the run is finished.
                write_summary(folder, summary)
                print(summary_table(summary))
                tell(f"figures and summary in {folder}{tracking.how_to_compare(self.config.tracking)}")
            if failure is not None:
                raise failure
        return summary

    def _tracked(
        self, work: Callable[[tracking.Run], dict[str, Any]]
    ) -> tuple[dict[str, Any] | None, tracking.TrackingError | None]:
        """The summary of the work, and what the tracking store failed at; a store must not cost a result."""
        summary, identity = None, self.identity
        self.clock.keep_in(identity.folder / CLOCK)
        write_text(identity.folder / CONFIG, json.dumps(asdict(self.config), indent=1) + "\n")
        try:
            with self.opened() as run:
                summary = {"judged_by": identity.judged_by, **work(run)}
                run.log_artifact(write_summary(identity.folder / TRACKED, summary))
        except tracking.TrackingError as failure:
            return summary, failure
        return summary, None

    @contextmanager
    def opened(self, made: Mapping[str, str] | None = None) -> Iterator[tracking.Run]:
        """The run in the tracking store, open, with what it was made from.

        Args:
            made: provenance of a run that is recorded again; None for one that this process makes.
        """
        config, digest = self.config, self.identity.data_digest
        identity, parent = self.identity, config.tracking.parent
        tags = {"data_digest": digest, "scene": self.scene_name, "folder": str(identity.folder)}
        tags |= provenance() if made is None else {**made, "recorded_again_by": command()}
        with tracking.open_run(config.tracking, identity.name, identity.key, params_of(config), tags, parent) as run:
            run.log_dataset(self.scene_name, digest, str(Path(config.dataset.root).resolve()))
            yield run

    def record_again(self, summary: dict[str, Any]) -> None:
        """Put a finished run into a tracking store that does not know it, from the files in its folder.

        Raises:
            TrackingError: the store does not take it.
        """
        folder = self.identity.folder
        with self.opened(summary["provenance"]) as run:
            if (folder / LOSSES).exists():
                for row in pd.read_csv(folder / LOSSES).to_dict("records"):
                    run.log_metrics(training_metrics(row), int(row["step"]))
            if (folder / MODEL).exists():
                run.log_artifact(folder / MODEL, "model")
            record_judgement(run, summary, folder, sorted((folder / FIGURES).glob("*")))
            run.log_artifact(write_summary(folder / TRACKED, summary))

    def record_row(self, figures: Mapping[str, float], made: Mapping[str, str], source: Path) -> None:
        """Put a run into a tracking store that does not know it, of which nothing is here but a row of a sweep's table.

        Args:
            figures: by their names in the store.
            made: provenance.
            source: folder of the sweep.

        Raises:
            TrackingError: the store does not take it.
        """
        with self.opened(made) as run:
            run.set_tag("folder", f"made elsewhere; what is here of it: a row in {source}")
            run.log_metrics(figures, supersede=True)


def finished_summary(identity: RunIdentity) -> dict[str, Any] | None:
    """The summary of a run that is finished and judged as it would be now, else None."""
    summary = read_summary(identity.folder)
    return summary if summary is not None and summary["judged_by"] == identity.judged_by else None


def training_metrics(row: dict[str, float]) -> dict[str, float]:
    """Logged losses by their names in the tracking store."""
    return {f"training/{name}": value for name, value in row.items() if name != "step" and math.isfinite(value)}


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


def tell(line: str) -> None:
    """One line of progress, on stderr, so that stdout holds the table alone."""
    print(line, file=sys.stderr, flush=True)
