"""Fit the friction of coarse spheres to the fine DEM: ``python -m gran_bench.calibrate scene.coarse_graining=2``.

It looks at the training speeds alone; the held-out one judges the coarse spheres afterwards.
"""

from __future__ import annotations

from gran_bench.config import CalibrateConfig
from gran_bench.entry import run


def task(config: CalibrateConfig) -> object:
    """Say what it takes, then fit friction and rolling friction of the coarse spheres that ``config`` describes."""
    # Imported here, so that --help and a refused config need not wait for PyTorch.
    from gran_bench.coarse_graining.calibration import calibrate

    return calibrate(config)


if __name__ == "__main__":
    run(task, "calibrate", CalibrateConfig)
