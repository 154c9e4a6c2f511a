"""What a command does once a job: config checked, work done, errors said, here or in a process of its own."""

import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.errors import MissingConfigException
from hydra.types import RunMode
from omegaconf import DictConfig

from gran_bench.compose import Source, checked_config, run_folder
from gran_bench.config import TrainConfig
from gran_bench.config.override_errors import explain, is_full_disk
from gran_bench.config.rules import ConfigError
from gran_bench.processes import tell
from gran_bench.provenance import command, remember_command
from gran_bench.provenance.source_digest import go_by
from gran_bench.scene import SceneError
from gran_bench.sweep.runs import SweepJob

FAILED, REFUSED = 1, 2  # exit codes
SAID = 3  # exit code of a job's process that failed and said so; Python itself ends with 1
GRACE_SECONDS = 60.0  # for jobs that were asked to stop: an update, a checkpoint, a last word to the store


@dataclass(frozen=True)
class Sweep:
    """What a job needs of its sweep; plain data."""

    folder: Path  # of the sweep, absolute
    jobs: tuple[SweepJob, ...]  # of the sweep, by number
    parent: str | None = None  # id of the parent run; None without tracking
    done: dict[int, str] = field(default_factory=dict)  # why a job has nothing to do, by number
    hashes: dict[str, str] = field(default_factory=dict)  # of the source that the sweep began with
    elsewhere: bool = False  # whether jobs load the source anew, perhaps on other machines
    files_only: bool = False  # whether jobs leave the store alone, because it is a file that machines cannot share
    record: Callable[[int], None] | None = None  # puts a finished job into the store, where jobs do not; not plain

    def title(self, number: int) -> str:
        return f"job {number + 1} of {len(self.jobs)} ({self.jobs[number].run})"

    def log(self, number: int) -> Path:
        return self.folder / self.jobs[number].log_name

    @contextmanager
    def logged(self, number: int) -> Iterator[None]:
        """What the block prints goes into the job's log; the sweep finds there why a job failed."""
        self.log(number).parent.mkdir(parents=True, exist_ok=True)
        with open(self.log(number), "a", buffering=1, encoding="utf-8") as log, ExitStack() as afterwards:
            log.write(f"---- {datetime.now(UTC).isoformat(timespec='seconds')}  process {os.getpid()}  {command()}\n")
            sys.stdout.flush()
            for descriptor in (1, 2):
                afterwards.callback(os.close, terminal := os.dup(descriptor))
                afterwards.callback(os.dup2, terminal, descriptor)
                os.dup2(log.fileno(), descriptor)
            afterwards.callback(sys.stdout.flush)  # where this fails, on a full disk, the rest is done nevertheless
            yield


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
            complain(error, self.schema, self.title(number, settings.job.override_dirname))
            raise

    def apart(self, overrides: Sequence[str], number: int) -> bool:
        """Do a job of a multirun in this process, which was started for it; whether it did not fail."""
        try:
            with self.source.opened():
                composed = self.source.composed(overrides)
            self._do(composed, overrides, number)
        except Exception as error:
            complain(error, self.schema, self.title(number, ",".join(overrides)))
            return False
        return True

    def exit_code(self, overrides: Sequence[str], number: int) -> int:
        """As `apart`: 0, `SAID` or, where the job was stopped, 128 + the signal's number."""
        try:
            return 0 if self.apart(overrides, number) else SAID
        except KeyboardInterrupt as stop:
            return 128 + getattr(signal.Signals, str(stop), signal.SIGINT)
        finally:
            sys.stdout.flush()

    def recorded(self, number: int) -> bool:
        """Record a finished job in the store, where it did not do so itself; whether nothing went wrong."""
        try:
            if self.sweep is not None and self.sweep.record is not None:
                self.sweep.record(number)
        except Exception as error:  # one that stops no other job
            complain(error, self.schema, self.title(number))
            return False
        return True

    def nothing_to_do(self, number: int) -> bool:
        """Whether a job of a sweep need not be started, and why, on stderr."""
        if self.sweep is None or number not in self.sweep.done:
            return False
        tell(f"{self.sweep.title(number)}: {self.sweep.done[number]}")
        return True

    def died(self, number: int, why: str) -> None:
        """Say, in the job's log too, that its process ended without a word."""
        message = f"{why}; the same command goes on from its last checkpoint"
        tell(f"error: {self.title(number)}{message}")
        if self.sweep is not None:
            with suppress(OSError), open(self.sweep.log(number), "a", encoding="utf-8") as log:
                log.write(f"error: {message}\n")

    def _do(self, composed: DictConfig, overrides: Sequence[str], number: int) -> None:
        if self.nothing_to_do(number):
            return
        remember_command([*self.typed, *overrides])
        if self.sweep is None:
            self.function(self._config(composed, overrides, number))
            return
        # Imported here, so that a command that has a typo need not wait for it.
        from gran_bench.run.summary import headline

        if not self.sweep.elsewhere:  # forked from the modules that the sweep began with
            go_by(self.sweep.hashes)
        tell(f"{self.sweep.title(number)} starts; log: {self.sweep.log(number)}")
        with self.sweep.logged(number):
            try:
                summary = self.function(self._config(composed, overrides, number))
            except Exception as error:
                with suppress(OSError):
                    sys.stdout.flush()
                complain(error, self.schema)  # last in the log; the terminal hears it from whoever called
                raise
        found = ", ".join(f"{name} {value:.3g}" for name, value in headline(summary).items())
        tell(f"{self.sweep.title(number)} finished: {found}")

    def _config(self, composed: DictConfig, overrides: Sequence[str], number: int) -> Any:
        config = checked_config(composed, self.schema)
        if isinstance(config, TrainConfig):
            if self.sweep is not None:
                config.tracking.folder = self.sweep.jobs[number].run
                config.tracking.parent = self.sweep.parent
                config.tracking.enabled = config.tracking.enabled and not self.sweep.files_only
            config.tracking.folder = config.tracking.folder or run_folder(config.experiment, overrides)
            if self.sweep is not None and self.sweep.elsewhere:
                _refuse_another(self.sweep.jobs[number], config)
        return config

    def name(self, number: int) -> str:
        """A job's name in the books of a scheduler."""
        return f"job-{number}" if self.sweep is None else self.sweep.jobs[number].run

    def title(self, number: int, words: str = "") -> str:
        """A job as the beginning of a line that is said of it."""
        if self.sweep is not None:
            return f"{self.sweep.title(number)}: "
        return f"job {number} ({words}): " if words else f"job {number}: "


def _refuse_another(job: SweepJob, config: TrainConfig) -> None:
    """Refuse what would be another run than the sweep's, which would never find it."""
    from gran_bench.run.identity import identify

    if job.key and (found := identify(config)) and (found.key, found.judged_by) != (job.key, job.judged_by):
        raise ConfigError(
            f"{job.run}: source or data of this machine are not what the sweep began with; start the same command "
            "again, from one installation that all machines share"
        )


def complain(error: Exception, schema: type, prefix: str = "") -> int:
    """Say an error on stderr, in one line where the house or Hydra foresaw it, and give the exit code."""
    message = explain(error, schema)
    if message is None:
        traceback.print_exception(error)
        tell(f"error: {prefix}{type(error).__name__}: {error}; nobody foresaw it, so the whole way to it is above")
        return FAILED
    if isinstance(error, MissingConfigException) and error.options:
        message += "; own files are found with --config-dir=FOLDER"
    tell(f"error: {prefix}{message}")
    house_failure = type(error).__module__.startswith("gran_bench.") and not isinstance(error, ConfigError | SceneError)
    return FAILED if house_failure or is_full_disk(error) else REFUSED
