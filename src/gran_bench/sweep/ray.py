"""The jobs of a sweep on a Ray cluster, or by Ray on this machine; Ray starts again what dies or loses its node."""

import logging
import os
import signal
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from typing import Any

from gran_bench.config.launchers import RayConfig
from gran_bench.config.rules import ConfigError
from gran_bench.sweep.launcher import JobLauncher, last_words, require_package
from gran_bench.sweep.remote import RemoteJob
from gran_bench.sweep.task import GRACE_SECONDS, SAID

LOOK_SECONDS = 1.0  # between two looks for results
ANSWER_SECONDS = 5.0  # that a cluster's head has to answer
SAYS = "ray.txt"  # in the sweep's folder: what Ray says


class JobDiedError(RuntimeError):
    """A job's process ended without a word; Ray starts the job again."""


class RayLauncher(JobLauncher):
    """Give each job to Ray; where this process is killed, Ray ends its jobs."""

    schema = RayConfig
    elsewhere = True

    def check(self) -> None:
        require_package("ray")
        if self.config.address is None:
            _refuse_large("cpus", self.config.cpus, os.cpu_count() or 1)
            return
        self._connect()
        import ray

        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        for key, resource in (("cpus", "CPU"), ("gpus", "GPU")):
            _refuse_large(key, getattr(self.config, key), max((node.get(resource, 0.0) for node in nodes), default=0))

    @contextmanager
    def opened(self) -> Iterator[None]:
        import ray

        # Ray says a page for each death, on stdout, which is for tables.
        with open(self.folder / SAYS, "a", buffering=1, encoding="utf-8") as said, redirect_stdout(said):
            self._connect()
            try:
                yield
            finally:
                ray.shutdown()

    def start(self, overrides: list[str], number: int) -> Any:
        import ray

        memory = self.config.memory_gb
        self.tell(number, "given to Ray")
        task = ray.remote(_do).options(
            name=self.task.name(number),
            num_cpus=self.config.cpus,
            num_gpus=self.config.gpus,
            memory=None if memory is None else round(memory * 1e9),
            max_retries=self.config.retries,
            retry_exceptions=[JobDiedError],
        )
        return task.remote(RemoteJob.of(self.task, overrides, number, forward=True))

    def ended(self, running: Mapping[int, Any]) -> dict[int, int | str]:
        import ray

        time.sleep(LOOK_SECONDS)  # in which a signal says which it is, as it does not within Ray
        ready, _ = ray.wait(list(running.values()), num_returns=len(running), timeout=0)
        return {number: _end_of(job) for number, job in running.items() if job in ready}

    def stop(self, running: Mapping[int, Any]) -> None:
        import ray

        for job in running.values():
            with suppress(ray.exceptions.RayError):
                ray.cancel(job, force=False)
        if running:
            ray.wait(list(running.values()), num_returns=len(running), timeout=GRACE_SECONDS)

    def _connect(self) -> None:
        """Connect to the cluster, or start one."""
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        import ray

        if ray.is_initialized():
            return
        address = self.config.address
        remedy = "start one by `ray start --head`, or leave the address out to start Ray on this machine"
        host, _, port = (address or "").removeprefix("ray://").rpartition(":")
        handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            if host:  # Ray itself would try for a minute
                socket.create_connection((host, int(port)), ANSWER_SECONDS).close()
            ray.init(address or "local", include_dashboard=None if address else False, log_to_driver=False,
                     configure_logging=True, logging_level=logging.ERROR)  # fmt: skip
        except (OSError, ValueError, RuntimeError) as error:  # a ConnectionError of Ray's is an OSError
            why = str(error).strip().splitlines()[:1] or [type(error).__name__]
            raise ConfigError(f"hydra.launcher.address={address}: no Ray cluster there ({why[0]}); {remedy}") from error
        for number, handler in handlers.items():  # a Ray that is started here would end this process on SIGTERM
            signal.signal(number, handler)


def _do(job: RemoteJob) -> int:
    # Ray cancels by SIGINT, which workers ignore where a shell started their cluster in the background.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    code = job()
    if code not in (0, SAID):
        raise JobDiedError(last_words(code, "hydra.launcher.memory_gb, to have fewer jobs on a node"))
    return code


def _end_of(job: Any) -> int | str:
    import ray

    try:
        return ray.get(job)
    except ray.exceptions.RayTaskError as error:
        return str(error.cause)
    except ray.exceptions.RayError as error:
        return f"Ray lost it: {str(error).strip().splitlines()[0]}"


def _refuse_large(key: str, value: int, most: float) -> None:
    if value > most:
        raise ConfigError(f"hydra.launcher.{key}={value}: no node has so many; give at most {most:g}")
