"""What a command does once a job: config checked, work done, errors said, here or in a process of its own."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from gran_bench.compose import Source, checked_config, run_folder
from gran_bench.config import TrainConfig
from gran_bench.config.override_errors import explain, is_full_disk
from gran_bench.config.rules import ConfigError
from gran_bench.provenance import command, remember_command
from gran_bench.provenance.source_digest import go_by
from gran_bench.scene import SceneError
from gran_bench.sweep import runs
from gran_bench.sweep.runs import SweepJob, SweepRun, now
from gran_bench.tracking import HEADLINE, TrackingError

FAILED, REFUSED = 1, 2  # exit codes
KEPT_OF_TRAINING = ("steps", "planned_steps", "seconds", "stopped_by", "loss", "parameters")


@dataclass(frozen=True)
class Sweep:
    """What a job needs of its sweep; plain data."""

    folder: Path  # of the sweep, absolute
    jobs: tuple[SweepJob, ...]  # of the sweep, by number
    parent: str | None = None  # id of the parent run; None without tracking
    done: dict[int, str] = field(default_factory=dict)  # why a job has nothing to do, by number
    hashes: dict[str, str] = field(default_factory=dict)  # of the source that the sweep began with

    def title(self, number: int) -> str:
        return f"job {number + 1} of {len(self.jobs)} ({self.jobs[number].run})"

    @contextmanager
    def logged(self, number: int) -> Iterator[None]:
        """What the block prints goes into the job's log."""
        path = self.folder / self.jobs[number].log_name
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "a", buffering=1, encoding="utf-8") as log, ExitStack() as afterwards:
            log.write(f"---- {now()}  process {os.getpid()}  {command()}\n")
            sys.stdout.flush()
            for descriptor in (1, 2):
                afterwards.callback(os.close, terminal := os.dup(descriptor))
                afterwards.callback(os.dup2, terminal, descriptor)
                os.dup2(log.fileno(), descriptor)
            afterwards.callback(sys.stdout.flush)  # where this fails, on a full disk, the rest is done nevertheless
            yield

    def finished(self, number: int, summary: Mapping[str, Any]) -> SweepRun:
        left = finished_run(self.jobs[number], summary)
        left.write(self.folder)
        return left

    def failed(self, number: int, reason: str) -> None:
        job = self.jobs[number]
        try:
            failed_run(job, reason).write(self.folder)
        except OSError as error:  # of a full disk, say: the reason stands on the terminal and in the log
            _tell(f"{self.title(number)}: its failure could not be kept in {self.folder}: {error}")


def finished_run(job: SweepJob, summary: Mapping[str, Any]) -> SweepRun:
    """What a finished job leaves; ``summary`` as in ``summary.json``."""
    # Imported here, so that a command that has a typo need not wait for it.
    from gran_bench.run.summary import broken_rollouts, flat_metrics, judged_words

    training = summary["training"]
    facts = {
        "judged": judged_words(summary),
        "broken_rollouts": ", ".join(f"{name} at frame {k}" for name, k in broken_rollouts(summary).items()),
        **{name: training.get(name) for name in ("data_digest", "model_sha256")},
        **summary["provenance"],
    }
    found = {
        "training": {name: training[name] for name in KEPT_OF_TRAINING if training.get(name) is not None},
        "figures": flat_metrics(summary),
    }
    return _ended(job, facts, judged_by=summary["judged_by"], **found)


def failed_run(job: SweepJob, reason: str) -> SweepRun:
    """What a failed job leaves: who it was, and why."""
    return _ended(job, {}, status=runs.FAILED, reason=reason)


def _ended(job: SweepJob, facts: Mapping[str, str], **found: Any) -> SweepRun:
    facts = {**facts, "log": job.log_name, "made_with": job.made_with}
    if job.config is not None:
        facts |= {"model": job.config.model.name, "budget": budget_of(job.config)}
    who = {"run": job.run, "choices": dict(job.choices), "seed": job.seed, "key": job.key, "judged_by": job.judged_by}
    return SweepRun(**who | found, ended_at=now(), facts={name: text for name, text in facts.items() if text})


def budget_of(config: TrainConfig) -> str:
    """What ends a training, in words."""
    trainer = config.trainer
    return f"{trainer.minutes:g} min" if trainer.budget == "time" else f"{trainer.steps} updates"


@dataclass
class Task:
    """What runs once, or with ``--multirun`` once a job; plain data, so that it can travel to another process."""

    function: Callable[[Any], object]  # called with the checked config
    source: Source  # of the configs
    schema: type  # the dataclass that a config must fit
    typed: list[str]  # first words of the command line
    sweep: Sweep | None = None  # that the job belongs to; None for none
    failures: list[Exception] = field(default_factory=list)  # of jobs in this process, for whoever started them

    def __call__(self, composed: DictConfig) -> None:
        """Do the job that Hydra composed, in this process."""
        settings = HydraConfig.get()
        alone = settings.mode != RunMode.MULTIRUN
        number = 0 if alone else settings.job.num
        try:
            self._do(composed, settings.overrides.task, number)
        except Exception as error:
            self.failures.append(error)
            if alone:  # raised from here, Hydra would print a line of its own
                return
            complain(error, self.schema, self._title(number, settings.job.override_dirname))
            raise

    def apart(self, overrides: Sequence[str], number: int) -> bool:
        """Do a job of a multirun in this process, which was started for it; whether it did not fail."""
        try:
            with self.source.opened():
                composed = self.source.composed(overrides)
            self._do(composed, overrides, number)
        except Exception as error:
            complain(error, self.schema, self._title(number, ",".join(overrides)))
            return False
        return True

    def nothing_to_do(self, number: int) -> str | None:
        """Why a job of a sweep need not be started; None where it must."""
        if self.sweep is None or number not in self.sweep.done:
            return None
        return f"{self.sweep.title(number)}: {self.sweep.done[number]}"

    def died(self, number: int, why: str) -> None:
        """Note that a job's process ended without a word."""
        message = f"{why}; the same command goes on from its last checkpoint"
        _tell(f"error: {self._title(number)}{message}")
        if self.sweep is not None:
            log = self.sweep.folder / self.sweep.jobs[number].log_name
            with suppress(OSError), open(log, "a", encoding="utf-8") as file:
                file.write(f"error: {message}\n")
            self.sweep.failed(number, message)

    def _do(self, composed: DictConfig, overrides: Sequence[str], number: int) -> None:
        if (reason := self.nothing_to_do(number)) is not None:
            _tell(reason)
            return
        remember_command([*self.typed, *overrides])
        if self.sweep is None:
            self.function(self._config(composed, overrides, number))
            return
        sweep, title = self.sweep, self.sweep.title(number)
        go_by(sweep.hashes)
        _tell(f"{title} starts; log: {sweep.folder / sweep.jobs[number].log_name}")
        try:
            with sweep.logged(number):
                try:
                    summary = self.function(self._config(composed, overrides, number))
                except Exception as error:
                    complain(error, self.schema)  # into the log; the terminal hears it from whoever called
                    raise
        except Exception as error:
            # The tracking store fails last: what the job found may be whole.
            if isinstance(error, TrackingError) and (summary := _summary_of(sweep.jobs[number])) is not None:
                sweep.finished(number, summary)
            else:
                sweep.failed(number, explain(error, self.schema) or f"{type(error).__name__}: {error}")
            raise
        figures = sweep.finished(number, summary).figures
        found = (f"{name[len(HEADLINE) :]} {figures[name]:.3g}" for name in figures if name.startswith(HEADLINE))
        _tell(f"{title} finished: {', '.join(found)}")

    def _config(self, composed: DictConfig, overrides: Sequence[str], number: int) -> Any:
        config = checked_config(composed, self.schema)
        if isinstance(config, TrainConfig):
            if self.sweep is not None:
                config.tracking.folder = self.sweep.jobs[number].run
                config.tracking.parent = self.sweep.parent
            config.tracking.folder = config.tracking.folder or run_folder(config.experiment, overrides)
        return config

    def _title(self, number: int, words: str = "") -> str:
        if self.sweep is not None:
            return f"{self.sweep.title(number)}: "
        return f"job {number} ({words}): " if words else f"job {number}: "


def _summary_of(job: SweepJob) -> dict[str, Any] | None:
    from gran_bench.run.summary import finished_summary

    return None if job.identity is None else finished_summary(job.identity)


def complain(error: Exception, schema: type, prefix: str = "") -> int:
    """Say an error on stderr, in one line where the house or Hydra foresaw it, and give the exit code."""
    message = explain(error, schema)
    if message is None:
        print(f"error: {prefix}nothing that was foreseen, so here is the whole way to it:", file=sys.stderr)
        traceback.print_exception(error)
        return FAILED
    _tell(f"error: {prefix}{message}")
    house_failure = type(error).__module__.startswith("gran_bench.") and not isinstance(error, ConfigError | SceneError)
    return FAILED if house_failure or is_full_disk(error) else REFUSED


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
