"""What a command does once a job: config checked, work done, errors said, here or in a process of its own."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from gran_bench.compose import Source, checked_config, run_folder
from gran_bench.config import TrainConfig
from gran_bench.config.override_errors import explain, is_full_disk
from gran_bench.config.rules import ConfigError
from gran_bench.provenance import remember_command
from gran_bench.provenance.source_digest import go_by
from gran_bench.scene import SceneError
from gran_bench.tracking import HEADLINE, TrackingError

if TYPE_CHECKING:
    from gran_bench.sweep.jobs import Sweep

FAILED, REFUSED = 1, 2  # exit codes


@dataclass
class Task:
    """What runs once, or with ``--multirun`` once a job; plain data, so that it can travel to another process.

    Attributes:
        function: called with the checked config.
        source: of the configs.
        schema: the dataclass that a config must fit.
        typed: first words of the command line.
        sweep: that the job belongs to; None for none.
        failures: of jobs in this process, for whoever started them.
    """

    function: Callable[[Any], object]
    source: Source
    schema: type
    typed: list[str]
    sweep: Sweep | None = None
    failures: list[Exception] = field(default_factory=list)

    def __call__(self, composed: DictConfig) -> None:
        """Do the job that Hydra composed, in this process."""
        settings = HydraConfig.get()
        alone = settings.mode != RunMode.MULTIRUN
        number = 0 if alone else settings.job.num
        try:
            self._do(composed, settings.overrides.task, number, apart=False)
        except Exception as error:
            self.failures.append(error)
            if alone:  # raised from here, Hydra would print a line of its own
                return
            self._complain(error, number, settings.job.override_dirname)
            raise

    def apart(self, overrides: Sequence[str], number: int) -> bool:
        """Do a job of a multirun in this process, which was started for it; whether it did not fail."""
        try:
            with self.source.opened():
                composed = self.source.composed(overrides)
            self._do(composed, overrides, number, apart=True)
        except Exception as error:
            self._complain(error, number, ",".join(overrides))
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
        print(f"error: {self._title(number)}{message}", file=sys.stderr, flush=True)
        if self.sweep is not None:
            self.sweep.failed(number, message, into_log=True)

    def _do(self, composed: DictConfig, overrides: Sequence[str], number: int, apart: bool) -> None:
        if (reason := self.nothing_to_do(number)) is not None:
            print(reason, file=sys.stderr, flush=True)
            return
        remember_command([*self.typed, *overrides])
        if self.sweep is None:
            self.function(self._config(composed, overrides, number))
            return
        sweep, title = self.sweep, self.sweep.title(number)
        go_by(sweep.hashes)
        print(f"{title} starts; log: {sweep.folder / sweep.jobs[number].log_name}", file=sys.stderr, flush=True)
        try:
            with sweep.logged(number, apart):
                try:
                    summary = self.function(self._config(composed, overrides, number))
                except Exception as error:
                    complain(error, self.schema)  # into the log; the terminal hears it from whoever called
                    raise
        except Exception as error:
            if not isinstance(error, TrackingError) or not sweep.finished_unrecorded(number):
                sweep.failed(number, explain(error, self.schema) or f"{type(error).__name__}: {error}")
            raise
        figures = sweep.finished(number, summary).figures
        found = (f"{name[len(HEADLINE) :]} {figures[name]:.3g}" for name in figures if name.startswith(HEADLINE))
        print(f"{title} finished: {', '.join(found)}", file=sys.stderr, flush=True)

    def _config(self, composed: DictConfig, overrides: Sequence[str], number: int) -> Any:
        config = checked_config(composed, self.schema)
        if isinstance(config, TrainConfig):
            if self.sweep is not None:
                config.tracking.folder = self.sweep.jobs[number].run
                config.tracking.parent = self.sweep.parent
            config.tracking.folder = config.tracking.folder or run_folder(config.experiment, overrides)
        return config

    def _complain(self, error: Exception, number: int, words: str) -> None:
        complain(error, self.schema, self._title(number) if self.sweep else f"job {number} ({words}): ")

    def _title(self, number: int) -> str:
        return f"{self.sweep.title(number)}: " if self.sweep else f"job {number}: "


def complain(error: Exception, schema: type, prefix: str = "") -> int:
    """Say an error on stderr, in one line where the house or Hydra foresaw it, and give the exit code."""
    message = explain(error, schema)
    if message is None:
        print(f"error: {prefix}nothing that was foreseen, so here is the whole way to it:", file=sys.stderr)
        traceback.print_exception(error)
        return FAILED
    print(f"error: {prefix}{message}", file=sys.stderr, flush=True)
    house_failure = type(error).__module__.startswith("gran_bench.") and not isinstance(error, ConfigError | SceneError)
    return FAILED if house_failure or is_full_disk(error) else REFUSED
