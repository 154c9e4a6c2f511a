"""The error of each method in noise floors, and what the DEM's own scatter makes of it."""

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gran_bench.baselines import interpolated_statistics
from gran_bench.benchmark.contest import Method
from gran_bench.benchmark.jobs import emulated, read_trajectory, training_summaries
from gran_bench.benchmark.turns import FIRST_NUDGE, trajectory_file
from gran_bench.dataset import Case, read_case
from gran_bench.files import write_text
from gran_bench.metrics.comparisons import COMPARISONS, Comparison
from gran_bench.metrics.ensembles import Claims, claims_of, judge_ensemble, plain
from gran_bench.metrics.floor import Floor, beside_floor, nudges_grow, thinned
from gran_bench.metrics.judge import judge
from gran_bench.metrics.measured import Series, prediction_interval
from gran_bench.metrics.phases import find_phases
from gran_bench.metrics.requirements import held_rows
from gran_bench.metrics.sample import SAMPLE
from gran_bench.metrics.summary import TrajectorySummary, summarise
from gran_bench.scene import Scene
from gran_bench.state import Trajectory

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
    low: float | None  # 95 % interval: of one run, of the mean over the replicas; of several, of as many others
    high: float | None
    by: str  # key of that error
    reason: str  # why there is none
    outside: int  # spheres that left the container
    judgement: dict[str, Any] | None  # everything else that was found (`Judgement.to_dict`); None of an ensemble
    statistics: dict[str, Any] | None = None  # of a method without particles: what its energy score says, by quantity


class Reference:
    """The replicas, as cases of the scene with its motion, that all methods are held against.

    Where their nudges do not grow, ``packings`` are read: runs of the DEM from different packings, whose distances are
    then the noise floors.
    """

    def __init__(self, scene: Scene, cases: Sequence[Case], packings: Callable[[], Sequence[Case]] = tuple) -> None:
        self.scene, self._summaries, self._floors = scene, {}, {}
        # Without the frames, which are many: they are read again where another definition of velocity is asked for.
        self._paths: dict[bool, list[Path]] = {False: [case.path for case in cases], True: []}
        self._summaries[VELOCITY, False] = self._summarised(cases, VELOCITY)
        others: Sequence[Case] = ()
        if not nudges_grow(self.summaries(VELOCITY)):
            others = packings()
            self._paths[True] = [case.path for case in others]
            self._summaries[VELOCITY, True] = self._summarised(others, VELOCITY, self.summaries(VELOCITY))
        self.digest = "-".join(case.digest[:8] for case in (*cases, *others))
        truth = self.summaries(VELOCITY)
        self.floor = self._floor(truth[0], VELOCITY)
        self._ranked = [row.key for row in held_rows(truth) if (one := self.floor.of(row)).defined and one.number]

    @property
    def ranked(self) -> list[Comparison]:
        """The errors that methods are ranked by."""
        known = {row.key: row for row in COMPARISONS}
        return [known[key] for key in self._ranked]

    def summaries(self, kind: str, packings: bool = False) -> list[TrajectorySummary]:
        """The replicas, or the packings, summarised with one definition of velocity and with the replicas' phases."""
        if (kind, packings) not in self._summaries:
            cases = map(read_case, self._paths[packings])
            self._summaries[kind, packings] = self._summarised(cases, kind, self.summaries(kind) if packings else None)
        return self._summaries[kind, packings]

    def _summarised(
        self, cases: Iterable[Case], kind: str, like: list[TrajectorySummary] | None = None
    ) -> list[TrajectorySummary]:
        found = [summarise(case.trajectory, self.scene, kind) for case in cases]
        phases = find_phases([run.series for run in like or found], self.scene)
        return [replace(run, phases=phases) for run in found]

    def _floor(self, candidate: TrajectorySummary, kind: str) -> Floor:
        """The floor beside a candidate, whose distances are computed once for all of as many spheres."""
        count = candidate.sorted_speed.shape[1]
        if (kind, count) not in self._floors:
            truth, packings = self.summaries(kind), self.summaries(kind, packings=True)
            self._floors[kind, count] = beside_floor(candidate, truth, packings)[1]
        return self._floors[kind, count]

    @property
    def own(self) -> dict[str, list[float]]:
        """The ranked errors of each run of the floor, judged by the others, in noise floors; their mean is 1."""
        found, floors = {}, self.floors()
        for row in self.ranked:
            found[row.key] = [error.number / floors[row.key] for error in self.floor.own(row)]
        return found

    def noise(self, runs: int) -> float | None:
        """The largest `noise_bound` of the ranked errors: a method is given the largest of its means over its runs."""
        bounds = [noise_bound(errors, runs) for errors in self.own.values()]
        return None if None in bounds else max(bounds, default=None)

    def score(self, candidate: TrajectorySummary | Trajectory) -> Scored:
        """Hold one run of a method against the replicas."""
        mine = candidate if isinstance(candidate, TrajectorySummary) else summarise(candidate, self.scene)
        kind, found = mine.velocity_kind, {}
        truth, packings = self.summaries(kind), self.summaries(kind, packings=True)
        mine = replace(mine, phases=truth[0].phases)
        judgement = judge(mine, truth, self.scene, packings=packings, floor=self._floor(mine, kind))
        outside = 0 if mine.failures is None else mine.failures.outside_spheres
        if mine.position is None:
            return replace(self.score_claims(claims_of(mine, self.claimed)), judgement=judgement.to_dict())
        mine = thinned(mine, truth[0].sorted_speed.shape[1])
        for row in self.ranked:
            said = judgement.error(row.key)
            if not said.error.defined:
                reason = f"{row.label}: {said.error.note}"
                return Scored(None, None, None, row.key, reason, outside, judgement.to_dict())
            found[row.key] = [row.distance(mine, replica).number / said.floor.number for replica in truth]
        for row in judgement.requirements:
            if row.key in SAMPLE and row.verdict == "fail":
                reason = f"no sample of the flow: {row.label}: {row.figure}"
                return Scored(None, None, None, "", reason, outside, judgement.to_dict())
        worst = max(found, key=lambda key: _mean(found[key]))
        return Scored(*_interval(found[worst], math.inf), worst, "", outside, judgement.to_dict())

    def score_claims(self, claims: Claims) -> Scored:
        """Hold an ensemble of statistics against the replicas, in the quantities that methods are ranked by."""
        truth, rows = self.summaries(VELOCITY, packings=True) or self.summaries(VELOCITY), self.claimed
        found = judge_ensemble({row.key: claims[row.key] for row in rows if row.key in claims}, truth, rows)
        return Scored(None, None, None, "", "", 0, None, plain(found))

    @property
    def claimed(self) -> list[Comparison]:
        """What a method without particles is held to: the ranked series, and the speeds."""
        truth = self.summaries(VELOCITY)[0]
        return [row for row in self.ranked if row.measure is None or isinstance(row.measure(truth), Series)]

    def pooled(self, runs: Sequence[Scored]) -> Scored:
        """A method's error from several runs; a single run (no particles) keeps its interval over the replicas."""
        failed = next((run for run in runs if run.floors is None), None)
        if failed is not None or len(runs) == 1:
            return failed or runs[0]
        judgement = pooled_judgement([run.judgement for run in runs])
        worst = max(self.ranked, key=lambda row: judgement["errors"][row.key]["multiple_of_floor"]).key
        floors = [run.judgement["errors"][worst]["multiple_of_floor"] for run in runs]
        outside = max(run.outside for run in runs)
        return Scored(*_interval(floors, len(floors)), worst, "", outside, judgement)

    def floors(self, spheres: int | None = None) -> dict[str, float]:
        """The noise floor of each ranked error, in its unit; beside a method of so many spheres, or of as many."""
        floor = self.floor if spheres is None else Floor.of_runs(self.floor.runs, spheres, self.floor.between)
        return {row.key: floor.of(row).number for row in self.ranked}


def noise_bound(own: Sequence[float], runs: int) -> float | None:
    """Upper end of the 95 % interval of the mean error of further runs of the DEM, in noise floors.

    ``own`` has each replica's error, taken as independent. None below three replicas: of two, nothing scatters.
    """
    return None if len(own) < LEAST_REPLICAS else prediction_interval(own, runs).high


def score_run(method: Method, folder: Path, reference: Reference, index: int) -> Scored | None:
    """The error of a round, kept in its folder, where its frames are dropped; None of a round that failed."""
    path, frames = errors_file(folder, reference.digest, index), trajectory_file(folder, index)
    if not path.exists():
        if method.job["does"] == "emulator":
            found = reference.score_claims(emulated(method.job, FIRST_NUDGE + index))
        elif method.job["does"] == "interpolation":
            found = reference.score(interpolated_statistics(method.job["rpm"], training_summaries(method.job)))
        elif frames.exists():
            found = reference.score(read_trajectory(frames))
        else:
            return None
        write_text(path, json.dumps(asdict(found)) + "\n")
    frames.unlink(missing_ok=True)
    return Scored(**json.loads(path.read_text("utf-8")))


def judged_rounds(method: Method, rounds: int) -> int:
    """How many rounds of a method are judged: baselines and statistics without particles are the same in all."""
    return 0 if not method.judged else 1 if method.kind in ("baseline", "emulator") else rounds


def errors_file(folder: Path, digest: str, index: int) -> Path:
    """Where the error of a round against a reference is kept."""
    return folder / f"{ERRORS}{index}-{digest}.json"


def pooled_judgement(judgements: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One judgement of several, in the layout of a single one (`Judgement.to_dict`), pooled by `RULES`.

    What a round lacks is undefined. A requirement is the one of the round farthest beyond its bound.
    """
    found = judgements[0] | {"rounds": len(judgements), "pooled": RULES}
    for table in ("errors", "figures", "requirements"):
        rows = {key: [judgement[table][key] for judgement in judgements] for key in judgements[0][table]}
        found[table] = {key: _pooled_row(table, some) for key, some in rows.items()}
    found["accepted"] = all(judgement["accepted"] for judgement in judgements)
    counts = [judgement["failures"] for judgement in judgements]
    if None in counts:
        return found | {"failures": None}
    worst = {name: max(count[name] for count in counts) for name in counts[0] if name != "first_non_finite"}
    times = [count["first_non_finite"] for count in counts if count["first_non_finite"] is not None]
    worst |= {"states": min(count["states"] for count in counts), "first_non_finite": min(times, default=None)}
    return found | {"failures": worst}


def _pooled_row(table: str, rows: Sequence[Row]) -> Row:
    lacking = next((row for row in rows if row["value"] is None), None)
    if table == "requirements":
        return lacking or max(rows, key=lambda row: row["value"])
    means = [name for name in ("value", "multiple_of_floor") if rows[0].get(name) is not None]
    pooled = dict(lacking or rows[0] | {name: _mean([row[name] for row in rows]) for name in means})
    if table == "figures":
        inside = [row["inside_interval"] for row in rows]
        pooled["inside_interval"], pooled["rounds_inside"] = None if None in inside else all(inside), inside.count(True)
    return pooled


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values))


def _interval(values: Sequence[float], others: float) -> tuple[float, float, float]:
    """Mean, and the interval of the mean of ``others`` more figures; of infinitely many it is the mean's own."""
    found = prediction_interval(values, others)
    return (_mean(values),) * 3 if found is None else astuple(found)
