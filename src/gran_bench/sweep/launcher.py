"""The jobs of a sweep on any machines: which start when, what their ends mean; a back end starts and watches them."""

import importlib.util
import signal
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, ClassVar

from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

from gran_bench.config.reading import read_config
from gran_bench.config.rules import Section
from gran_bench.processes import MissingProgramError, tell
from gran_bench.sweep.task import Task

# Hydra takes only plugins whose names begin with the first word.
PLUGINS = "hydra_plugins.gran_bench"


class JobError(RuntimeError):
    """A job of a multirun failed; what went wrong was said where it happened."""


class JobLauncher(Launcher):
    """Start the jobs of a multirun, ``n_jobs`` at a time; a subclass is a back end, with keys of its own."""

    schema: ClassVar[type[Section]]  # of its keys, with n_jobs among them
    elsewhere: ClassVar[bool] = False  # whether a job may run on another machine

    def __init__(self, **keys: Any) -> None:
        self.config = read_config(self.schema, OmegaConf.to_container(OmegaConf.create(keys)))  # Hydra's lists, too
        self.task: Task | None = None
        self.sweep_dir = Path()

    def check(self) -> None:
        """Refuse, before any work, what cannot be started here."""

    def prepare(self, modules: Sequence[str]) -> None:
        """Get ready, while this process goes on, for jobs that need these modules."""

    def opened(self) -> AbstractContextManager[Any]:
        """What is around all jobs."""
        return nullcontext()

    def start(self, overrides: list[str], number: int) -> Any:
        """Start a job; gives what the other methods know it by."""
        raise NotImplementedError

    def ended(self, running: Mapping[int, Any]) -> dict[int, int | str]:
        """Wait a while, and give those that have ended: 0, `SAID`, or in words why a job ended without saying so."""
        raise NotImplementedError

    def stop(self, running: Mapping[int, Any]) -> None:
        """Ask jobs to stop at a checkpoint, then make them."""
        raise NotImplementedError

    @property
    def folder(self) -> Path:
        """For what a back end keeps."""
        return self.sweep_dir if self.task.sweep is None else self.task.sweep.folder

    def tell(self, number: int, words: str) -> None:
        """Say something of a job of another machine, and where its log is."""
        sweep = self.task.sweep
        tell(f"{self.task.title(number)}{words}{'' if sweep is None else f'; log: {sweep.log(number)}'}")

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self.task, self.sweep_dir = task_function, Path(str(config.hydra.sweep.dir)).resolve()

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run jobs, numbered from the initial one, to their end, whoever fails: a `JobError` then, or a stop."""
        self.sweep_dir.mkdir(parents=True, exist_ok=True)
        jobs = list(enumerate(map(list, job_overrides), initial_job_idx))
        waiting = [(number, overrides) for number, overrides in jobs if not self.task.nothing_to_do(number)]
        running: dict[int, Any] = {}
        failed, at_once = 0, self.config.n_jobs or len(jobs)
        with self.opened():
            try:
                while waiting or running:
                    while waiting and len(running) < at_once:
                        number, overrides = waiting.pop(0)
                        running[number] = self.start(overrides, number)
                    for number, end in self.ended(running).items():
                        del running[number]
                        failed += not self._is_good(number, end)
            except BaseException:  # the jobs stop, too
                self.stop(running)
                raise
        if failed:
            raise JobError(f"{failed} of {len(jobs)} jobs failed")
        return [JobReturn(overrides=overrides, status=JobStatus.COMPLETED) for _, overrides in jobs]

    def _is_good(self, number: int, end: int | str) -> bool:
        if isinstance(end, str):
            self.task.died(number, end)
        elif self.elsewhere:  # or its own process said so here
            self.tell(number, "failed" if end else "done")
        return end == 0 and self.task.recorded(number)


def register(launchers: Sequence[type[JobLauncher]]) -> None:
    """Let Hydra make launchers by the names that ``conf/hydra/launcher/`` gives them."""
    plugins = Plugins.instance()
    for launcher in launchers:
        plugins.register(launcher)
        plugins.class_name_to_class[f"{PLUGINS}.{launcher.__name__}"] = launcher


def chosen(config: DictConfig | None) -> JobLauncher | None:
    """The registered launcher that a composed ``hydra.launcher`` names, its keys checked; None for one of Hydra's.

    Raises:
        ConfigError: a key that is impossible.
    """
    keys = OmegaConf.to_container(config, resolve=True) if config else {}
    maker = Plugins.instance().class_name_to_class.get(keys.pop("_target_", ""), object)
    return maker(**keys) if issubclass(maker, JobLauncher) else None


def require_package(name: str) -> None:
    """Refuse, as a `MissingProgramError`, a launcher whose package of an extra is not installed."""
    extra = {"submitit": "slurm"}.get(name, name)
    if importlib.util.find_spec(name) is None:
        raise MissingProgramError(
            f"hydra/launcher={extra} needs the package {name}, which is not installed; "
            f"pip install 'gran-bench[{extra}]'"
        )


def last_words(code: int, memory: str) -> str:
    """Why a process ended without a word, by its exit code; ``memory`` is what to do for want of memory."""
    memory = f"(often a lack of memory; try {memory})"
    if code < 0:
        return f"its process was ended by signal {-code}{f' {memory}' if code == -signal.SIGKILL else ''}"
    if code - 128 in signal.valid_signals():
        return f"it was stopped by {signal.Signals(code - 128).name}"
    return f"its process ended with status {code}"
