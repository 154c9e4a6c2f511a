"""Open the MLflow UI on the recorded runs.

python -m gran_bench.ui port=5001
"""

from __future__ import annotations

from gran_bench.config import UiConfig
from gran_bench.entry import run


def task(config: UiConfig) -> object:
    """Become the UI, until Ctrl-C."""
    # Imported here, so that --help and a refused config need not wait for MLflow.
    from gran_bench.tracking import ui

    return ui(config.tracking.root, config.port, config.tracking.experiment)


if __name__ == "__main__":
    run(task, "ui", UiConfig)
