"""Runs in MLflow: recorded in batches, reopened on resume, never at the cost of a result."""

from gran_bench.tracking.names import (
    HEADLINE,
    HEADLINE_FIGURES,
    VERDICT,
    how_to_compare,
    shown_name,
    three_figures,
    ui_command,
)
from gran_bench.tracking.opening import Child, end_child, open_run, reopen_ended, schedule_children
from gran_bench.tracking.run import Run
from gran_bench.tracking.store import SWEEP_TAG, Store, TrackingError, has_store, server_uri
from gran_bench.tracking.user_interface import ui
from gran_bench.tracking.views import SHIPPED_TAG
