"""``python -m gran_bench.report [FOLDER ...]``: sweeps, and every table of the results, from their records."""

import argparse
import csv
import io
import json
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gran_bench.benchmark import page as benchmark
from gran_bench.benchmark.results import Entry, ResultsError, entries, equal_accuracy, read_all
from gran_bench.evaluation.plan import rollout_name
from gran_bench.files import markdown, write_part
from gran_bench.plots.time_error import frontier
from gran_bench.provenance import read_table
from gran_bench.report.result_page import PAGE, renew_page
from gran_bench.run.summary import missed_requirements, read_summary
from gran_bench.stress import page as stress
from gran_bench.stress.expectation import FAILED
from gran_bench.sweep.runs import FAILED as RUN_FAILED
from gran_bench.sweep.runs import SWEEPS, SweepFileError, sweep_folders
from gran_bench.sweep.sweep_report import report_sweeps, write_overview
from gran_bench.sweep.table import read_standing
from gran_bench.verification import command as verification

# What is committed. A reader's own runs and sweeps lie beside these and are not on the page.
RUNS = ("holdout30rpm", "paper")
SHIPPED_SWEEPS = ("sweep_loss", "sweep_rollout", "sweep_radius", "sweep_boundary")
ERRORS = {"surface_angle": "angle of repose, °", "com_angle": "centre-of-mass angle, °", "speed_w1": "speeds, m/s"}


def drum_table(root: Path) -> list[str]:
    """Time and errors of every method in `drum`: of the benchmark in turns, then of runs judged by themselves."""
    lines = [("method", "s a simulated second", "× the DEM", *ERRORS.values(), "worst, floors")]
    found = next((one for one in read_all(root / "benchmark").values() if one["scene"] == "drum"), None)
    rows, ranked = [], ["surface_angle", "speed_w1"]
    if found is not None:
        ranked = [kind["key"] for kind in found["reference"]["ranked"]]
        automatic = next(row for row in found["methods"] if row["name"] == found["automatic"])
        ranks = [entry for entry in entries(found) if entry.kind != "baseline"]
        front = [entry for entry in frontier(ranks) if entry.seconds <= automatic["wall"]["median"]]
        shown = {found["automatic"], *(entry.name for entry in front)}
        rows = [row for row in found["methods"] if row["kind"] == "surrogate" or row["name"] in shown]
        floors = {key: {"value": error["floor"]} for key, error in _errors(automatic).items()}
        lines.append(_row("noise floor: the DEM against itself", None, None, floors, "1"))
    for row in rows:
        times = (row[key]["median"] if row[key] else None for key in ("wall", "relative"))
        worst = "failed" if row["failed"] else _worst(_errors(row), ranked)
        lines.append(_row(row["name"], *times, _errors(row), worst))
    for name, summary in _runs(root):
        if not any(row["name"].startswith(name) for row in rows):
            errors = summary["judged"]["shared"]["errors"]
            rollout = summary["rollouts"][rollout_name(summary["judged_rpm"])]
            time, who = rollout["ms_per_frame_median"], f"`{summary['model']['name']}` ([{name}]({name}/README.md))"
            times = time / summary["frame_ms"], time / rollout["dem_ms_per_frame"]
            lines.append(_row(f"{who}, judged by itself", *times, errors, _worst(errors, ranked)))
        for baseline, errors in summary["baselines"].items() if name == RUNS[0] else ():
            if "replayed" in baseline:
                lines.append(_row(f"{baseline}, judged by itself", None, None, errors, _worst(errors, ranked)))
    return markdown(lines)


def _runs(root: Path) -> list[tuple[str, dict[str, Any]]]:
    return [(name, found) for name in RUNS if (found := read_summary(root / name)) is not None]


def scenes_table(root: Path) -> list[str]:
    """One line a scene: the fastest DEM of the DEM's own accuracy beside the shipped surrogate."""
    lines = [("scene", "spheres", "fastest DEM of the DEM's accuracy", "surrogate", "at equal accuracy")]
    for found in read_all(root / "benchmark").values():
        every, best, accepted = entries(found), benchmark.softened(found), found["reference"]["accepted"]
        link = f"[{found['scene']}](benchmark/README.md#{found['scene']})"
        for row in (row for row in found["methods"] if row["kind"] == "surrogate"):
            entry = next((one for one in every if one.name == row["name"] and one.floors is not None), None)
            said = row["unfit_because"] or row["failure"] if entry is None else _numbers(entry)
            beside = "" if entry is None else benchmark.equal_accuracy_words(equal_accuracy(entry, every, accepted))
            dem = "none" if best is None else f"{best.name}: {_numbers(best)}"
            lines.append((link, str(found["spheres"]), dem, f"{row['name']}: {said}", beside))
    return markdown(lines)


def failures_table(root: Path) -> list[str]:
    """What failed: a row for each record, with the day of the record."""
    lines = [("record", "of the day", "failed")]
    for name, summary in _runs(root):
        missed = missed_requirements(summary)
        words = f"{len(missed)} requirements" + (f", first: {missed[0]}" if missed else "")
        lines.append((f"[{name}]({name}/README.md)", summary["provenance"].get("day", ""), words))
    if (root / "verification" / verification.JSON).exists():
        record = json.loads((root / "verification" / verification.JSON).read_text("utf-8"))
        failed = [case["name"] for case in record["cases"] if not case["met"]]
        words = f"{len(failed)} of {len(record['cases'])} cases" + (f": {', '.join(failed)}" if failed else "")
        lines.append(("[verification](verification/README.md)", record["provenance"].get("day", ""), words))
    if (root / "stress" / stress.TABLE).exists():
        made, table = read_table(root / "stress" / stress.TABLE)
        rows = list(csv.DictReader(io.StringIO(table)))
        early = [case for case, model, *_ in stress.early_ends(rows) if model]
        words = f"{stress.count(rows, FAILED)} of {len(rows)} expectations; {len(early)} rollouts of trained models"
        words += f" before their end: {', '.join(early) or 'none'}"
        lines.append(("[stress](stress/README.md)", made.get("day", ""), words))
    if benchmarks := read_all(root / "benchmark"):
        methods = [row for found in benchmarks.values() for row in found["methods"]]
        names = Counter(row["name"] for row in methods if row["failed"])
        words = f"{names.total()} of {len(methods)} methods in {len(benchmarks)} scenes: "
        words += "; ".join(f"{name} ({scenes})" for name, scenes in names.items())
        last = max(found["provenance"].get("day", "") for found in benchmarks.values())
        lines.append(("[benchmark](benchmark/README.md)", last, words))
    runs = [run for name in SHIPPED_SWEEPS for run in read_standing(root / SWEEPS / name).counted]
    if runs:
        lost = sum("broken_rollouts" in run.facts for run in runs)
        words = f"{sum(run.status == RUN_FAILED for run in runs)} of {len(runs)} runs; {lost} broke down in a rollout"
        lines.append(("[sweeps](sweeps/README.md)", max(run.ended_at for run in runs)[:10], words))
    return markdown(lines)


def _errors(row: Mapping[str, Any]) -> dict[str, Any]:
    return (row["judgement"] or {}).get("errors") or {}


def _worst(errors: Mapping[str, Any], ranked: list[str]) -> str:
    """The worst of the ranked errors, in noise floors."""
    multiples = [errors[key]["multiple_of_floor"] for key in ranked if key in errors]
    return "undefined" if None in multiples else f"{max(multiples):.2f}" if multiples else ""


def _row(name: str, seconds: float | None, relative: float | None, errors: Mapping[str, Any], worst: str) -> list[str]:
    cells = ["–" if value is None else f"{value:.3g}" for value in (seconds, relative)]
    for key in ERRORS:
        value = errors.get(key, {"value": ""})["value"]
        cells.append("undefined" if value is None else value if value == "" else f"{value:.2g}")
    return [name, *cells, worst]


def _numbers(entry: Entry) -> str:
    return f"{entry.seconds:.3g} s, {entry.floors:.3g} floors"


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
