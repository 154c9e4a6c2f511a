"""Train a surrogate, roll it out and judge it: ``python -m gran_bench.train +experiment=holdout30rpm``."""

from __future__ import annotations

from gran_bench.config import TrainConfig
from gran_bench.entry import run


def task(config: TrainConfig) -> object:
    """Run the experiment that ``config`` describes."""
    # Imported here, so that --help and a refused config need not wait for PyTorch and MLflow.
    from gran_bench.experiment import run_experiment

    return run_experiment(config)


if __name__ == "__main__":
    run(task, "train", TrainConfig)
