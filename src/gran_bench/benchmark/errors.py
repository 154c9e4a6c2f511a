"""The error of each method in noise floors, and what the DEM's own scatter makes of it."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student_t

from gran_bench.baselines import interpolated_statistics
from gran_bench.benchmark.method import Method
from gran_bench.benchmark.pooling import pooled_judgement
from gran_bench.benchmark.turns import trajectory_file
from gran_bench.dataset import Case, read_case
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


@dataclass(frozen=True)
class Scored:
    """One method's error.

    Attributes:
        floors: the largest of its ranked errors, in noise floors; None where one of them is undefined.
        low, high: 95 % interval: of one run, of the mean over the replicas; of several, of the mean of as many others.
        by: key of that error.
        reason: why there is none.
        outside: spheres that left the container.
        judgement: everything else that was found (`Judgement.to_dict`).
    """

    floors: float | None
    low: float | None
    high: float | None
    by: str
    reason: str
    outside: int
    judgement: dict[str, Any]


class Reference:
    """The replicas that all methods are held against.

    Args:
        scene: with its motion.
        cases: the replicas.
    """

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
        their bounds (`noise_bound`).

        Args:
            runs: whose mean is a method's error.

        Returns:
            None below three replicas.
        """
        bounds = [noise_bound(errors, runs) for errors in self.own.values()]
        return None if None in bounds else max(bounds, default=None)

    def score(self, candidate: TrajectorySummary | Trajectory) -> Scored:
        """Hold one run of a method against the replicas."""
        mine = candidate if isinstance(candidate, TrajectorySummary) else summarise(candidate, self.scene)
        truth = self.summaries(mine.velocity_kind)
        judgement = judge(mine, truth, self.scene)
        outside = 0 if mine.failures is None else mine.failures.outside_spheres
        found = {}
        for row in self.ranked:
            error = judgement.error(row.key).error
            if not error.defined:
                return Scored(None, None, None, row.key, f"{row.label}: {error.note}", outside, judgement.to_dict())
            floor = self._floor(row, truth)
            found[row.key] = [distance / floor for distance in _distances(row, mine, truth)]
        worst = max(found, key=lambda key: _mean(found[key]))
        middle, reach = _mean(found[worst]), _reach(found[worst], 1.0)
        return Scored(middle, middle - reach, middle + reach, worst, "", outside, judgement.to_dict())

    def pooled(self, runs: Sequence[Scored]) -> Scored:
        """The error of a method from several runs of it: means, and where the mean of as many others lies.

        What else was found of them is pooled by `pooling.RULES`.

        A single run (statistics without particles) keeps its interval over the replicas.
        """
        failed = next((run for run in runs if run.floors is None), None)
        if failed is not None or len(runs) == 1:
            return failed or runs[0]
        judgement = pooled_judgement([run.judgement for run in runs])
        errors = judgement["errors"]
        worst = max(self.ranked, key=lambda row: errors[row.key]["multiple_of_floor"]).key
        floors = [run.judgement["errors"][worst]["multiple_of_floor"] for run in runs]
        middle, reach = _mean(floors), _reach(floors, math.sqrt(2.0))
        outside = max(run.outside for run in runs)
        return Scored(middle, middle - reach, middle + reach, worst, "", outside, judgement)

    def floors(self) -> dict[str, float]:
        """The noise floor of each ranked error, in its unit."""
        return {row.key: self._floor(row, self.summaries(VELOCITY)) for row in self.ranked}

    def _floor(self, row: Comparison, truth: list[TrajectorySummary]) -> float:
        return _mean(_pairs(row, truth))


def noise_bound(own: Sequence[float], runs: int) -> float | None:
    """Upper end of the 95 % interval in which the mean error of further runs of the DEM lies, in noise floors.

    mean + t s √(1/m + 1/n) for m replicas and n runs, with t the two-sided quantile of Student's distribution with
    m − 1 degrees of freedom: two means of one distribution (Student 1908), taken as if the replicas' errors were
    independent, though each distance of two of them is in both.

    Args:
        own: error of each replica, judged by the others.
        runs: n.

    Returns:
        None below three replicas: of two, each has the same distance from the other, and nothing scatters.
    """
    if len(own) < LEAST_REPLICAS:
        return None
    return _mean(own) + _reach(own, math.sqrt(1.0 + len(own) / runs))


def score_run(method: Method, folder: Path, reference: Reference, index: int) -> Scored | None:
    """The error of one round of a method, computed once and kept in its folder; its frames are dropped then.

    None where the round has no frames: the method failed in it, or earlier.
    """
    path, frames = errors_file(folder, reference.digest, index), trajectory_file(folder, index)
    if not path.exists():
        if method.job["does"] == "interpolation":
            cases = {float(rpm): read_case(case) for rpm, case in method.job["cases"].items()}
            training = {rpm: summarise(case.trajectory, case.scene) for rpm, case in cases.items()}
            found = reference.score(interpolated_statistics(method.job["rpm"], training))
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


def read_trajectory(path: Path) -> Trajectory:
    """The frames that a worker kept."""
    with np.load(path) as kept:
        spin = kept["angular_velocity"] if "angular_velocity" in kept.files else None
        kind = str(kept["velocity_kind"])
        return Trajectory(kept["time"], kept["position"], kept["velocity"], spin, kept["radius"], velocity_kind=kind)


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


def _reach(values: Sequence[float], factor: float) -> float:
    """Half a 95 % interval by Student, t s/√n × ``factor``: 1 for the mean, √2 for that of as many others.

    √(1 + n/k) is the factor for the mean of k others.
    """
    if len(values) < 2:
        return 0.0
    quantile = float(student_t.ppf(0.5 + 0.5 * CONFIDENCE, len(values) - 1))
    return factor * quantile * float(np.std(values, ddof=1)) / math.sqrt(len(values))
