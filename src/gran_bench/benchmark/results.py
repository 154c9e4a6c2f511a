"""Everything that a benchmark found, as plain data: the one file that figures, table and page are made from."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from gran_bench.benchmark.claims import Entry
from gran_bench.benchmark.errors import VELOCITY, Reference, Scored
from gran_bench.benchmark.method import Method
from gran_bench.benchmark.spread import spread
from gran_bench.benchmark.turns import Record, Turn
from gran_bench.files import write_text

RESULTS = "benchmark.json"
FORMAT = 1  # of the file; a change makes a page refuse the older ones


class ResultsError(ValueError):
    """Results that a page cannot be made from; the message names the file and the remedy."""


def method_row(
    method: Method, record: Record | None, scored: Scored | None, beside: dict[int, float]
) -> dict[str, Any]:
    """What is known of one method, as plain data.

    Args:
        method: that was compared.
        record: of its turns; None where it does not fit the scene.
        scored: its error; None where it has none.
        beside: wall time of a simulated second of the DEM at its automatic step, s, by round: the unit of ``relative``.
    """
    row: dict[str, Any] = {"name": method.name, "kind": method.kind, "unfit_because": method.unfit_because}
    row |= {"data_seconds": method.data_seconds, "training_seconds": method.training_seconds}
    row |= {"simulated_seconds": method.seconds, "failure": record.failure if record else ""}
    turns = record.turns if record else []
    wall = [turn.wall_seconds / method.seconds for turn in turns]
    # Where in the figure a run stands that failed on its way.
    row["failed_seconds"] = record.failed_seconds if record else None
    row["wall"] = asdict(spread(wall)) if wall else None
    row["relative"] = _relative(wall, turns, beside)
    row["cpu_seconds"] = float(np.median([t.cpu_seconds for t in turns])) / method.seconds if turns else None
    for name in ("peak_bytes", "own_bytes"):
        row[name] = max((getattr(turn, name) for turn in turns), default=None)
    row |= {"floors": None, "floors_low": None, "floors_high": None, "by": "", "outside": 0, "judgement": None}
    if scored is not None:
        row |= {"floors": scored.floors, "floors_low": scored.low, "floors_high": scored.high, "by": scored.by}
        row |= {"outside": scored.outside, "judgement": scored.judgement}
        row["failure"] = row["failure"] or scored.reason
        if scored.outside:
            row["failure"] = row["failure"] or f"{scored.outside} spheres left the container"
    row["failed"] = bool(row["failure"])
    return row


def _relative(wall: Sequence[float], turns: Sequence[Turn], beside: dict[int, float]) -> dict[str, Any] | None:
    """Times in units of the reference method's time in the same round: what slows a whole machine cancels."""
    ratios = [seconds / beside[turn.round] for seconds, turn in zip(wall, turns, strict=True) if turn.round in beside]
    return asdict(spread(ratios)) if ratios else None


def study_rows(points: dict[str, list[tuple[float, Method]]], records: dict[str, Record]) -> dict[str, list[dict]]:
    """Cost against stiffness or number: by label, a point for each abscissa; its time is None where the run failed."""
    found: dict[str, list[dict]] = {}
    for label, methods in points.items():
        found[label] = []
        for abscissa, method in methods:
            record = records[method.name]
            wall = [turn.wall_seconds / method.seconds for turn in record.turns]
            point = {"at": abscissa, "wall": asdict(spread(wall)) if wall else None, "failure": record.failure}
            if method.kind == "dem":
                point["time_step"] = method.job["dem"]["time_step"]
            found[label].append(point)
    return found


def succeeded(point: dict[str, Any]) -> bool:
    """Whether a point of a study has a time of runs that all reached their end."""
    return point["wall"] is not None and not point["failure"]


def reference_facts(reference: Reference, replicas: int, runs: int, automatic: float | None) -> dict[str, Any]:
    """The ranked errors and what the DEM's own accuracy in them is.

    Args:
        reference: the replicas.
        replicas: how many.
        runs: of each method, whose mean is its error.
        automatic: the error of the DEM at its automatic step, in noise floors; None where that failed.

    Returns:
        Plain data; ``noise`` and ``accepted`` are None where there are too few replicas.
    """
    noise = reference.noise(runs)
    return {
        "replicas": replicas,
        "judged_runs": runs,
        "own": reference.own,
        "noise": noise,
        # Where a bed comes to rest, nudges hardly grow, and the step of the DEM counts for more than its noise.
        "accepted": None if noise is None else max(noise, automatic or 0.0),
        "ranked": [{"key": row.key, "label": row.label, "unit": row.unit} for row in reference.ranked],
    }


def judged_anew(found: dict[str, Any], reference: Reference, replicas: int) -> dict[str, Any]:
    """Kept results with the DEM's own accuracy by today's rule: nothing is measured, and no method's error changes.

    Args:
        found: as it was kept.
        reference, replicas: as in `reference_facts`.

    Raises:
        ResultsError: the methods were held against other replicas.
    """
    floors = reference.floors()
    for row in found["methods"]:
        if row["judgement"] is None or row["judgement"]["velocity_kind"] != VELOCITY:
            continue
        for key, floor in floors.items():
            then = row["judgement"]["errors"][key]["floor"]
            if not np.isclose(then, floor, rtol=1e-6):
                raise ResultsError(
                    f"{row['name']} was held against other replicas ({key}: their floor is {then:.6g}, that of these "
                    f"{floor:.6g}); give the command that measured it, or measure=true"
                )
    automatic = next((row["floors"] for row in found["methods"] if row["name"] == found["automatic"]), None)
    runs = found["reference"]["judged_runs"]
    return found | {"reference": reference_facts(reference, replicas, runs, automatic)}


def share_waited(rows: Sequence[dict[str, Any]]) -> float:
    """Share of the wall time in which methods waited for the processor, −: how busy the machine was with other work."""
    timed = [row for row in rows if row["wall"] and row["wall"]["median"] > 1e-3]
    wall = sum(row["wall"]["median"] for row in timed)
    return max(0.0, 1.0 - sum(row["cpu_seconds"] for row in timed) / wall) if wall else 0.0


def entries(found: dict[str, Any]) -> list[Entry]:
    """The judged methods of a benchmark, failed ones included, that were timed."""
    timed = []
    for row in found["methods"]:
        wall = row["wall"] or dict.fromkeys(("median", "low", "high"), row["failed_seconds"])
        times = [wall[name] for name in ("median", "low", "high")]
        if times[0] is not None and (row["floors"] is not None or row["failed"]):
            floors = None if row["failed"] else row["floors"]
            spent = row["data_seconds"], row["training_seconds"]
            interval = (None, None) if row["failed"] else (row["floors_low"], row["floors_high"])
            timed.append(Entry(row["name"], row["kind"], *times, floors, *spent, *interval))
    return timed


def untimed(found: dict[str, Any]) -> list[str]:
    """Names of the methods that failed before they had a frame: no time says where in the figure they stand."""
    rows = [row for row in found["methods"] if row["failed"] and row["wall"] is None and row["failed_seconds"] is None]
    return [row["name"] for row in rows]


def write_results(folder: Path, found: dict[str, Any]) -> Path:
    """Write the results whole or not at all."""
    write_text(folder / RESULTS, json.dumps(found, indent=1, allow_nan=False) + "\n")
    return folder / RESULTS


def read_results(path: Path) -> dict[str, Any]:
    """Results as they were kept.

    Raises:
        ResultsError: none there, or of another format.
    """
    if not path.exists():
        raise ResultsError(f"{path} is missing; measure first, with measure=true")
    results = json.loads(path.read_text("utf-8"))
    if results.get("format") != FORMAT:
        raise ResultsError(f"{path} was written by another version; run its command again, or remove its folder")
    return results


def read_all(root: Path) -> dict[str, dict[str, Any]]:
    """All results below a folder by ``profile/scene``; a scene with full results has these alone.

    Raises:
        ResultsError: results of another format.
    """
    found = {}
    for path in sorted(root.glob(f"*/*/{RESULTS}")):
        found[f"{path.parent.parent.name}/{path.parent.name}"] = read_results(path)
    thorough = {place.partition("/")[2] for place in found if place.startswith("full/")}
    return {p: r for p, r in found.items() if p.startswith("full/") or p.partition("/")[2] not in thorough}
