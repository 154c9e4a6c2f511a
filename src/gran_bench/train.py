"""Train a surrogate, roll it out and judge it: ``python -m gran_bench.train +experiment=holdout30rpm``."""

from gran_bench.config import TrainConfig
from gran_bench.entry import run

# All that decides a result, so that a job of a sweep runs what the sweep began with, whatever is edited meanwhile.
LOADS = [
    *("gran_bench.run.experiment", "gran_bench.sweep.opening"),
    *("gran_bench.surrogate.convolution.ccnn", "gran_bench.surrogate.contact.network"),
]


def task(config: TrainConfig) -> object:
    """Run the experiment that ``config`` describes."""
    # Imported here, so that --help and a refused config need not wait for PyTorch and MLflow.
    from gran_bench.run.experiment import run_experiment

    return run_experiment(config)


if __name__ == "__main__":
    run(task, "train", TrainConfig, "gran_bench.sweep.opening:open_sweep", LOADS)
