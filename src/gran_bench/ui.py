"""Open the MLflow UI on the recorded runs.

python -m gran_bench.ui port=5001
"""

from __future__ import annotations

from gran_bench.config import UiConfig
from gran_bench.entry import run


def task(config: UiConfig) -> object:
    """Become the UI, until Ctrl-C."""
    # Imported here, so that --help and a refused config need not wait for MLflow.
    from gran_bench.tracking import Store, ui

    def fill(store: Store) -> None:
        from gran_bench.report.shipped_records import record_shipped

        record_shipped(store)

    tracking = config.tracking
    return ui(tracking.root, config.port, tracking.experiment, fill if config.shipped else None)


if __name__ == "__main__":
    run(task, "ui", UiConfig)
