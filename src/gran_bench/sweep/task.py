"""What a command does once a job: config checked, work done, errors said, here or in a forked process of its own."""

import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from multiprocessing import connection, forkserver
from pathlib import Path
from typing import Any

import psutil
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.errors import MissingConfigException
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, RunMode, TaskFunction
from omegaconf import DictConfig

from gran_bench.compose import LAUNCHER, Source, checked_config, run_folder
from gran_bench.config import TrainConfig
from gran_bench.config.override_errors import explain, is_full_disk
from gran_bench.config.rules import ConfigError
from gran_bench.processes import WATCH_SECONDS, tell
from gran_bench.provenance import command, remember_command
from gran_bench.provenance.source_digest import go_by
from gran_bench.scene import SceneError
from gran_bench.sweep.runs import SweepJob

FAILED, REFUSED = 1, 2  # exit codes
SAID = 3  # exit code of a job's process that failed and said so; Python itself ends with 1
LOST = 255  # what `multiprocessing` gives for a job whose fork server, which would know its exit code, is gone
GRACE_SECONDS = 60.0  # for jobs that were asked to stop: an update, a checkpoint, a last word to the store


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

    def nothing_to_do(self, number: int) -> bool:
        """Whether a job of a sweep need not be started, and why, on stderr."""
        if self.sweep is None or number not in self.sweep.done:
            return False
        tell(f"{self.sweep.title(number)}: {self.sweep.done[number]}")
        return True

    def died(self, number: int, why: str) -> None:
        """Say, in the job's log too, that its process ended without a word."""
        message = f"{why}; the same command goes on from its last checkpoint"
        tell(f"error: {self._title(number)}{message}")
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
            config.tracking.folder = config.tracking.folder or run_folder(config.experiment, overrides)
        return config

    def _title(self, number: int, words: str = "") -> str:
        if self.sweep is not None:
            return f"{self.sweep.title(number)}: "
        return f"job {number} ({words}): " if words else f"job {number}: "


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


class JobError(RuntimeError):
    """A job of a multirun failed; what went wrong was said where it happened."""


class ProcessLauncher(Launcher):
    """Start each job in a process of its own, ``n_jobs`` at a time."""

    def __init__(self, n_jobs: int = 2) -> None:
        self.n_jobs = max(1, n_jobs)
        self.task: Task | None = None
        self.sweep_dir = Path()

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self.task, self.sweep_dir = task_function, Path(str(config.hydra.sweep.dir))

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run jobs, numbered from the initial one, to their end, whoever fails: a `JobError` then, or a stop."""
        self.sweep_dir.mkdir(parents=True, exist_ok=True)
        jobs = list(enumerate(map(list, job_overrides), initial_job_idx))
        waiting = [(number, overrides) for number, overrides in jobs if not self.task.nothing_to_do(number)]
        context, running, failed = multiprocessing.get_context("forkserver"), {}, 0
        try:
            while waiting or running:
                while waiting and len(running) < self.n_jobs:
                    number, overrides = waiting.pop(0)
                    process = context.Process(target=_run, args=(self.task, overrides, number))
                    process.start()
                    running[number] = process
                connection.wait([process.sentinel for process in running.values()])
                for number in [number for number, process in running.items() if not process.is_alive()]:
                    process = running.pop(number)
                    if process.exitcode == LOST:  # it ends when it sees that, too
                        with suppress(psutil.Error):
                            psutil.Process(process.pid).wait(GRACE_SECONDS)
                    if process.exitcode not in (0, SAID):
                        self.task.died(number, _last_words(process.exitcode))
                    failed += process.exitcode != 0
        except BaseException:  # the jobs stop, too
            for process in running.values():
                process.terminate()
            for process in running.values():
                process.join(GRACE_SECONDS)
                process.kill()
                process.join()
            raise
        if failed:
            raise JobError(f"{failed} of {len(jobs)} jobs failed")
        return [JobReturn(overrides=overrides, status=JobStatus.COMPLETED) for _, overrides in jobs]


def register_launcher() -> None:
    """Let Hydra make the launcher that ``hydra/launcher=local`` names."""
    plugins = Plugins.instance()
    plugins.register(ProcessLauncher)
    plugins.class_name_to_class[LAUNCHER] = ProcessLauncher


def load_ahead(modules: Sequence[str]) -> None:
    """Start the process that jobs are forked from, and let it load modules while this one goes on."""
    multiprocessing.get_context("forkserver").set_forkserver_preload(["gran_bench.entry", *modules])
    forkserver.ensure_running()


def _run(task: Task, overrides: list[str], number: int) -> None:
    threading.Thread(target=_stop_with, args=(multiprocessing.parent_process(), os.getppid()), daemon=True).start()
    try:
        code = 0 if task.apart(overrides, number) else SAID
    except KeyboardInterrupt as stop:
        code = 128 + getattr(signal.Signals, str(stop), signal.SIGINT)
    sys.stdout.flush()
    sys.exit(code)


def _stop_with(parent: Any, server: int) -> None:
    """Stop politely where a process that this one came from was killed: nobody waits for the job any more."""
    while os.getppid() == server and not connection.wait([parent.sentinel], WATCH_SECONDS):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def _last_words(code: int) -> str:
    memory = "(often a lack of memory; try hydra.launcher.n_jobs=1)"
    if code == LOST:
        return f"the process that jobs are forked from was ended {memory}"
    if code < 0:
        return f"its process was ended by signal {-code}{f' {memory}' if code == -9 else ''}"
    if code - 128 in signal.valid_signals():
        return f"it was stopped by {signal.Signals(code - 128).name}"
    return f"its process ended with status {code}"
