"""A sweep around its jobs: data made once, finished runs found, parent and children in the store; at the end a report.

The jobs themselves may run anywhere: what they need of their sweep is plain data (`Sweep`) that travels to them.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TextIO

from gran_bench import tracking
from gran_bench.atomic import locked
from gran_bench.code_identity import MODEL_SOURCES, judging_code, taken_hashes, training_code
from gran_bench.composition import PlannedJob
from gran_bench.config import TrackingConfig, TrainConfig
from gran_bench.config_identity import deciding_keys
from gran_bench.config_rules import ConfigError
from gran_bench.dataset import DatasetError
from gran_bench.provenance import command, commit
from gran_bench.run_identity import RunIdentity, hash_of, identify, judged_by, judging_plan, wants_more
from gran_bench.run_record import Clock, RunRecord, finished_summary, tell
from gran_bench.run_summary import headline
from gran_bench.stopping import stop_on_signals
from gran_bench.sweep.run_file import MADE, SWEEPS, RunFile, failed_run, finished_run, now, read_run, recorded_runs
from gran_bench.sweep.sweep_file import SweepFile, SweepJob
from gran_bench.sweep.sweep_report import SweepReport, log_report, report_sweep
from gran_bench.sweep_data import make_data


@dataclass(frozen=True)
class Sweep:
    """What a job needs of its sweep; plain data.

    Attributes:
        folder: of the sweep, absolute.
        jobs: of the sweep, by number.
        parent: id of the parent run; None without tracking.
        done: why a job has nothing to do, by number.
        hashes: of the source that the sweep began with.
        made_with: model, code and budget, by number: what tells runs that may stand in one table.
    """

    folder: Path
    jobs: tuple[SweepJob, ...]
    parent: str | None = None
    done: dict[int, str] = field(default_factory=dict)
    hashes: dict[str, str] = field(default_factory=dict)
    made_with: tuple[dict[str, Any], ...] = ()

    def title(self, number: int) -> str:
        """A job for people."""
        return f"job {number + 1} of {len(self.jobs)} ({self.jobs[number].run})"

    @contextmanager
    def logged(self, number: int, apart: bool) -> Iterator[None]:
        """What the block prints goes into the job's log; in a process of its own there alone, else beside the terminal.

        Args:
            number: of the job.
            apart: whether this process does nothing else than the job.
        """
        path = self.folder / self.jobs[number].log_name
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "a", buffering=1, encoding="utf-8") as log:
            log.write(f"---- {now()}  process {os.getpid()}  {command()}\n")
            if not apart:
                with redirect_stdout(_Both(sys.stdout, log)), redirect_stderr(_Both(sys.stderr, log)):
                    yield
                return
            sys.stdout.flush()
            terminal = os.dup(1), os.dup(2)
            os.dup2(log.fileno(), 1)
            os.dup2(log.fileno(), 2)
            try:
                yield
            finally:
                sys.stdout.flush()
                for descriptor, saved in enumerate(terminal, start=1):
                    os.dup2(saved, descriptor)
                    os.close(saved)

    def finished(self, number: int, summary: dict[str, Any]) -> RunFile:
        """Keep what a job found."""
        left = _finished(self.jobs[number], summary, self.made_with[number])
        left.write(self.folder)
        return left

    def failed(self, number: int, reason: str) -> None:
        """Keep why a job failed."""
        job = self.jobs[number]
        facts = {"log": job.log_name, MADE: self.made_with[number]}
        left = failed_run(job.run, job.key, job.judged_by, job.choices, job.seed, reason, facts)
        try:
            left.write(self.folder)
        except OSError as error:  # of a full disk, say: the reason stands on the terminal and in the log
            tell(f"{self.title(number)}: its failure could not be kept in {self.folder}: {error}")


class _Both:
    """A stream that writes to the terminal and, line by line, to a log; progress bars are for the terminal alone."""

    def __init__(self, terminal: TextIO, log: TextIO) -> None:
        self._terminal, self._log = terminal, log

    def write(self, text: str) -> int:
        if "\r" not in text:
            self._log.write(text)
        return self._terminal.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._terminal, name)


@contextmanager
def open_sweep(planned: Sequence[PlannedJob], name: str) -> Iterator[Sweep]:
    """Prepare a sweep, let its jobs run in the block, and report.

    Args:
        planned: its jobs, in the order of their numbers.
        name: of its folder, unless the config names one.

    Raises:
        ConfigError: two jobs are the same run.
        TrackingError: the store cannot be opened; or, at the end, something could not be recorded.
        SweepFileError: a file of an earlier sweep is damaged.
    """
    _refuse_twins(planned)
    config: TrackingConfig = planned[0].config.tracking
    root = Path(config.root).resolve()
    folder = root / SWEEPS / (config.sweep or name)
    with stop_on_signals(), locked(folder / ".lock", lambda: tell(f"another process runs {folder}; waiting for it")):
        tell(f"sweep of {len(planned)} jobs in {folder}")
        make_data([job.config for job in planned])
        identities = [_identity(job.config) for job in planned]
        jobs = tuple(_sweep_job(*pair) for pair in zip(planned, identities, strict=True))
        key = hash_of("sweep", folder.name, [job.key or job.run for job in jobs])
        SweepFile(folder.name, key, command(), config.experiment, list(jobs)).write(folder)
        summaries = _finished_here(planned, identities)
        done = _done(root, folder, planned, identities, jobs, summaries)
        made_with = tuple(_made_with(job.config) for job in planned)
        sweep = Sweep(folder, jobs, done=done, hashes=taken_hashes(), made_with=made_with)
        with tracking.open_run(config, folder.name, key, _axes(planned), _tags(folder)) as parent:
            sweep = replace(sweep, parent=parent.run_id)
            _schedule(sweep, planned, identities, summaries)
            try:
                yield sweep
            finally:
                report = _report(sweep, config)
                log_report(parent, report)
            parent.finish("FINISHED" if _whole(sweep, report) else "FAILED")


# ---- before the jobs -------------------------------------------------------------------------------------


def _refuse_twins(planned: Sequence[PlannedJob]) -> None:
    """Refuse two jobs that would be the same run, before any data is made: they would do one run's work twice."""
    first: dict[tuple[str, str], PlannedJob] = {}
    for job in planned:
        # Which data a run is trained on follows from its config too.
        identity = hash_of(deciding_keys(job.config)), judged_by(judging_plan(job.config))
        twin = first.setdefault(identity, job)
        if twin is not job:
            keys = [key for key in sorted(job.choices) if job.choices[key] != twin.choices.get(key)]
            one, other = (" ".join(f"{key}={it.choices.get(key)}" for key in keys) or it.run for it in (twin, job))
            why = f"{' and '.join(keys)} decides nothing there" if keys else "a value is given twice"
            raise ConfigError(
                f"{one} and {other}: two jobs of the sweep ({job.run}) would be the same run, because {why}; leave it "
                "out of this sweep, or sweep it where it decides, by a command of its own with tracking.sweep=NAME"
            )


def _identity(config: TrainConfig) -> RunIdentity | None:
    """Who a run is; None where its data are not there, which its job will say."""
    try:
        return identify(config)
    except DatasetError:
        return None


def _sweep_job(planned: PlannedJob, identity: RunIdentity | None) -> SweepJob:
    key, judge = (identity.key, identity.judged_by) if identity else ("", "")
    return SweepJob(planned.run, key, judge, planned.choices, planned.config.seed)


def _finished_here(
    planned: Sequence[PlannedJob], identities: Sequence[RunIdentity | None]
) -> dict[int, dict[str, Any]]:
    """Summaries of the runs that are finished in this results folder, by number."""
    found = {}
    for number, (job, identity) in enumerate(zip(planned, identities, strict=True)):
        summary = finished_summary(identity) if identity else None
        if summary is not None and not wants_more(job.config, summary["training"]):
            found[number] = summary
    return found


def _done(
    root: Path,
    folder: Path,
    planned: Sequence[PlannedJob],
    identities: Sequence[RunIdentity | None],
    jobs: Sequence[SweepJob],
    summaries: dict[int, dict[str, Any]],
) -> dict[int, str]:
    """Jobs with nothing to do: finished in this results folder, or recorded by any sweep in it. Each has its file."""
    recorded, done = recorded_runs(root), {}
    for number, (job, identity) in enumerate(zip(jobs, identities, strict=True)):
        path = recorded.get((job.key, job.judged_by))
        if number in summaries:
            done[number] = f"finished before; its figures and summary are in {identity.folder}"
            if path != folder / "runs" / job.file_name:
                _finished(job, summaries[number], _made_with(planned[number].config)).write(folder)
        elif path is not None and not wants_more(planned[number].config, read_run(path).training):
            done[number] = f"finished before; its record is {path}"
            replace(read_run(path), run=job.run, choices=job.choices).write(folder)
    return done


def _made_with(config: TrainConfig) -> dict[str, Any]:
    """What has to be the same for runs to stand in one table; the code of every model, for runs of other commands."""
    training, time = config.trainer, config.trainer.budget == "time"
    return {
        "model": config.model.name,
        "training_code": {model: training_code(model) for model in MODEL_SOURCES},
        "judging_code": judging_code(),
        "budget": f"{training.minutes:g} min" if time else f"{training.steps} updates",
    }


def _finished(job: SweepJob, summary: dict[str, Any], made_with: dict[str, Any]) -> RunFile:
    figures = headline(summary)
    left = finished_run(job.run, job.key, job.choices, job.seed, summary, figures["requirements failed"])
    return replace(left, facts=left.facts | {"headline": figures, "log": job.log_name, MADE: made_with})


def _axes(planned: Sequence[PlannedJob]) -> dict[str, Any]:
    """Parameters of the parent run: the values of each swept key."""
    keys = sorted({key for job in planned for key in job.choices})
    values = {key: list(dict.fromkeys(job.choices.get(key, "default") for job in planned)) for key in keys}
    return {"sweep": {key.lstrip("+"): ",".join(v) for key, v in values.items() if len(v) > 1}, "jobs": len(planned)}


def _tags(folder: Path) -> dict[str, str]:
    return {"command": command(), "commit": commit(), tracking.SWEEP_TAG: folder.name}


def _schedule(
    sweep: Sweep,
    planned: Sequence[PlannedJob],
    identities: Sequence[RunIdentity | None],
    summaries: dict[int, dict[str, Any]],
) -> None:
    """A run in the store for each job; one that is finished is recorded where the store does not know it."""
    known = [(number, identity) for number, identity in enumerate(identities) if identity is not None]
    children = [tracking.Child(identity.name, identity.key, number in sweep.done) for number, identity in known]
    missing = tracking.schedule_children(planned[0].config.tracking, sweep.parent, children)
    for number, identity in known:
        if number not in sweep.done or identity.key not in missing:
            continue
        config = planned[number].config
        config.tracking.parent = sweep.parent
        record = RunRecord(identity, config, config.scene.name, Clock())
        if number in summaries:
            record.record_again(summaries[number])
        else:
            with record.opened() as run:
                path = sweep.folder / "runs" / sweep.jobs[number].file_name
                kept = read_run(path)
                figures = {f"{tracking.HEADLINE}{name}": value for name, value in kept.facts["headline"].items()}
                run.log_metrics(figures, supersede=True)
                run.log_artifact(path)


# ---- after the jobs --------------------------------------------------------------------------------------


def _report(sweep: Sweep, config: TrackingConfig) -> SweepReport:
    """Write and print the report, and close the runs whose own process could not."""
    report = report_sweep(sweep.folder)
    for run in report.failed:
        try:
            tracking.end_child(config, run.key, run.reason or "failed")
        except tracking.TrackingError as error:
            tell(f"{run.run} is not closed in the store: {error}")
    print(report.text, flush=True)
    tell(f"table and figures of the sweep are in {sweep.folder}; compare runs with `make ui`")
    return report


def _whole(sweep: Sweep, report: SweepReport) -> bool:
    """Whether every job of this sweep is done; its folder may hold failed runs of others."""
    lost = {run.file_name for run in report.failed} | {job.file_name for job in report.waiting}
    return not any(job.file_name in lost for job in sweep.jobs)
