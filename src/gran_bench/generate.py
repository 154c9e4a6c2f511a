"""Make the cases of a dataset with the DEM: ``python -m gran_bench.generate scene=drum dataset=holdout30``."""

from __future__ import annotations

from gran_bench.config import GenerateConfig
from gran_bench.entry import run


def task(config: GenerateConfig) -> object:
    """Make the cases that ``config`` describes and that are not there yet."""
    # Imported here, so that --help and a refused config need not wait for Numba.
    from gran_bench.dataset import generate

    return generate(config)


if __name__ == "__main__":
    run(task, "generate", GenerateConfig)
