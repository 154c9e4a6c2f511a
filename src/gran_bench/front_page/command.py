"""``python -m gran_bench.report [FOLDER ...]``: sweeps, what matters over all of them, and the front page."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from gran_bench.comparison.results import ResultsError
from gran_bench.front_page.page import write_front_page
from gran_bench.sweep.command import report_sweeps
from gran_bench.sweep.overview import write_overview
from gran_bench.sweep.run_file import SWEEPS, SweepFileError
from gran_bench.sweep.sweep_file import sweep_folders


def report_command(arguments: Sequence[str] | None = None) -> int:
    """Report sweeps; without a folder every sweep, a page over all of them, and the front page of the results.

    Args:
        arguments: of the command line.

    Returns:
        The exit code: 0; 1 where a record or the store could not be read; 2 where there is nothing to report.
    """
    parser = argparse.ArgumentParser("python -m gran_bench.report", description="Make pages anew from their records.")
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER", help="of a sweep; everything if none")
    parser.add_argument("--root", type=Path, default=Path("results"), help="results folder (default: results)")
    chosen = parser.parse_args(arguments)
    folders = chosen.folders or sweep_folders(chosen.root)
    if not report_sweeps(folders):
        return 1
    if chosen.folders:
        return 0
    try:
        overview, page = write_overview(chosen.root), write_front_page(chosen.root)
    except BrokenPipeError:
        raise
    except (ResultsError, SweepFileError, ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if overview is None and page is None:
        place = chosen.root / SWEEPS
        print(f"error: {place} holds no sweep; run one (-m), or name --root or a folder", file=sys.stderr)
        return 2
    for what, path in (("what matters, over all sweeps", overview), ("the front page", page)):
        if path is not None:
            print(f"{what}: {path}", file=sys.stderr)
    return 0
