"""Compare every method on a scene, run time against error: ``python -m gran_bench.benchmark [scene=drum]``."""

from gran_bench.config import BenchmarkConfig
from gran_bench.entry import run


def task(config: BenchmarkConfig) -> object:
    """Measure, judge and compare what ``config`` describes."""
    # Imported here, so that --help and a refused config need not wait for PyTorch.
    from gran_bench.benchmark.command import run_benchmark

    return run_benchmark(config)


if __name__ == "__main__":
    run(task, "benchmark", BenchmarkConfig)
