"""What every entry does around its task: Hydra composes, the schema checks, the task runs, errors take one line.

A config that cannot be is refused before Hydra starts a job, so that nothing is computed and no folder is left.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from gran_bench.config import GenerateConfig, TrainConfig
from gran_bench.config_check import read_config
from gran_bench.config_identity import UNDECIDING
from gran_bench.config_rules import ConfigError
from gran_bench.override_errors import explain
from gran_bench.provenance import program, remember_command
from gran_bench.scene import SceneError, build_scene

CONFIG_MODULE = "gran_bench.conf"
VERSION_BASE = "1.3"
FAILED, REFUSED = 1, 2  # exit codes

# Two commands that differ in these alone train the same weights, so they share a folder.
UNNAMED = UNDECIDING | {"hydra"}
LONGEST_FOLDER = 150  # characters; file systems end at 255 bytes

Config = TypeVar("Config")


def run(task: Callable[[Any], object], config_name: str, schema: type) -> NoReturn:
    """Run ``task`` on the config that the command line describes: once, or with ``--multirun`` once a job.

    Ends the process with exit code 0; 1 where the task failed, or a job of a multirun, which stops no other job;
    2 where the config cannot be; 128 + the signal's number after Ctrl-C or SIGTERM. An error that the house foresees
    is one line on stderr.

    Args:
        task: called with the checked config; what it returns is dropped.
        config_name: of the primary config in ``conf/``.
        schema: the dataclass of ``gran_bench.config`` that the config must fit.
    """
    # Makes Hydra raise its errors instead of printing them, also in the processes that a launcher starts.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    arguments = get_args_parser().parse_args()
    multirun = arguments.multirun or "hydra.mode=MULTIRUN" in arguments.overrides
    try:
        if _starts_work(arguments):
            for overrides in distinct_overrides(arguments.overrides, multirun):
                composed = compose(config_name, overrides, arguments.config_dir, arguments.config_path)
                checked_config(composed, schema)
    except Exception as error:
        complain(error, schema)
        sys.exit(FAILED if explain(error, schema) is None else REFUSED)

    failures: list[Exception] = []
    folders = {"--config-dir": arguments.config_dir, "--config-path": arguments.config_path}
    # Found here: a job of a multirun may run in a process that a launcher started.
    typed = [*program(), *(f"{flag}={folder}" for flag, folder in folders.items() if folder is not None)]

    def job(composed: DictConfig) -> None:
        settings = HydraConfig.get()
        try:
            config = checked_config(composed, schema)
            remember_command([*typed, *settings.overrides.task])
            if isinstance(config, TrainConfig):
                name = run_folder(config.experiment, settings.overrides.task)
                config.tracking.folder = config.tracking.folder or name
            task(config)
        except Exception as error:
            if settings.mode == RunMode.MULTIRUN:
                complain(error, schema, f"job {settings.job.num} ({settings.job.override_dirname}): ")
                raise
            failures.append(error)  # handled below: raised from here, Hydra would print a line of its own

    try:
        decorate = hydra.main(config_path=f"pkg://{CONFIG_MODULE}", config_name=config_name, version_base=VERSION_BASE)
        decorate(job)()
    except KeyboardInterrupt as stop:
        number = getattr(signal.Signals, str(stop), signal.SIGINT)
        print(f"stopped by {number.name}; the same command goes on from here", file=sys.stderr)
        sys.exit(128 + number)
    except Exception as error:
        failures.append(error)
    if not failures:
        sys.exit(0)
    if multirun:  # said already, where it happened
        print("error: at least one job of the multirun failed; its message is above", file=sys.stderr)
        sys.exit(FAILED)
    sys.exit(complain(failures[0], schema))


def checked_config(composed: DictConfig, schema: type[Config]) -> Config:
    """The config that Hydra composed, read into ``schema``; its scene can be built, filled and resolved in time.

    Raises:
        ConfigError, SceneError, TimeStepError: what cannot be, in one line.
    """
    values = OmegaConf.to_container(composed, resolve=True)
    assert isinstance(values, dict)
    config = read_config(schema, values)
    if isinstance(config, TrainConfig | GenerateConfig):
        # Imported here, so that a typo need not wait for SciPy.
        from gran_bench.dem.time_step import choose_time_step

        scene = build_scene(config.scene)
        scene.fresh_filling(seed=0)
        data = config.dataset
        if scene.takes_speeds:
            speeds = data.training_speeds_rpm + data.validation_speeds_rpm + data.holdout_speeds_rpm
            scene = scene.at_speed(max(speeds, default=0.0))
        choose_time_step(scene, config.dem.time_step, config.dem.allow_unsafe_step)
    return config


def compose(
    config_name: str, overrides: Sequence[str], config_dir: str | None = None, config_path: str | None = None
) -> DictConfig:
    """What Hydra composes for one job, without starting it.

    Args:
        config_name: of the primary config.
        overrides: as on the command line, without sweeps.
        config_dir: a folder that is searched before the package's (``--config-dir``).
        config_path: a folder that is searched instead of the package's (``--config-path``).
    """
    if config_path is not None and "://" not in config_path:
        start = hydra.initialize_config_dir(str(Path(config_path).resolve()), version_base=VERSION_BASE)
    else:
        start = hydra.initialize_config_module(CONFIG_MODULE, version_base=VERSION_BASE)
    search = [f"hydra.searchpath=[file://{Path(config_dir).resolve()}]"] if config_dir is not None else []
    with start:
        return hydra.compose(config_name, [*overrides, *search])


def distinct_overrides(overrides: Sequence[str], multirun: bool) -> Iterator[list[str]]:
    """The command lines that show every value of every sweep at least once.

    Not their product: a value that cannot be is found all the same, and the product may be long.
    """
    if not multirun:
        yield list(overrides)
        return
    choices = []
    for line, override in zip(overrides, OverridesParser.create().parse_overrides(list(overrides)), strict=True):
        if not override.is_sweep_override():
            choices.append([line])
        elif override.is_discrete_sweep():
            key = line.partition("=")[0]
            choices.append([f"{key}={value}" for value in override.sweep_string_iterator()])
        # A continuous range has no first value; what its sweeper draws is checked in the job.
    first = [values[0] for values in choices]
    yield first
    for i, values in enumerate(choices):
        for value in values[1:]:
            yield [*first[:i], value, *first[i + 1 :]]


def run_folder(experiment: str, overrides: Sequence[str]) -> str:
    """The folder of a run: the recipe's name, then what was changed in it, so that no two different runs share one."""
    changed = sorted(
        line.lstrip("+~")
        for line in overrides
        if not any(re.match(rf"{re.escape(key)}(?=[=./@]|$)", line.lstrip("+~")) for key in UNNAMED)
    )
    # Only letters that a path in a Hydra override may have without quotes.
    name = re.sub(r"[^\w.+-]", "_", "+".join([experiment, *changed]).replace("=", "-"))
    if len(name) > LONGEST_FOLDER:
        digest = hashlib.sha256(name.encode()).hexdigest()[:8]
        name = f"{name[: LONGEST_FOLDER - 9]}-{digest}"
    return name


def complain(error: Exception, schema: type, prefix: str = "") -> int:
    """Say an error on stderr, in one line where the house or Hydra foresaw it, and give the exit code."""
    message = explain(error, schema)
    if message is None:
        print(f"error: {prefix}nothing that was foreseen, so here is the whole way to it:", file=sys.stderr)
        traceback.print_exception(error)
        return FAILED
    print(f"error: {prefix}{message}", file=sys.stderr)
    house_failure = type(error).__module__.startswith("gran_bench.") and not isinstance(error, ConfigError | SceneError)
    return FAILED if house_failure else REFUSED


def _starts_work(arguments: argparse.Namespace) -> bool:
    """Whether the command runs jobs, instead of showing something about them."""
    shows = (arguments.help, arguments.hydra_help, arguments.cfg, arguments.info is not None)
    return not any((*shows, arguments.shell_completion, arguments.experimental_rerun))
