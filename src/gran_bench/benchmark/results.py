"""Everything that a benchmark found, as plain data: the one file that figures, table and page are made from."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student_t

from gran_bench.benchmark.claims import Entry
from gran_bench.benchmark.contest import Method, Study
from gran_bench.benchmark.errors import VELOCITY, Reference, Scored
from gran_bench.benchmark.turns import Record
from gran_bench.files import write_text

RESULTS = "benchmark.json"
FORMAT = 1  # of the file; a change makes a page refuse the older ones
SPREAD = ("median", "low", "high", "expected_low", "expected_high")


class ResultsError(ValueError):
    """Results that a page cannot be made from; the message names the file and the remedy."""


def spread(values: Sequence[float]) -> dict[str, float | None] | None:
    """Median, smallest and largest of positive values, one a round, and where the median of another benchmark lies.

    With s the standard deviation of ln x over n rounds, the median of n others lies with 95 % confidence within
    median × exp(± t_{n−1} × 1.2533 s √(2/n)): 1.2533 s/√n is the standard error of a median of normal values, and two
    medians scatter √2 as much as one. None of no value; a single round says nothing of another.
    """
    if not values:
        return None
    logarithm, count = np.log(np.asarray(values, float)), len(values)
    if count == 1:
        return dict(zip(SPREAD, [float(values[0])] * 3 + [None] * 2, strict=True))
    middle = float(np.median(logarithm))
    error = math.sqrt(0.5 * math.pi) * float(logarithm.std(ddof=1)) * math.sqrt(2.0 / count)
    reach = float(student_t.ppf(0.975, count - 1)) * error
    expected = math.exp(middle - reach), math.exp(middle + reach)
    return dict(zip(SPREAD, (math.exp(middle), float(min(values)), float(max(values)), *expected), strict=True))


def method_row(
    method: Method, record: Record | None, scored: Scored | None, beside: dict[int, float]
) -> dict[str, Any]:
    """What is known of one method, as plain data: its turns and its error, None of what does not fit or has none.

    ``beside`` has the wall time of a simulated second of the DEM at its automatic step, s, by round: the unit of
    ``relative``, in which what slows a whole machine cancels.
    """
    turns, seconds = record.turns if record else [], method.seconds
    wall = [turn["wall_seconds"] / seconds for turn in turns]
    ratios = [t / beside[turn["round"]] for t, turn in zip(wall, turns, strict=True) if turn["round"] in beside]
    names = ("name", "kind", "unfit_because", "data_seconds", "training_seconds")
    spent = {name: getattr(method, name) for name in names}
    spent |= {"simulated_seconds": seconds, "failure": record.failure if record else ""}
    spent |= {"failed_seconds": record.failed_seconds if record else None, "wall": spread(wall)}
    spent |= {"relative": spread(ratios), "cpu_seconds": None}
    if turns:
        spent["cpu_seconds"] = float(np.median([turn["cpu_seconds"] for turn in turns])) / seconds
    spent |= {key: max((turn[key] for turn in turns), default=None) for key in ("peak_bytes", "own_bytes")}
    found = {"floors": None, "floors_low": None, "floors_high": None, "by": "", "outside": 0, "judgement": None}
    if scored is not None:
        found = {"floors": scored.floors, "floors_low": scored.low, "floors_high": scored.high, "by": scored.by}
        found |= {"outside": scored.outside, "judgement": scored.judgement}
        lost = f"{scored.outside} spheres left the container" if scored.outside else ""
        spent["failure"] = spent["failure"] or scored.reason or lost
    return spent | found | {"failed": bool(spent["failure"])}


def study_rows(points: Study, records: dict[str, Record]) -> dict[str, list[dict]]:
    """Cost against stiffness or number: by label, a point for each abscissa; its time is None where the run failed."""
    found: dict[str, list[dict]] = {label: [] for label in points}
    for label, abscissa, method in ((label, *point) for label, line in points.items() for point in line):
        record = records[method.name]
        wall = spread([turn["wall_seconds"] / method.seconds for turn in record.turns])
        step = {"time_step": method.job["dem"]["time_step"]} if method.kind == "dem" else {}
        found[label].append({"at": abscissa, "wall": wall, "failure": record.failure} | step)
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
    # Where a bed comes to rest, nudges hardly grow, and the step of the DEM counts for more than its noise.
    accepted = None if noise is None else max(noise, automatic or 0.0)
    ranked = [{"key": row.key, "label": row.label, "unit": row.unit} for row in reference.ranked]
    facts = {"replicas": replicas, "judged_runs": runs, "own": reference.own, "noise": noise}
    return facts | {"accepted": accepted, "ranked": ranked}


def judged_anew(found: dict[str, Any], reference: Reference, replicas: int) -> dict[str, Any]:
    """Kept results with the DEM's own accuracy by today's rule: nothing is measured, and no method's error changes.

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
        wall = row["wall"] or dict.fromkeys(SPREAD, row["failed_seconds"])
        if wall["median"] is not None and (row["floors"] is not None or row["failed"]):
            errors = [None] * 3 if row["failed"] else [row[key] for key in ("floors", "floors_low", "floors_high")]
            spent = row["data_seconds"], row["training_seconds"]
            timed.append(Entry(row["name"], row["kind"], wall["median"], *errors, wall["low"], wall["high"], *spent))
    return timed


def untimed(found: dict[str, Any]) -> list[str]:
    """Names of the methods that failed before they had a frame: no time says where in the figure they stand."""
    rows = [row for row in found["methods"] if row["failed"] and row["wall"] is None and row["failed_seconds"] is None]
    return [row["name"] for row in rows]


def write_results(folder: Path, found: dict[str, Any]) -> None:
    """Write the results whole or not at all."""
    write_text(folder / RESULTS, json.dumps(found, indent=1, allow_nan=False) + "\n")


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
    paths = sorted(root.glob(f"*/*/{RESULTS}"))
    thorough = {path.parent.name for path in paths if path.parts[-3] == "full"}
    shown = [path for path in paths if path.parts[-3] == "full" or path.parent.name not in thorough]
    return {f"{path.parts[-3]}/{path.parts[-2]}": read_results(path) for path in shown}
