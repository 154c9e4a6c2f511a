"""Open a case or a run elsewhere: ``python -m gran_bench.export CASE|RUN --to vtkhdf|xyz|npz``."""

from __future__ import annotations

import sys
from pathlib import Path

from gran_bench.config import TrackingConfig
from gran_bench.export.command import export_command
from gran_bench.processes import quiet_without_reader
from gran_bench.tracking import Store, TrackingError, has_store


def folder_of(run_id: str, root: Path) -> str | None:
    """The folder of a run by its id in MLflow; None where the store of ``root`` does not have it."""
    try:
        return Store(TrackingConfig(root=str(root))).tag_of(run_id, "folder") if has_store(root) else None
    except TrackingError:
        return None


if __name__ == "__main__":
    with quiet_without_reader():
        sys.exit(export_command(sys.argv[1:], folder_of))
