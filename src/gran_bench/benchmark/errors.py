"""The error of each method in noise floors, and what the DEM's own scatter makes of it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student_t

from gran_bench.baselines import interpolated_statistics
from gran_bench.benchmark.contest import Method
from gran_bench.benchmark.jobs import read_trajectory, training_summaries
from gran_bench.benchmark.turns import trajectory_file
from gran_bench.dataset import Case
from gran_bench.files import write_text
from gran_bench.metrics.comparisons import COMPARISONS, Comparison
from gran_bench.metrics.judge import judge
from gran_bench.metrics.measured import CONFIDENCE
from gran_bench.metrics.summary import TrajectorySummary, summarise
from gran_bench.scene import Scene
from gran_bench.state import Trajectory

# What a method is ranked by: the worst of those that the DEM itself has in the scene. The height of the bed stands in
# where there is no angle of repose.
RANKED = ("surface_angle", "speed_w1")
RANKED_WITHOUT_ANGLE = ("center_height", "speed_w1")
ERRORS = "errors"
VELOCITY = "instantaneous"  # of the replicas: what the DEM has
LEAST_REPLICAS = 3  # that say how far the DEM's own errors scatter
# How each table of a pooled judgement is made of the rounds'; it stands beside them.
RULES = {"errors": "mean", "figures": "mean", "requirements": "worst round", "failures": "worst round, each count"}
Row = dict[str, Any]


@dataclass(frozen=True)
class Scored:
    """One method's error."""

    floors: float | None  # the largest of its ranked errors, in noise floors; None where one of them is undefined
    # 95 % interval: of one run, of the mean over the replicas; of several, of the mean of as many others
    low: float | None
    high: float | None
    by: str  # key of that error
    reason: str  # why there is none
    outside: int  # spheres that left the container
    judgement: dict[str, Any]  # everything else that was found (`Judgement.to_dict`)


class Reference:
    """The replicas, as cases of the scene with its motion, that all methods are held against."""

    def __init__(self, scene: Scene, cases: Sequence[Case]) -> None:
        self.scene, self.digest = scene, "-".join(case.digest[:8] for case in cases)
        self._cases, self._summaries = list(cases), {}
        truth = self.summaries(VELOCITY)
        rows = {row.key: row for row in COMPARISONS}
        floors = {key: _pairs(rows[key], truth) for key in {*RANKED, *RANKED_WITHOUT_ANGLE}}
        keys = RANKED if floors[RANKED[0]] else RANKED_WITHOUT_ANGLE
        self.ranked: list[Comparison] = [rows[key] for key in keys if floors[key]]

    def summaries(self, kind: str) -> list[TrajectorySummary]:
        """The replicas, summarised with one definition of velocity."""
        if kind not in self._summaries:
            self._summaries[kind] = [summarise(case.trajectory, self.scene, kind) for case in self._cases]
        return self._summaries[kind]

    @property
    def own(self) -> dict[str, list[float]]:
        """The ranked errors of each replica, judged by the others as if it were a method, in noise floors.

        Their mean is 1: both are the mean distance over all pairs.
        """
        truth, found = self.summaries(VELOCITY), {}
        for row in self.ranked:
            errors = [_mean(_distances(row, one, truth[:k] + truth[k + 1 :])) for k, one in enumerate(truth)]
            found[row.key] = [error / _mean(errors) for error in errors]  # that mean is the floor
        return found

    def noise(self, runs: int) -> float | None:
        """Error up to which the mean of some runs cannot be told from the DEM itself, in noise floors.

        A method is given the largest, over the ranked errors, of its mean over its runs; so this is the largest of
        their bounds (`noise_bound`). None below three replicas.
        """
        bounds = [noise_bound(errors, runs) for errors in self.own.values()]
        return None if None in bounds else max(bounds, default=None)

    def score(self, candidate: TrajectorySummary | Trajectory) -> Scored:
        """Hold one run of a method against the replicas."""
        mine = candidate if isinstance(candidate, TrajectorySummary) else summarise(candidate, self.scene)
        truth, found = self.summaries(mine.velocity_kind), {}
        judgement = judge(mine, truth, self.scene)
        outside = 0 if mine.failures is None else mine.failures.outside_spheres
        for row in self.ranked:
            error = judgement.error(row.key).error
            if not error.defined:
                return Scored(None, None, None, row.key, f"{row.label}: {error.note}", outside, judgement.to_dict())
            floor = _mean(_pairs(row, truth))
            found[row.key] = [distance / floor for distance in _distances(row, mine, truth)]
        worst = max(found, key=lambda key: _mean(found[key]))
        return Scored(*_interval(found[worst], 1.0), worst, "", outside, judgement.to_dict())

    def pooled(self, runs: Sequence[Scored]) -> Scored:
        """The error of a method from several runs of it: means, and where the mean of as many others lies.

        A single run (statistics without particles) keeps its interval over the replicas.
        """
        failed = next((run for run in runs if run.floors is None), None)
        if failed is not None or len(runs) == 1:
            return failed or runs[0]
        judgement = pooled_judgement([run.judgement for run in runs])
        worst = max(self.ranked, key=lambda row: judgement["errors"][row.key]["multiple_of_floor"]).key
        floors = [run.judgement["errors"][worst]["multiple_of_floor"] for run in runs]
        outside = max(run.outside for run in runs)
        return Scored(*_interval(floors, math.sqrt(2.0)), worst, "", outside, judgement)

    def floors(self) -> dict[str, float]:
        """The noise floor of each ranked error, in its unit."""
        return {row.key: _mean(_pairs(row, self.summaries(VELOCITY))) for row in self.ranked}


def noise_bound(own: Sequence[float], runs: int) -> float | None:
    """Upper end of the 95 % interval in which the mean error of further runs of the DEM lies, in noise floors.

    mean + t s √(1/m + 1/n) for m replicas and n runs, with t the two-sided quantile of Student's distribution with
    m − 1 degrees of freedom: two means of one distribution (Student 1908), taken as if the replicas' errors were
    independent, though each distance of two of them is in both.

    ``own`` has the error of each replica, judged by the others. None below three replicas: of two, each has the same
    distance from the other, and nothing scatters.
    """
    return None if len(own) < LEAST_REPLICAS else _interval(own, math.sqrt(1.0 + len(own) / runs))[2]


def score_run(method: Method, folder: Path, reference: Reference, index: int) -> Scored | None:
    """The error of one round of a method, computed once and kept in its folder; its frames are dropped then.

    None where the round has no frames: the method failed in it, or earlier.
    """
    path, frames = errors_file(folder, reference.digest, index), trajectory_file(folder, index)
    if not path.exists():
        if method.job["does"] == "interpolation":
            found = reference.score(interpolated_statistics(method.job["rpm"], training_summaries(method.job)))
        elif frames.exists():
            found = reference.score(read_trajectory(frames))
        else:
            return None
        write_text(path, json.dumps(asdict(found)) + "\n")
    frames.unlink(missing_ok=True)
    return Scored(**json.loads(path.read_text("utf-8")))


def judged_rounds(method: Method, rounds: int) -> int:
    """How many rounds of a method are judged: statistics without particles are the same in all."""
    return 0 if not method.judged else 1 if method.job.get("does") == "interpolation" else rounds


def errors_file(folder: Path, digest: str, index: int) -> Path:
    """Where the error of a round against a reference is kept."""
    return folder / f"{ERRORS}{index}-{digest}.json"


def pooled_judgement(judgements: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One judgement of several, in the layout of a single one (`Judgement.to_dict`), with the rule of each table.

    A figure that a round lacks is undefined, as in that round. A requirement is that of the round farthest beyond its
    bound, and one without a figure is the worst. Failures are each count where it is worst: the largest, the fewest
    states, the first time without a figure.

    Args:
        judgements: of the rounds of one method, held against the same replicas.
    """
    found = judgements[0] | {"rounds": len(judgements), "pooled": RULES}
    for table, pool in (("errors", _mean_error), ("figures", _mean_figure), ("requirements", _worst_requirement)):
        found[table] = _by_key([judgement[table] for judgement in judgements], pool)
    found["accepted"] = all(judgement["accepted"] for judgement in judgements)
    counts = [judgement["failures"] for judgement in judgements]
    found["failures"] = None if None in counts else _worst_failures(counts)
    return found


def _by_key(tables: Sequence[dict[str, Row]], pool: Callable[[Sequence[Row]], Row]) -> dict[str, Row]:
    return {key: pool([table[key] for table in tables]) for key in tables[0]}


def _lacking(rows: Sequence[Row]) -> Row | None:
    return next((row for row in rows if row["value"] is None), None)


def _mean_value(rows: Sequence[Row], *names: str) -> Row:
    missing = _lacking(rows)
    return dict(missing) if missing else rows[0] | {name: _mean([row[name] for row in rows]) for name in names}


def _mean_error(rows: Sequence[Row]) -> Row:
    return _mean_value(rows, "value", *(["multiple_of_floor"] if rows[0]["multiple_of_floor"] is not None else []))


def _mean_figure(rows: Sequence[Row]) -> Row:
    inside = [row["inside_interval"] for row in rows]
    held = {"inside_interval": None if None in inside else all(inside), "rounds_inside": inside.count(True)}
    return _mean_value(rows, "value") | held


def _worst_requirement(rows: Sequence[Row]) -> Row:
    return _lacking(rows) or max(rows, key=lambda row: row["value"])


def _worst_failures(counts: Sequence[Row]) -> Row:
    found = {name: max(count[name] for count in counts) for name in counts[0] if name != "first_non_finite"}
    times = [count["first_non_finite"] for count in counts if count["first_non_finite"] is not None]
    return found | {"states": min(count["states"] for count in counts), "first_non_finite": min(times, default=None)}


def _distances(row: Comparison, mine: TrajectorySummary, truth: Sequence[TrajectorySummary]) -> list[float]:
    return [row.distance(mine, replica).number for replica in truth]


def _pairs(row: Comparison, truth: Sequence[TrajectorySummary]) -> list[float]:
    """Distances of all pairs of replicas; empty where the DEM has no such figure, or no scatter in it."""
    found = [row.distance(truth[i], truth[j]) for i in range(len(truth)) for j in range(i)]
    if not all(distance.defined for distance in found) or not any(distance.number for distance in found):
        return []
    return [distance.number for distance in found]


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values))


def _interval(values: Sequence[float], factor: float) -> tuple[float, float, float]:
    """Mean, and its 95 % interval by Student, ± t s/√n × ``factor``: 1 for the mean, √2 for that of as many others.

    √(1 + n/k) is the factor for the mean of k others.
    """
    mean, count = _mean(values), len(values)
    if count < 2:
        return mean, mean, mean
    quantile = float(student_t.ppf(0.5 + 0.5 * CONFIDENCE, count - 1))
    reach = factor * quantile * float(np.std(values, ddof=1)) / math.sqrt(count)
    return mean, mean - reach, mean + reach
