"""Judge the DEM on coarser spheres: ``python -m gran_bench.coarse_graining [scene=drum] [factors=[1.5,2]]``."""

from gran_bench.config import CoarseGrainingConfig
from gran_bench.entry import run


def task(config: CoarseGrainingConfig) -> object:
    """Judge the coarse-grained DEMs that ``config`` describes."""
    # Imported here, so that --help and a refused config need not wait for PyTorch.
    from gran_bench.coarse_graining.ladder import run_ladder

    return run_ladder(config)


if __name__ == "__main__":
    run(task, "coarse_graining", CoarseGrainingConfig)
