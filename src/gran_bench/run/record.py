"""One run: its place in the tracking store, its clock and its logged losses."""

from __future__ import annotations

import json
import math
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
from gran_bench.processes import tell
from gran_bench.provenance import command, provenance
from gran_bench.run.identity import RunIdentity
from gran_bench.run.summary import (
    FIGURES,
    finished_summary,
    judged_tags,
    params_of,
    record_judgement,
    summary_table,
    write_summary,
)
from gran_bench.surrogate.checkpoint import MODEL
from gran_bench.tracking.search import CONFIG

TRAINING, LOSSES, CLOCK = "training.json", "losses.csv", "clock.json"
TRACKED = "tracked"  # subfolder of the summary that the store gets; the run's own is written when the store is done


@dataclass(frozen=True)
class RunRecord:
    """A planned or finished run: who it is, the config of its command, the scene for people, and its times."""

    identity: RunIdentity
    config: TrainConfig | EvaluateConfig
    scene_name: str
    clock: Clock

    def carry_out(
        self, work: Callable[[tracking.Run], dict[str, Any]], outgrown: Callable[[dict[str, Any]], bool]
    ) -> dict[str, Any]:
        """Do the work, which gives a summary, in the run's folder and tracked run; print the summary.

        A finished run is not done again, unless the command has outgrown it. Where the tracking store fails, the
        summary is written and printed nevertheless, before the `TrackingError`.
        """
        folder, summary, failure = self.identity.folder, None, None
        folder.mkdir(parents=True, exist_ok=True)
        with locked(folder / ".lock", lambda: tell(f"another process works on {folder}; waiting for it")):
            for leftover in folder.rglob(".*.tmp"):
                leftover.unlink()
            finished = finished_summary(self.identity)
            if finished is not None and not outgrown(finished):
                print(summary_table(finished))
                tell(f"this run was finished before; its figures and summary are in {folder}")
                return finished
            self.clock.keep_in(folder / CLOCK)
            write_text(folder / CONFIG, json.dumps(asdict(self.config), indent=1) + "\n")
            try:
                with self._opened() as run:
                    summary = {"judged_by": self.identity.judged_by, **work(run)}
                    run.log_artifact(write_summary(folder / TRACKED, summary))
            except tracking.TrackingError as error:  # which must not cost a result
                failure = error
            if summary is not None:
                # Last of all: its presence says that the run is finished.
                write_summary(folder, summary)
                print(summary_table(summary))
                tell(f"figures and summary in {folder}{tracking.how_to_compare(self.config.tracking)}")
            if failure is not None:
                raise failure
        return summary

    @contextmanager
    def _opened(self, made: Mapping[str, str] | None = None) -> Iterator[tracking.Run]:
        """The run in the tracking store; ``made`` is the provenance of one that is recorded again."""
        config, identity = self.config, self.identity
        tags = {"data_digest": identity.data_digest, "scene": self.scene_name, "folder": str(identity.folder)}
        tags |= provenance() if made is None else {**made, "recorded_again_by": command()}
        settings, parent = config.tracking, config.tracking.parent
        with tracking.open_run(settings, identity.folder.name, identity.key, params_of(config), tags, parent) as run:
            run.log_dataset(self.scene_name, identity.data_digest, str(Path(config.dataset.root).resolve()))
            yield run

    def record_again(self, summary: dict[str, Any]) -> None:
        """Put a finished run into a tracking store that does not know it, from the files in its folder."""
        folder = self.identity.folder
        with self._opened(summary["provenance"]) as run:
            for row in LossLog(folder / LOSSES).rows:
                run.log_metrics(training_metrics(row), int(row["step"]))
            if (folder / MODEL).exists():
                run.log_artifact(folder / MODEL, "model")
            record_judgement(run, summary, folder, sorted((folder / FIGURES).glob("*")))
            run.log_artifact(write_summary(folder / TRACKED, summary))

    def record_row(self, figures: Mapping[str, float], made: Mapping[str, str], source: Path) -> None:
        """Put a run, of which nothing is here but a row of a sweep's table, into a store that does not know it."""
        with self._opened(made) as run:
            run.set_tag("folder", f"made elsewhere; what is here of it: a row in {source}")
            for name, text in judged_tags(made["judged"], figures[f"{tracking.HEADLINE}requirements failed"]).items():
                run.set_tag(name, text)
            run.log_metrics(figures, supersede=True)


def training_metrics(row: dict[str, float]) -> dict[str, float]:
    """Logged losses by their names in the tracking store."""
    return {f"training/{name}": value for name, value in row.items() if name != "step" and math.isfinite(value)}


class Clock:
    """Wall seconds of each stage, by name, across resumes."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._path: Path | None = None

    def keep_in(self, path: Path) -> None:
        earlier = json.loads(path.read_text("utf-8")) if path.exists() else {}
        self._path = path
        for name in {**earlier, **self.seconds}:
            self._add(name, earlier.get(name, 0.0))

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the block under ``name``; what a killed process spent in an unfinished stage is not known."""
        began = time.monotonic()
        try:
            yield
        finally:
            self._add(name, time.monotonic() - began)

    def _add(self, name: str, seconds: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        if self._path is not None:
            write_text(self._path, json.dumps(self.seconds) + "\n")


class LossLog:
    """The logged losses of a training as a CSV file, whose rows are kept, that survives any interruption."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[dict[str, float]] = pd.read_csv(path).to_dict("records") if path.exists() else []

    def add(self, metrics: dict[str, float], step: int) -> None:
        self.rows.append({"step": step} | metrics)
        table = pd.DataFrame(self.rows)
        write_atomically(self.path, lambda file: table.to_csv(file, index=False))

    def drop_after(self, step: int) -> None:
        self.rows = [row for row in self.rows if row["step"] <= step]
