"""What every entry does around its task: Hydra composes, the schema checks, the task runs, errors take one line."""

import os
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pkgutil import resolve_name
from typing import Any, NoReturn

import hydra
from hydra._internal.utils import get_args_parser

from gran_bench import compose
from gran_bench.config.override_errors import explain
from gran_bench.config.registry import load_plugins
from gran_bench.config.rules import ConfigError
from gran_bench.processes import quiet_without_reader
from gran_bench.provenance import program
from gran_bench.sweep import launcher as launchers
from gran_bench.sweep.launcher import JobError
from gran_bench.sweep.local import LocalLauncher
from gran_bench.sweep.ray import RayLauncher
from gran_bench.sweep.runs import SweepJob
from gran_bench.sweep.slurm import SlurmLauncher
from gran_bench.sweep.task import FAILED, REFUSED, Task, complain


@quiet_without_reader()
def run(
    task: Callable[[Any], object], config_name: str, schema: type, sweep: str | None = None, loads: Sequence[str] = ()
) -> NoReturn:
    """Run ``task`` on the config that the command line describes: once, or with ``--multirun`` once a job.

    Ends the process with exit code 0; 1 where the task failed, or a job of a multirun, which stops no other job;
    2 where the config cannot be; 128 + the signal's number after Ctrl-C or SIGTERM. An error that the house foresees
    is one line on stderr.

    Args:
        task: called with the checked config.
        config_name: of the primary config in ``conf/``, which must fit ``schema``.
        sweep: ``package.module:name`` of what gets the jobs of a multirun, the name of its folder and whether they
            may run on other machines, and gives the block that is around them.
        loads: modules that a job needs, loaded ahead where jobs get processes of their own.
    """
    # Makes Hydra raise its errors instead of printing them, also in the processes that a launcher starts.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    launchers.register([LocalLauncher, SlurmLauncher, RayLauncher])
    arguments = get_args_parser().parse_args()
    multirun = arguments.multirun or "hydra.mode=MULTIRUN" in arguments.overrides
    source = compose.Source(arguments.config_name or config_name, arguments.config_dir, arguments.config_path)
    shows = (arguments.help, arguments.hydra_help, arguments.cfg, arguments.info is not None)
    described, configs, launcher = compose.Described(), [], None
    try:
        if not any((*shows, arguments.shell_completion, arguments.experimental_rerun)):
            load_plugins()  # before Hydra: what it cannot compose is explained by what is registered
            described = compose.described_jobs(source, arguments.overrides, multirun)
            configs = [compose.checked_config(composed, schema) for _, composed in described.jobs]
            if (launcher := launchers.chosen(described.launcher)) is not None:
                launcher.check()
            if not multirun and (name := getattr(getattr(configs[0], "tracking", None), "sweep", None)) is not None:
                raise ConfigError(f"tracking.sweep={name} names the folder of a sweep; add -m (--multirun)")
    except Exception as error:
        complain(error, schema)
        sys.exit(FAILED if explain(error, schema) is None else REFUSED)

    dry_run = sweep is None and any(getattr(config, "dry_run", False) for config in configs)
    # Found here: a job of a multirun may run in a process that a launcher started.
    each = Task(task, source, schema, [*program(), *source.flags])
    around: AbstractContextManager[Any] = nullcontext()
    try:
        if multirun and dry_run:  # Hydra would leave a file
            for config in configs:
                task(config)
            sys.exit(0)
        if multirun and configs:
            if launcher is not None:
                launcher.prepare(loads)
            if sweep is not None and described.complete:
                lines = [overrides for overrides, _ in described.jobs]
                swept = compose.swept_keys(lines)
                planned = []
                for overrides, config in zip(lines, configs, strict=True):
                    choices = dict(line.partition("=")[::2] for line in compose.changed_in(overrides, swept))
                    name = config.tracking.folder or compose.run_folder(config.experiment, overrides, swept)
                    config.tracking.folder = name
                    planned.append(SweepJob(name, choices, config.seed, config=config))
                around = resolve_name(sweep)(
                    planned,
                    compose.run_folder(configs[0].experiment, arguments.overrides, swept),
                    launcher is not None and launcher.elsewhere,
                )
        with around as each.sweep:
            try:
                hydra.main(f"pkg://{compose.CONFIG_MODULE}", config_name, version_base=compose.VERSION_BASE)(each)()
            except JobError as error:
                each.failures.append(error)
            except Exception as error:
                if error not in each.failures:
                    raise
        if each.failures and not multirun:
            raise each.failures[0]
    except KeyboardInterrupt as stop:
        number = getattr(signal.Signals, str(stop), signal.SIGINT)
        print(f"stopped by {number.name}; the same command goes on from here", file=sys.stderr)
        sys.exit(128 + number)
    except BrokenPipeError:
        raise
    except Exception as error:
        sys.exit(max(FAILED, complain(error, schema)))
    if each.failures:  # said already, where it happened
        print("error: at least one job of the multirun failed; its message is above", file=sys.stderr)
    sys.exit(FAILED if each.failures else 0)
