"""A sweep around its jobs: data made once, finished runs found, parent and children in the store; at the end a report.

The jobs themselves may run anywhere: what they need of their sweep is plain data (`jobs`) that travels to them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from gran_bench import tracking
from gran_bench.compose import PlannedJob
from gran_bench.config import TrackingConfig, TrainConfig
from gran_bench.config.choices import weighed_terms
from gran_bench.config.identity import telling_keys
from gran_bench.config.reading import validate
from gran_bench.config.registry import MODELS
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import DatasetError
from gran_bench.files import locked
from gran_bench.processes import stop_on_signals
from gran_bench.provenance import command, commit
from gran_bench.provenance.source_digest import judging_code, taken_hashes, training_code
from gran_bench.run.identity import RunIdentity, hash_of, identify, judged_by, judging_plan, wants_more
from gran_bench.run.record import finished_summary, tell
from gran_bench.run.run_file import RUNS, SWEEPS, copied_run, read_run, recorded_runs
from gran_bench.sweep.data import make_data
from gran_bench.sweep.jobs import Sweep, finished_file
from gran_bench.sweep.records import schedule_jobs, settle_runs
from gran_bench.sweep.sweep_file import SweepFile, SweepJob
from gran_bench.sweep.sweep_report import SweepReport, log_report, report_sweep


@contextmanager
def open_sweep(planned: Sequence[PlannedJob], name: str) -> Iterator[Sweep]:
    """Prepare a sweep, let its jobs run in the block, and report.

    Args:
        planned: its jobs, in the order of their numbers.
        name: of its folder, unless the config names one.

    Raises:
        ConfigError: two jobs are the same run, or a value that none can have.
        TrackingError: the store cannot be opened; or, at the end, something could not be recorded.
        SweepFileError: a file of an earlier sweep is damaged.
    """
    for job in planned:
        validate(job.config)
    _refuse_twins(planned)
    config: TrackingConfig = planned[0].config.tracking
    root = Path(config.root).resolve()
    folder = root / SWEEPS / (config.sweep or name)
    with stop_on_signals(), locked(folder / ".lock", lambda: tell(f"another process runs {folder}; waiting for it")):
        tell(f"sweep of {len(planned)} jobs in {folder}")
        make_data([job.config for job in planned])
        identities = [_identity(job.config) for job in planned]
        jobs = tuple(_sweep_job(*pair) for pair in zip(planned, identities, strict=True))
        key = hash_of("sweep", folder.name)  # all commands of a folder share its table, so they share its parent
        SweepFile(folder.name, key, command(), config.experiment, list(jobs)).write(folder)
        summaries = _finished_here(planned, identities)
        done = _done(root, folder, planned, identities, jobs, summaries)
        made_with = tuple(_made_with(job.config) for job in planned)
        sweep = Sweep(folder, jobs, done=done, hashes=taken_hashes(), made_with=made_with)
        with tracking.open_run(config, folder.name, key, _axes(planned), _tags(folder)) as parent:
            sweep = replace(sweep, parent=parent.run_id)
            schedule_jobs(sweep, planned, identities, summaries)
            try:
                yield sweep
            finally:
                report = _report(sweep, config)
                log_report(parent, report)
            parent.finish("FINISHED" if _whole(sweep, report) else "FAILED")


# ---- before the jobs -------------------------------------------------------------------------------------


def _refuse_twins(planned: Sequence[PlannedJob]) -> None:
    """Refuse two jobs that would train the same weights, before any data is made: one run cannot be two rows."""
    first: dict[str, PlannedJob] = {}
    for job in planned:
        # Which data a run is trained on follows from its config too.
        twin = first.setdefault(hash_of(telling_keys(job.config)), job)
        if twin is job:
            continue
        keys = [key for key in sorted(job.choices) if job.choices[key] != twin.choices.get(key)]
        one, other = (" ".join(f"{key}={it.choices.get(key)}" for key in keys) or it.run for it in (twin, job))
        if judged_by(judging_plan(job.config)) != judged_by(judging_plan(twin.config)):
            why = f"{' and '.join(keys)} only decides how it is judged; leave it out of this sweep, and judge what was"
            why += " trained by `python -m gran_bench.evaluate` as often as you like"
        else:
            why = f"{' and '.join(keys)} decides nothing there" if keys else "a value is given twice"
            why += "; leave it out of this sweep, or sweep it where it decides, by a command of its own with "
            why += "tracking.sweep=NAME"
        raise ConfigError(f"{one} and {other}: two jobs of the sweep ({job.run}) would be the same run, because {why}")


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
    recorded, damaged = recorded_runs(root)
    for error in damaged:
        tell(f"not looked at: {error}")
    done = {}
    for number, (job, identity) in enumerate(zip(jobs, identities, strict=True)):
        own, files = folder / RUNS / job.file_name, recorded.get((job.key, job.judged_by), [])
        if number in summaries:
            done[number] = f"finished before; its figures and summary are in {identity.folder}"
            if own not in files:
                finished_file(job, summaries[number], _made_with(planned[number].config)).write(folder)
        elif files and not wants_more(planned[number].config, read_run(files[-1]).training):
            path = own if own in files else files[-1]
            done[number] = f"finished before; its record is {path}"
            if own not in files:
                copied_run(read_run(path), job.run, job.choices, path).write(folder)
    return done


def _made_with(config: TrainConfig) -> dict[str, Any]:
    """What has to be the same for runs to stand in one table; the code of every model, for runs of other commands."""
    training, time = config.trainer, config.trainer.budget == "time"
    return {
        "model": config.model.name,
        "training_code": {model: training_code(model, weighed_terms(config.loss)) for model in MODELS},
        "judging_code": judging_code(),
        "budget": f"{training.minutes:g} min" if time else f"{training.steps} updates",
    }


def _axes(planned: Sequence[PlannedJob]) -> dict[str, Any]:
    """Parameters of the parent run: the values of each swept key."""
    keys = sorted({key for job in planned for key in job.choices})
    values = {key: list(dict.fromkeys(job.choices.get(key, "default") for job in planned)) for key in keys}
    return {"sweep": {key.lstrip("+"): ",".join(v) for key, v in values.items() if len(v) > 1}, "jobs": len(planned)}


def _tags(folder: Path) -> dict[str, str]:
    return {"command": command(), "commit": commit(), tracking.SWEEP_TAG: folder.name}


# ---- after the jobs --------------------------------------------------------------------------------------


def _report(sweep: Sweep, config: TrackingConfig) -> SweepReport:
    """Write and print the report, and close the runs whose own process could not."""
    report = report_sweep(sweep.folder)
    settle_runs(config, sweep.parent, report.failed)
    print(report.text, flush=True)
    tell(f"table and figures of the sweep are in {sweep.folder}{tracking.how_to_compare(config)}")
    return report


def _whole(sweep: Sweep, report: SweepReport) -> bool:
    """Whether every job of this sweep is done; its folder may hold failed runs of others."""
    lost = {run.file_name for run in report.failed} | {job.file_name for job in report.waiting}
    return not any(job.file_name in lost for job in sweep.jobs)
