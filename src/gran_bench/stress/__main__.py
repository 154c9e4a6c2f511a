"""Stress-test numerical stability: ``python -m gran_bench.stress [selection=short] [checkpoint=FILE]``."""

from gran_bench.config import StressConfig
from gran_bench.entry import run


def task(config: StressConfig) -> object:
    """Carry out the list of stress cases."""
    # Imported here, so that --help and a refused config need not wait for PyTorch and Numba.
    from gran_bench.stress.command import run_stress

    return run_stress(config)


if __name__ == "__main__":
    run(task, "stress", StressConfig)
