"""Keys of the launchers, which start the jobs of a sweep: ``hydra/launcher=local``, ``slurm`` and ``ray``."""

from __future__ import annotations

from dataclasses import dataclass, field

from gran_bench.config.rules import Section, at_least, key, positive


@dataclass
class LocalConfig(Section, place="hydra.launcher"):
    """Keys of ``hydra/launcher=local``."""

    n_jobs: int = key(2, at_least(1))  # at a time


@dataclass
class ClusterConfig(Section, place="hydra.launcher"):
    """Keys of every launcher of a cluster."""

    n_jobs: int | None = key(None, at_least(1))  # submitted at a time; null: all
    cpus: int = key(2, at_least(1))  # of a job
    gpus: int = key(0, at_least(0))  # of a job
    memory_gb: float | None = key(None, positive("GB"))  # of a job; null: what the cluster gives
    retries: int = key(10, at_least(0))  # times that a job goes on after it was killed


@dataclass
class SlurmConfig(ClusterConfig, place="hydra.launcher"):
    """Keys of ``hydra/launcher=slurm``."""

    partition: str | None = None  # null: the cluster's default
    minutes: int = key(60, at_least(1))  # time limit of a job, which is requeued there and goes on, as often as retries
    options: dict = field(default_factory=dict)  # further ones of sbatch, by their long names
    setup: list[str] = field(default_factory=list)  # lines of shell before the job


@dataclass
class RayConfig(ClusterConfig, place="hydra.launcher"):
    """Keys of ``hydra/launcher=ray``."""

    address: str | None = None  # HOST:PORT of a running cluster's head, or auto; null: Ray is started on this machine
