"""The tables of the results' front page: the drum, one line a scene, what failed; made from committed records alone."""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from gran_bench.benchmark.claims import Entry, equal_accuracy
from gran_bench.benchmark.page import equal_accuracy_words, softened
from gran_bench.benchmark.results import entries, read_all
from gran_bench.plots.time_error import frontier
from gran_bench.provenance import read_table
from gran_bench.run.summary import missed_requirements, read_summary
from gran_bench.stress.expectation import FAILED
from gran_bench.stress.page import TABLE, count, early_ends
from gran_bench.sweep.runs import FAILED as RUN_FAILED
from gran_bench.sweep.runs import SWEEPS
from gran_bench.sweep.table import read_standing
from gran_bench.verification.report import JSON

# What is committed. A reader's own runs and sweeps lie beside these and are not on the page.
RUNS = ("holdout30rpm", "paper")
SHIPPED_SWEEPS = ("sweep_loss", "sweep_rollout", "sweep_radius", "sweep_boundary")
ERRORS = {"surface_angle": "angle of repose, °", "com_angle": "centre-of-mass angle, °", "speed_w1": "speeds, m/s"}


def drum_table(root: Path) -> Iterator[str]:
    """Time and errors of every method in `drum`: of the benchmark in turns, then of runs judged by themselves."""
    yield f"| method | s a simulated second | × the DEM | {' | '.join(ERRORS.values())} | worst, floors |"
    yield "|---|" + "---:|" * (len(ERRORS) + 3)
    found = next((one for one in read_all(root / "benchmark").values() if one["scene"] == "drum"), None)
    if found is not None:
        ranked = [kind["key"] for kind in found["reference"]["ranked"]]
        automatic = next(row for row in found["methods"] if row["name"] == found["automatic"])
        front = [entry for entry in frontier(entries(found)) if entry.seconds <= automatic["wall"]["median"]]
        shown = {found["automatic"], *(entry.name for entry in front)}
        rows = [row for row in found["methods"] if row["kind"] == "surrogate" or row["name"] in shown]
        floors = {key: {"value": error["floor"]} for key, error in _errors(automatic).items()}
        yield _row("noise floor: the DEM against itself", None, None, floors, "1")
        for row in rows:
            times = (row[key]["median"] if row[key] else None for key in ("wall", "relative"))
            worst = "failed" if row["failed"] else _worst(_errors(row), ranked)
            yield _row(row["name"], *times, _errors(row), worst)
    else:
        rows, ranked = [], ["surface_angle", "speed_w1"]
    for name, summary in _runs(root):
        if not any(row["name"].startswith(name) for row in rows):
            errors, rollout = (
                summary["judged"]["shared"]["errors"],
                summary["rollouts"][f"{summary['judged_rpm']:g}rpm"],
            )
            time, who = rollout["ms_per_frame_median"], f"`{summary['model']['name']}` ([{name}]({name}/README.md))"
            times = time / summary["frame_ms"], time / rollout["dem_ms_per_frame"]
            yield _row(f"{who}, judged by itself", *times, errors, _worst(errors, ranked))
        if name == RUNS[0]:
            for baseline, errors in summary["baselines"].items():
                if "replayed" in baseline:
                    yield _row(f"{baseline}, judged by itself", None, None, errors, _worst(errors, ranked))


def _runs(root: Path) -> list[tuple[str, dict[str, Any]]]:
    return [(name, found) for name in RUNS if (found := read_summary(root / name)) is not None]


def scenes_table(root: Path) -> Iterator[str]:
    """One line a scene: the fastest DEM of the DEM's own accuracy beside the shipped surrogate."""
    yield "| scene | spheres | fastest DEM of the DEM's accuracy | surrogate | at equal accuracy |"
    yield "|---|---:|---|---|---|"
    for found in read_all(root / "benchmark").values():
        every, best, accepted = entries(found), softened(found), found["reference"]["accepted"]
        link = f"[{found['scene']}](benchmark/README.md#{found['scene']})"
        for row in found["methods"]:
            if row["kind"] == "surrogate":
                entry = next((one for one in every if one.name == row["name"] and one.floors is not None), None)
                said = row["unfit_because"] or row["failure"] if entry is None else _numbers(entry)
                beside = "" if entry is None else equal_accuracy_words(equal_accuracy(entry, every, accepted))
                dem = "none" if best is None else f"{best.name}: {_numbers(best)}"
                yield f"| {link} | {found['spheres']} | {dem} | {row['name']}: {said} | {beside} |"


def failures_table(root: Path) -> Iterator[str]:
    """What failed: a row for each record, with the day of the record."""
    yield "| record | of the day | failed |"
    yield "|---|---|---|"
    for name, summary in _runs(root):
        missed = missed_requirements(summary)
        words = f"{len(missed)} requirements" + (f", first: {missed[0]}" if missed else "")
        yield _failures(f"[{name}]({name}/README.md)", summary["provenance"], words)
    if (root / "verification" / JSON).exists():
        record = json.loads((root / "verification" / JSON).read_text("utf-8"))
        failed = [case["name"] for case in record["cases"] if not case["met"]]
        words = f"{len(failed)} of {len(record['cases'])} cases" + (f": {', '.join(failed)}" if failed else "")
        yield _failures("[verification](verification/README.md)", record["provenance"], words)
    if (root / "stress" / TABLE).exists():
        made, table = read_table(root / "stress" / TABLE)
        rows = list(csv.DictReader(io.StringIO(table)))
        early = [case for case, model, *_ in early_ends(rows) if model]
        words = f"{count(rows, FAILED)} of {len(rows)} expectations; {len(early)} rollouts of trained models before "
        yield _failures("[stress](stress/README.md)", made, words + f"their end: {', '.join(early) or 'none'}")
    if benchmarks := read_all(root / "benchmark"):
        methods = [row for found in benchmarks.values() for row in found["methods"]]
        names = Counter(row["name"] for row in methods if row["failed"])
        words = f"{names.total()} of {len(methods)} methods in {len(benchmarks)} scenes: "
        words += "; ".join(f"{name} ({scenes})" for name, scenes in names.items())
        last = max((found["provenance"] for found in benchmarks.values()), key=lambda made: made.get("day", ""))
        yield _failures("[benchmark](benchmark/README.md)", last, words)
    runs = [run for name in SHIPPED_SWEEPS for run in read_standing(root / SWEEPS / name).counted]
    if runs:
        lost = sum("broken_rollouts" in run.facts for run in runs)
        words = f"{sum(run.status == RUN_FAILED for run in runs)} of {len(runs)} runs; {lost} broke down in a rollout"
        yield _failures("[sweeps](sweeps/README.md)", {"day": max(run.ended_at for run in runs)[:10]}, words)


def _errors(row: Mapping[str, Any]) -> dict[str, Any]:
    return (row["judgement"] or {}).get("errors") or {}


def _worst(errors: Mapping[str, Any], ranked: list[str]) -> str:
    """The worst of the ranked errors, in noise floors."""
    multiples = [errors[key]["multiple_of_floor"] for key in ranked if key in errors]
    return "undefined" if None in multiples else f"{max(multiples):.2f}" if multiples else ""


def _row(name: str, seconds: float | None, relative: float | None, errors: Mapping[str, Any], worst: str) -> str:
    cells = ["–" if value is None else f"{value:.3g}" for value in (seconds, relative)]
    for key in ERRORS:
        value = errors.get(key, {"value": ""})["value"]
        cells.append("undefined" if value is None else value if value == "" else f"{value:.2g}")
    return f"| {name} | {' | '.join(cells)} | {worst} |"


def _numbers(entry: Entry) -> str:
    return f"{entry.seconds:.3g} s, {entry.floors:.3g} floors"


def _failures(record: str, made: Mapping[str, str], words: str) -> str:
    return f"| {record} | {made.get('day', '')} | {words} |"
