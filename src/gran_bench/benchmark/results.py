"""Everything that a benchmark found, as plain data, and what may be said of it: who wins, and what pays."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student_t

from gran_bench.benchmark.contest import Method, Study
from gran_bench.benchmark.errors import VELOCITY, Reference, Scored
from gran_bench.benchmark.turns import Record
from gran_bench.plots.time_error import Contender

RESULTS = "benchmark.json"
FORMAT = 1  # of the file; a change makes a page refuse the older ones
SPREAD = ("median", "low", "high", "expected_low", "expected_high")


class ResultsError(ValueError):
    """Results that a page cannot be made from; the message names the file and the remedy."""


def spread(values: Sequence[float]) -> dict[str, float | None] | None:
    """Median, smallest and largest of positive values, one a round, and where the median of another benchmark lies.

    It lies, at 95 %, within median × exp(± t_{n−1} × 1.2533 s √(2/n)), s the standard deviation of ln x over n rounds:
    1.2533 s/√n is the standard error of a median. None of no value; a single round says nothing of another.
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

    ``beside`` has the wall time of a simulated second of the DEM at its automatic step, s, by round.
    """
    record, seconds = record or Record([]), method.seconds
    turns = record.turns
    wall = [turn["wall_seconds"] / seconds for turn in turns]
    ratios = [t / beside[turn["round"]] for t, turn in zip(wall, turns, strict=True) if turn["round"] in beside]
    names = ("name", "kind", "unfit_because", "beyond", "packings", "data_seconds", "training_seconds")
    spent = {name: getattr(method, name) for name in names}
    spent |= {"simulated_seconds": seconds, "failure": record.failure, "failed_seconds": record.failed_seconds}
    cpu = float(np.median([turn["cpu_seconds"] for turn in turns])) / seconds if turns else None
    spent |= {"wall": spread(wall), "relative": spread(ratios), "cpu_seconds": cpu}
    spent |= {key: max((turn[key] for turn in turns), default=None) for key in ("peak_bytes", "own_bytes")}
    found = {"floors": None, "floors_low": None, "floors_high": None, "by": "", "outside": 0, "judgement": None}
    found["statistics"] = None
    if scored is not None:
        found = {"floors": scored.floors, "floors_low": scored.low, "floors_high": scored.high, "by": scored.by}
        found |= {"outside": scored.outside, "judgement": scored.judgement, "statistics": scored.statistics}
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
    """The ranked errors and the DEM's own accuracy in them, as plain data; None where there are too few replicas.

    ``automatic`` is the mean error of the DEM at its automatic step over ``runs``, in noise floors; None if it failed.
    """
    noise = reference.noise(runs)
    # Where a bed comes to rest, nudges hardly grow, and the step of the DEM counts for more than its noise.
    accepted = None if noise is None else max(noise, automatic or 0.0)
    ranked = [{"key": row.key, "label": row.short_label, "unit": row.unit} for row in reference.ranked]
    facts = {"replicas": replicas, "judged_runs": runs, "own": reference.own, "noise": noise}
    facts["floor_between"] = reference.floor.between
    return facts | {"accepted": accepted, "ranked": ranked}


def judged_anew(found: dict[str, Any], reference: Reference, replicas: int) -> dict[str, Any]:
    """Kept results with the accuracy by today's rule; a `ResultsError` where they were held against other replicas."""
    ranked, then = reference.floors(), {row["key"] for row in found["reference"]["ranked"]}
    if then != {*ranked}:
        raise ResultsError(f"methods were ranked by {', '.join(sorted(then))}, and now by {', '.join(sorted(ranked))}; "
                           "give measure=true")  # fmt: skip
    for row in found["methods"]:
        if row["judgement"] is None or row["judgement"]["velocity_kind"] != VELOCITY:
            continue
        spheres = (row["judgement"].get("failures") or {}).get("spheres")  # none of a method without particles
        for key, floor in reference.floors(spheres).items():
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
            spent = {key: row[key] for key in ("data_seconds", "training_seconds")}
            timed.append(Entry(row["name"], row["kind"], wall["median"], *errors, wall["low"], wall["high"], **spent))
    return timed


def untimed(found: dict[str, Any]) -> list[str]:
    """Names of the methods that failed before they had a frame: no time says where in the figure they stand."""
    rows = [row for row in found["methods"] if row["failed"] and row["wall"] is None and row["failed_seconds"] is None]
    return [row["name"] for row in rows]


def read_results(path: Path) -> dict[str, Any]:
    """Results as they were kept; a `ResultsError` where there are none, or of another format."""
    if not path.exists():
        raise ResultsError(f"{path} is missing; measure first, with measure=true")
    results = json.loads(path.read_text("utf-8"))
    if results.get("format") != FORMAT:
        raise ResultsError(f"{path} was written by another version; run its command again, or remove its folder")
    return results


def read_all(root: Path) -> dict[str, dict[str, Any]]:
    """All results below a folder by ``profile/scene``; full ones stand for others of a scene. Raises `ResultsError`."""
    places = {(path.parts[-3], path.parts[-2]): path for path in sorted(root.glob(f"*/*/{RESULTS}"))}
    shown = [(a, b) for a, b in places if a == "full" or ("full", b) not in places]
    return {f"{profile}/{scene}": read_results(places[profile, scene]) for profile, scene in shown}


@dataclass(frozen=True)
class Entry(Contender):
    """One method with what was measured of it; ``fast`` and ``slow`` are the range of its times over the rounds."""

    data_seconds: float = 0.0  # spent before the first run, s
    training_seconds: float = 0.0  # spent before the first run, s

    @property
    def least(self) -> float:
        """The smallest error that its interval allows, in noise floors; of a run that did not fail."""
        return self.floors if self.low is None else self.low

    @property
    def most(self) -> float:
        """The largest error that its interval allows, in noise floors; of a run that did not fail."""
        return self.floors if self.high is None else self.high


@dataclass(frozen=True)
class Ratio:
    """How many times as fast one method is as another: of the medians, and the range that both spreads allow."""

    middle: float
    low: float
    high: float

    @property
    def decides(self) -> bool:
        """Whether the range lies on one side of 1."""
        return self.low > 1.0 or self.high < 1.0


def speed_up(entry: Entry, rival: Entry) -> Ratio:
    """How many times as fast ``entry`` is as ``rival``."""
    return Ratio(rival.seconds / entry.seconds, rival.fast / entry.slow, rival.slow / entry.fast)


def sound_dems(entries: Sequence[Entry]) -> list[Entry]:
    """The DEMs that did not fail, softened and large steps included, from fast to slow."""
    return sorted((e for e in entries if e.kind == "dem" and e.floors is not None), key=lambda e: e.seconds)


def fastest_rival(entries: Sequence[Entry], floors: float, accepted: float | None) -> Entry | None:
    """The fastest DEM whose measured error is at most ``floors``, or the DEM's own accuracy where that is known."""
    return next((e for e in sound_dems(entries) if e.floors <= max(floors, accepted or 0.0)), None)


def best_in_time(entries: Sequence[Entry], seconds: float) -> Entry | None:
    """The most exact DEM that takes no longer; None where every DEM takes longer."""
    return min((e for e in sound_dems(entries) if e.seconds <= seconds), key=lambda e: e.floors, default=None)


@dataclass(frozen=True)
class EqualAccuracy:
    """A method beside the fastest DEM that is as exact."""

    entry: Entry
    rival: Entry | None  # the fastest DEM whose measured error is no larger; None where there is none
    lenient: Entry | None  # the fastest DEM that is not significantly worse; at least as fast as the rival
    # Who is, of ``entry``, ``rival``, ``neither`` (the ranges of the times overlap), ``undecided`` (the two DEMs give
    # two answers) and ``alone`` (every DEM is significantly worse).
    faster: str


def equal_accuracy(entry: Entry, entries: Sequence[Entry], accepted: float | None) -> EqualAccuracy:
    """Whether a method that did not fail or the DEM is faster at equal accuracy, where the intervals allow to say so.

    A DEM is significantly worse where the low end of its interval lies above the high end of the method's, and above
    the DEM's own accuracy ``accepted``, in noise floors; None where that is not known.
    """
    rival, bound = fastest_rival(entries, entry.floors, accepted), max(entry.most, accepted or 0.0)
    lenient = next((e for e in sound_dems(entries) if e.least <= bound), None)
    if lenient is None:
        return EqualAccuracy(entry, None, None, "alone")

    ratios = [Ratio(math.inf, math.inf, math.inf) if dem is None else speed_up(entry, dem) for dem in (rival, lenient)]
    answers = {"neither" if not r.decides else "entry" if r.middle > 1.0 else "rival" for r in ratios}
    return EqualAccuracy(entry, rival, lenient, answers.pop() if len(answers) == 1 else "undecided")


def paid_back(beside: EqualAccuracy) -> float | None:
    """Simulated seconds after which data and training are paid back: (data + training) / (the DEM's − its seconds).

    None where every DEM is significantly worse; NaN where nobody knows who is faster; infinite where the DEM is.
    """
    entry, rival = beside.entry, beside.rival or beside.lenient
    if rival is None:
        return None
    if beside.faster in ("undecided", "neither"):
        return math.nan
    saved = rival.seconds - entry.seconds
    return (entry.data_seconds + entry.training_seconds) / saved if saved > 0.0 else math.inf


def crossing(abscissa: Sequence[float], costs: Sequence[float], level: float) -> float | None:
    """Where a cost first rises to a level, linearly in logarithms over a rising abscissa; None where it stays below."""
    x, y = np.log(np.asarray(abscissa, float)), np.log(np.asarray(costs, float) / level)
    above = np.flatnonzero(y >= 0.0)
    if not len(above) or not above[0]:
        return float(abscissa[0]) if len(above) else None
    k = above[0]
    return float(np.exp(x[k - 1] + (x[k] - x[k - 1]) * -y[k - 1] / (y[k] - y[k - 1])))
