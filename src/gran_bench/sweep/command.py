"""``python -m gran_bench.report``: the report of sweeps, made anew from the files that their runs left."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from gran_bench import tracking
from gran_bench.sweep.overview import write_overview
from gran_bench.sweep.run_file import SWEEPS, SweepFileError
from gran_bench.sweep.sweep_file import sweep_folders
from gran_bench.sweep.sweep_report import report_sweep, report_to_parent


def report_command(arguments: Sequence[str] | None = None) -> int:
    """Report sweeps: pages, CSVs and figures in their folders, and in their parent runs where the store has them.

    Without a folder every sweep is reported, and a page over all of them is written beside them.

    Args:
        arguments: of the command line.

    Returns:
        The exit code: 0; 1 where a sweep or the store could not be read; 2 where there is nothing to report.
    """
    parser = argparse.ArgumentParser("python -m gran_bench.report", description="Report sweeps from their files.")
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER", help="of a sweep; every sweep if none")
    parser.add_argument("--root", type=Path, default=Path("results"), help="results folder (default: results)")
    chosen = parser.parse_args(arguments)
    folders = chosen.folders or sweep_folders(chosen.root)
    if not folders:
        place = chosen.root / SWEEPS
        print(f"error: {place} holds no sweep; run one (-m), or name --root or a folder", file=sys.stderr)
        return 2
    code = 0
    for folder in folders:
        try:
            report = report_sweep(folder.resolve())
            print(report.text)
            report_to_parent(folder.resolve(), report)
        except (SweepFileError, tracking.TrackingError, OSError) as error:
            print(f"error: {error}", file=sys.stderr)
            code = 1
    if not chosen.folders and code == 0:
        print(f"what matters, over all sweeps: {write_overview(chosen.root)}", file=sys.stderr)
    return code
