"""``python -m gran_bench.report [FOLDER ...]``: sweeps, and every table of the results that stands between marks."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from gran_bench.benchmark import page as benchmark
from gran_bench.benchmark.results import ResultsError
from gran_bench.files import write_part
from gran_bench.report.result_page import PAGE, renew_page
from gran_bench.report.tables import RUNS, drum_table, failures_table, scenes_table
from gran_bench.run.summary import read_summary
from gran_bench.stress import page as stress
from gran_bench.sweep.runs import SweepFileError, sweep_folders
from gran_bench.sweep.sweep_report import report_sweeps, write_overview
from gran_bench.verification import report as verification


def report_command(arguments: Sequence[str] | None = None) -> int:
    """Report sweeps; without a folder every sweep, and the tables of every page of the results.

    The exit code is 1 where a record or the store could not be read, 2 where there is nothing to report.
    """
    parser = argparse.ArgumentParser("python -m gran_bench.report", description="Renew tables from their records.")
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER", help="of a sweep; everything if none")
    parser.add_argument("--root", type=Path, default=Path("results"), help="results folder (default: results)")
    chosen = parser.parse_args(arguments)
    if not report_sweeps(chosen.folders or sweep_folders(chosen.root)):
        return 1
    if chosen.folders:
        return 0
    try:
        pages = renew_pages(chosen.root)
    except BrokenPipeError:
        raise
    except (ResultsError, SweepFileError, ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if not pages:
        print(f"error: {chosen.root} holds no record; make a run or a sweep, or name --root", file=sys.stderr)
        return 2
    for path in pages:
        print(f"renewed: {path}", file=sys.stderr)
    return 0


def renew_pages(root: Path) -> list[Path]:
    """Renew what stands between marks on every page whose record is there; the pages."""
    pages = [renew_page(root / name) for name in RUNS if read_summary(root / name) is not None]
    for folder, module, record in (
        ("verification", verification, verification.JSON),
        ("stress", stress, stress.TABLE),
        ("benchmark", benchmark, f"*/*/{benchmark.TABLE}"),
    ):
        if any((root / folder).glob(record)):
            module.write_page(root / folder)
            pages.append(root / folder / PAGE)
    if pages:
        for part, lines in (("drum", drum_table), ("scenes", scenes_table), ("failures", failures_table)):
            write_part(root / PAGE, part, "\n".join(lines(root)), "Results", part)
        pages.append(root / PAGE)
    sweeps = write_overview(root)
    return pages if sweeps is None else [*pages, sweeps]
