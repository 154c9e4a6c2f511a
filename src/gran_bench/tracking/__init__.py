"""Runs in MLflow: recorded in batches, reopened on resume, never at the cost of a result."""

from gran_bench.tracking.names import HEADLINE, HEADLINE_FIGURES, shown_name
from gran_bench.tracking.opening import open_parent, open_run
from gran_bench.tracking.run import Run
from gran_bench.tracking.store import Store, TrackingError
from gran_bench.tracking.user_interface import ui

__all__ = [
    "HEADLINE",
    "HEADLINE_FIGURES",
    "Run",
    "Store",
    "TrackingError",
    "open_parent",
    "open_run",
    "shown_name",
    "ui",
]
