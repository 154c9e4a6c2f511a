"""Judge a trained model without training: ``python -m gran_bench.evaluate [checkpoint=FILE]``."""

from __future__ import annotations

from gran_bench.config import EvaluateConfig
from gran_bench.entry import run
from gran_bench.shipped import SHIPPED, shipped_model


def task(config: EvaluateConfig) -> object:
    """Roll out and judge the model that ``config`` names."""
    # Imported here, so that --help and a refused config need not wait for PyTorch and MLflow.
    from gran_bench.run.experiment import run_evaluation

    if config.checkpoint == SHIPPED:
        config.checkpoint = str(shipped_model())
    return run_evaluation(config)


if __name__ == "__main__":
    run(task, "evaluate", EvaluateConfig)
