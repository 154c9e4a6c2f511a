"""The report of sweeps, made anew from the files that their runs left."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from gran_bench import tracking
from gran_bench.run.run_file import SweepFileError
from gran_bench.sweep.sweep_report import report_sweep, report_to_parent


def report_sweeps(folders: Sequence[Path]) -> bool:
    """Report sweeps: pages, CSVs and figures in their folders, and in their parent runs where the store has them.

    Args:
        folders: of sweeps.

    Returns:
        Whether every sweep, and the store, could be read; what could not is told on stderr.
    """
    every = True
    for folder in folders:
        try:
            report = report_sweep(folder.resolve())
            print(report.text)
            report_to_parent(folder.resolve(), report)
        except BrokenPipeError:
            raise
        except (SweepFileError, tracking.TrackingError, OSError) as error:
            print(f"error: {error}", file=sys.stderr)
            every = False
    return every
