"""A sweep around its jobs: data made once, finished runs found, parent and children in the store, a report."""

import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from gran_bench import tracking
from gran_bench.config import EmulatorConfig, TrackingConfig
from gran_bench.config.choices import weighed_terms
from gran_bench.config.identity import deciding_keys
from gran_bench.config.registry import MODELS
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import DatasetError, ensure_cases
from gran_bench.files import locked
from gran_bench.processes import stop_on_signals, tell
from gran_bench.provenance import command, commit
from gran_bench.provenance.source_digest import judging_code, taken_hashes, training_code
from gran_bench.run.cost import Cost, data_cost, emulator_cost, flow_cost, training_cost
from gran_bench.run.identity import emulator_plan, hash_of, identify, judging_plan, needed_cases, splits, wants_more
from gran_bench.run.record import Clock, RunRecord
from gran_bench.run.summary import SUMMARY, broken_rollouts, finished_summary, flat_metrics, judged_words
from gran_bench.scene import build_scene
from gran_bench.sweep import runs
from gran_bench.sweep.models_page import compares_models
from gran_bench.sweep.runs import SweepFile, SweepJob, SweepRun, read_runs
from gran_bench.sweep.sweep_report import log_report, report_sweep
from gran_bench.sweep.task import Sweep

KEPT_OF_TRAINING = ("steps", "planned_steps", "seconds", "stopped_by", "loss", "parameters")


class Found(NamedTuple):
    """A finished run of a job: where it is, its row, and what puts it into a store that does not know it."""

    where: str
    row: SweepRun
    record: Callable[[RunRecord], None]


@contextmanager
def open_sweep(planned: Sequence[SweepJob], name: str, elsewhere: bool = False) -> Iterator[Sweep]:
    """Prepare a sweep, named as its folder, let its jobs run in the block, and report.

    Jobs ``elsewhere``, on machines that share its folder, write to a tracking server. A database is a file that such
    machines cannot share safely: without a server they leave files alone, which this process records as each job ends.

    Raises:
        ConfigError, TrackingError, SweepFileError: two jobs are one run; the store fails; a file is damaged.
    """
    _refuse_twins(planned)
    _check_starts(planned)
    config: TrackingConfig = planned[0].config.tracking
    folder = Path(config.root).resolve() / runs.SWEEPS / (config.sweep or name)
    if sweep_cost(planned, folder).tell(planned[0].config.dry_run):
        raise SystemExit(0)
    with stop_on_signals(), locked(folder / ".lock", lambda: tell(f"another process runs {folder}; waiting for it")):
        _make_data(planned)
        jobs = tuple(map(_identified, planned))
        key = hash_of("sweep", folder.name)  # all commands of a folder share its table, so they share its parent
        SweepFile(folder.name, key, command(), config.experiment, list(jobs)).write(folder)
        found = _fill_table(folder, jobs)
        done = {number: f"finished before; {one.where}" for number, one in found.items()}
        tags = {"command": command(), "commit": commit(), tracking.SWEEP_TAG: folder.name}
        with tracking.open_run(config, folder.name, key, _axes(planned), tags) as parent:
            _schedule(jobs, found, parent.run_id)
            files_only = elsewhere and config.enabled and tracking.server_uri() is None
            record = partial(_record_ended, jobs, parent.run_id) if files_only else None
            try:
                yield Sweep(folder, jobs, parent.run_id, done, taken_hashes(), elsewhere, files_only, record)
            finally:
                found = _fill_table(folder, jobs)
                if compares_models(folder) and sys.exc_info()[1] is None:
                    _measure(folder, jobs)
                report = report_sweep(folder)
                for run in report.failed:  # whose own process may not have closed it
                    try:
                        tracking.end_child(config, run.key, run.reason)
                    except tracking.TrackingError as error:  # the report matters more
                        tell(f"{run.run} is not closed in the store: {error}")
                print(report.text, flush=True)
                tell(f"table and figures of the sweep are in {folder}{tracking.how_to_compare(config)}")
                log_report(parent, report)
            parent.finish("FINISHED" if len(found) == len(jobs) else "FAILED")


def _measure(folder: Path, jobs: Sequence[SweepJob]) -> None:
    from gran_bench.sweep.side_by_side import measure  # with the DEM's engine

    try:
        measure(folder, jobs)
    except (RuntimeError, ValueError, OSError) as error:  # the report matters more
        tell(f"not measured side by side: {error}")


def sweep_cost(planned: Sequence[SweepJob], folder: Path) -> Cost:
    """What the unfinished jobs will take, one after another, if each takes as long as the first of them."""
    first, specs = planned[0].config, []
    for job in planned:
        specs += needed_cases(job.config)
    cost = flow_cost(build_scene(first.scene), first.dem)
    cost += data_cost(build_scene(first.scene), first.dem, specs, first.dataset.root, first.dataset.workers)
    jobs = tuple(map(_identified, planned))
    done = _finished(folder, jobs)
    left = [job for number, job in enumerate(jobs) if number not in done]
    cost.lines.append(f"sweep: {len(planned)} jobs in {folder}, {len(left)} of them to do; the first of these:")
    if not left:
        return cost
    if isinstance(left[0].config.model, EmulatorConfig):
        plan = emulator_plan(left[0].config)
        return cost + emulator_cost(left[0].config, plan.training, plan.replicas, len(left))
    from gran_bench.run.experiment import compile_ahead  # it loads PyTorch

    compile_ahead(left[0].config.model.name)
    each = training_cost(left[0].config, judging_plan(left[0].config), splits(left[0].config).training)
    each.seconds = {name: seconds * len(left) for name, seconds in each.seconds.items()}
    return cost + each


def _refuse_twins(planned: Sequence[SweepJob]) -> None:
    """Refuse two jobs that would train the same weights, before any data is made: one run cannot be two rows."""
    first: dict[str, SweepJob] = {}
    for job in planned:
        # Which data a run is trained on follows from its config too.
        twin = first.setdefault(hash_of(deciding_keys(job.config)), job)
        if twin is not job:
            keys = [key for key in sorted(job.choices) if job.choices[key] != twin.choices.get(key)]
            one, other = (" ".join(f"{key}={it.choices.get(key)}" for key in keys) or it.run for it in (twin, job))
            raise ConfigError(
                f"{one} and {other}: two jobs ({job.run}) would train the same weights; give each value once, and "
                "sweep a key where it decides them, by a command with tracking.sweep=NAME "
                "(python -m gran_bench.evaluate judges a model again)"
            )


def _check_starts(planned: Sequence[SweepJob]) -> None:
    """Refuse weights to start from that are not there or do not fit, before any data is made."""
    for config in (job.config for job in planned if job.config.trainer.start_from is not None):
        from gran_bench.run.start_from import start_of  # with PyTorch, which other sweeps load while data are made
        from gran_bench.trainer.start import make_model

        start_of(config).put_into(make_model(config, build_scene(config.scene)), config)


def _make_data(jobs: Sequence[SweepJob]) -> None:
    """Make every run of the DEM that the jobs need and that is not there, so that no two jobs wait for each other."""
    wanted = defaultdict(dict)
    for config in (job.config for job in jobs):
        specs, data = needed_cases(config), config.dataset
        wanted[data.root, data.workers] |= {spec.path(data.root): spec for spec in specs}
    for (root, workers), specs in wanted.items():
        tell(f"data of all jobs: {len(specs)} cases in {root}")
        try:
            ensure_cases(specs.values(), root, workers)
        except DatasetError as error:
            tell(f"the jobs that need it will fail: {error}")


def _identified(job: SweepJob) -> SweepJob:
    """A job with who its run is; without, where its data are not there, which the job will say."""
    try:
        identity = identify(job.config)
    except DatasetError:
        return job
    # The code of every model counts, so that runs of two commands, one for each model, stand in one table.
    code = {model: training_code(model, weighed_terms(job.config.loss)) for model in MODELS}
    made_with = hash_of(code, judging_code(), _budget(job), identity.judged_by, identity.data_digest)
    return replace(job, key=identity.key, judged_by=identity.judged_by, made_with=made_with, identity=identity)


def _fill_table(folder: Path, jobs: Sequence[SweepJob]) -> dict[int, Found]:
    """Renew the rows of jobs that have ended in the table of a sweep; what is finished, by number of the job."""
    rows = {run.log_name: run for run in read_runs(folder)}
    found = _finished(folder, jobs)
    for number, job in enumerate(jobs):
        log = folder / job.log_name
        if number in found:
            rows[job.log_name] = found[number].row
        elif log.exists() and (last := log.read_text("utf-8", "replace").rstrip().split("\n")[-1])[:7] == "error: ":
            rows[job.log_name] = _row(job, log.stat().st_mtime, {}, status=runs.FAILED, reason=last[7:])
    if rows:
        runs.write_runs(folder, rows.values())
    return found


def _finished(folder: Path, jobs: Sequence[SweepJob]) -> dict[int, Found]:
    """What is finished, by number of the job: in this results folder, or by a row of any sweep in it."""
    recorded = defaultdict(list)
    for source in runs.sweep_folders(folder.parent.parent):
        try:
            for run in read_runs(source):
                if run.status == runs.FINISHED:
                    recorded[run.key, run.judged_by].append((source, run))
        except runs.SweepFileError as error:  # which hides no run of another sweep
            tell(f"not looked at: {error}")
    found = {}
    for number, job in ((number, job) for number, job in enumerate(jobs) if job.identity is not None):
        known, summary = recorded[job.key, job.judged_by], finished_summary(job.identity)
        own = next((run for source, run in known if source == folder and run.run == job.run), None)
        if summary is not None and not wants_more(job.config, summary["training"]):
            row, where = finished_row(job, summary), f"its figures and summary are in {job.identity.folder}"
            record = partial(RunRecord.record_again, summary=summary)
        elif known and not wants_more(job.config, known[-1][1].training):
            source, run = known[-1]
            facts = {name: value for name, value in run.facts.items() if name != "log"}  # which is there alone
            facts |= {"copied_from": f"{source.name}, {run.run}"}
            row, where = replace(run, run=job.run, choices=dict(job.choices), facts=facts), f"its row is in {source}"
            record = partial(RunRecord.record_row, figures=run.figures, made=run.facts, source=source)
        else:
            continue
        # Code that decides nothing here may have changed: by now the run is made with what the others are.
        row = own or row
        found[number] = Found(where, replace(row, facts=row.facts | {"made_with": job.made_with}), record)
    return found


def finished_row(job: SweepJob, summary: Mapping[str, Any]) -> SweepRun:
    """What a sweep keeps of a finished job, whose summary is as in ``summary.json``."""
    training = summary["training"]
    facts = {
        "judged": judged_words(summary),
        "broken_rollouts": ", ".join(f"{name} at frame {k}" for name, k in broken_rollouts(summary).items()),
        **{name: training.get(name) for name in ("data_digest", "model_sha256")},
        **summary["provenance"],
    }
    kept = {name: training[name] for name in KEPT_OF_TRAINING if training.get(name) is not None}
    ended = (job.identity.folder / SUMMARY).stat().st_mtime
    return _row(job, ended, facts, training=kept, figures=flat_metrics(summary))


def _budget(job: SweepJob) -> str:
    trainer = job.config.trainer
    return f"{trainer.minutes:g} min" if trainer.budget == "time" else f"{trainer.steps} updates"


def _row(job: SweepJob, ended: float, facts: Mapping[str, str], **found: Any) -> SweepRun:
    facts = {**facts, "log": job.log_name, "made_with": job.made_with}
    facts |= {"model": job.config.model.name, "budget": _budget(job), "scene": job.config.scene.name}
    facts = {name: text for name, text in facts.items() if text}
    ended_at = datetime.fromtimestamp(ended, UTC).isoformat(timespec="seconds")
    who = job.run, dict(job.choices), job.seed, job.key, job.judged_by
    return SweepRun(*who, ended_at=ended_at, facts=facts, **found)


def _axes(planned: Sequence[SweepJob]) -> dict[str, Any]:
    keys = sorted({key for job in planned for key in job.choices})
    values = {key: list(dict.fromkeys(job.choices.get(key, "default") for job in planned)) for key in keys}
    return {"sweep": {key.lstrip("+"): ",".join(v) for key, v in values.items() if len(v) > 1}, "jobs": len(planned)}


def _schedule(jobs: Sequence[SweepJob], found: Mapping[int, Found], parent: str | None) -> None:
    """A run in the store for each job; one that is finished is recorded where the store does not know it."""
    known = {number: job for number, job in enumerate(jobs) if job.identity is not None}
    children = [tracking.Child(job.identity.folder.name, job.key, number in found) for number, job in known.items()]
    missing = tracking.schedule_children(jobs[0].config.tracking, parent, children)
    for number, job in known.items():
        if number in found and job.key in missing:
            found[number].record(_record_of(job, parent))


def _record_ended(jobs: Sequence[SweepJob], parent: str | None, number: int) -> None:
    """Put the run of a job that has finished into the store, from its files."""
    job = jobs[number]
    if job.identity is not None and (summary := finished_summary(job.identity)) is not None:
        _record_of(job, parent).record_again(summary)


def _record_of(job: SweepJob, parent: str | None) -> RunRecord:
    job.config.tracking.parent = parent
    return RunRecord(job.identity, job.config, job.config.scene.name, Clock())
