"""The judge: one candidate against the replicas of the DEM, every figure in its unit and in noise floors."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from gran_bench.config.rules import check_arguments
from gran_bench.metrics.comparisons import CENTER, COMPARISONS, FIGURES, SURFACE, Comparison, added, speed_distance
from gran_bench.metrics.judgement import ErrorRow, FigureRow, Judgement, Requirement
from gran_bench.metrics.measured import Measured, mean_of, noise_floor, prediction_interval, score, shared_states
from gran_bench.metrics.outside import distance_outside
from gran_bench.metrics.speeds import sorted_frames, speeds, velocities, wasserstein_series
from gran_bench.metrics.summary import TrajectorySummary, of_one_bed, summarise
from gran_bench.scene import Scene
from gran_bench.state import Trajectory

Run = Trajectory | TrajectorySummary
STEADY_WITHIN = 3.0  # deg
PEAK_WITHIN = 10.0  # deg
SPEED_WITHIN = 0.08  # m/s


def judge(candidate: Run, replicas: Sequence[Run], scene: Scene, others: Mapping[str, Run] | None = None) -> Judgement:
    """Hold a candidate against the replicas of the DEM.

    Velocities are compared by the candidate's definition on both sides. Summaries may be given instead of
    trajectories, so that replicas are summarised once for many candidates; they must then have that definition.

    Args:
        candidate: a rollout, another run of the DEM, or a baseline's statistics.
        replicas: runs of the DEM from one settled state; two or more for a noise floor.
        scene: that all were made for.
        others: further runs of the DEM by name, each a column of its own beside the noise floor.

    Raises:
        ValueError: no replica, or runs that are not of the scene or not comparable.
    """
    others = {} if others is None else others
    check_arguments(candidate=(candidate, Run), replicas=(replicas, list[Run]), scene=(scene, Scene))
    check_arguments(others=(others, Mapping))
    check_arguments(**{f"others[{name}]": (run, Run) for name, run in others.items()})
    if not replicas:
        raise ValueError("no replica to judge against; make at least one run of the DEM")
    kind = candidate.velocity_kind
    runs = {"candidate": candidate, **{f"replica {i}": run for i, run in enumerate(replicas)}, **others}
    for name, run in runs.items():
        _hold_scene(name, run, scene, is_dem=run is not candidate)
    mine, *theirs = (
        run if isinstance(run, TrajectorySummary) else summarise(run, scene, kind) for run in runs.values()
    )
    for name, summary in zip(runs, (mine, *theirs), strict=True):
        _hold_alike(name, summary, mine)
    truth, beside = theirs[: len(replicas)], dict(zip(others, theirs[len(replicas) :], strict=True))
    failures, more = [run.failures for run in truth], added()
    return Judgement(
        errors=[_error_row(row, mine, truth, beside) for row in (*COMPARISONS, *more)],
        figures=[_figure_row(row, mine, truth) for row in (*FIGURES, *more)],
        requirements=list(acceptance(mine, truth, scene)),
        failures=mine.failures,
        dem_outside=None if None in failures else float(np.mean([count.share(count.outside) for count in failures])),
        velocity_kind=kind,
        replicas=len(truth),
    )


def _hold_scene(name: str, run: Run, scene: Scene, is_dem: bool) -> None:
    """Refuse a run that was not made for the scene."""
    interval = float(np.diff(run.time).mean()) if len(run.time) > 1 else scene.frame_interval
    remedy = "give the scene that it was made for"
    if abs(interval - scene.frame_interval) > 1e-3 * scene.frame_interval:
        found = f"{name} has a state every {interval:g} s"
        raise ValueError(f"{found} and scene {scene.name!r} every {scene.frame_interval:g} s; {remedy}")
    if not (is_dem and isinstance(run, Trajectory)):
        return  # the DEM stops where a centre is farther out than its radius; a rollout does not, which is counted
    if (distance_outside(run.position[:1].astype(np.float64), run.radius, scene) > run.radius).any():
        raise ValueError(f"{name} starts with spheres outside the walls of scene {scene.name!r}; {remedy}")


def _hold_alike(name: str, summary: TrajectorySummary, mine: TrajectorySummary) -> None:
    """Refuse runs of different spheres, times or velocities; one that ended early is counted as such."""
    own, other = (run.sorted_speed.shape[1] for run in (mine, summary))
    if own != other and not of_one_bed(mine, summary):
        told = f"candidate has {own} spheres and {name} has {other}"
        raise ValueError(f"{told}; compare runs of one scene's spheres")
    if summary.velocity_kind != mine.velocity_kind:
        kinds = f"({mine.velocity_kind}, {summary.velocity_kind}) are not comparable"
        raise ValueError(f"speeds of two definitions {kinds}; summarise both with one velocity_kind")
    shared_states(mine.time, summary.time)


def _error_row(
    row: Comparison,
    mine: TrajectorySummary,
    truth: Sequence[TrajectorySummary],
    beside: Mapping[str, TrajectorySummary],
) -> ErrorRow:
    error, floor = score(row.distance, mine, truth, row.unit), noise_floor(row.distance, truth, row.unit)
    further = {name: score(row.distance, run, truth, row.unit) for name, run in beside.items()}
    return ErrorRow(row.key, row.label, row.unit, error, floor, further)


def _figure_row(row: Comparison, mine: TrajectorySummary, truth: Sequence[TrajectorySummary]) -> FigureRow:
    found = [row.figure(replica) for replica in truth]
    mean = mean_of(found, row.unit)
    interval = prediction_interval([figure.number for figure in found]) if mean.defined else None
    return FigureRow(row.key, row.label, row.unit, row.figure(mine), mean, interval)


def acceptance(
    candidate: TrajectorySummary, replicas: Sequence[TrajectorySummary], scene: Scene
) -> Iterator[Requirement]:
    """What a surrogate of the drum has to show; a figure that the DEM has and the candidate lacks is a failure.

    No bound is tighter than what a further run of the DEM would keep (95 %), so that a noisy scene is not asked for
    what its own physics do not have.
    """
    if (failures := candidate.failures) is not None:
        broken = Measured(failures.non_finite_states + failures.missing_states, "states")
        yield _row("all_finite", "every state there and finite", broken, 0.0)
        key, label = "none_outside", "no centre more than a radius outside"
        if any(wall.contains for wall in scene.walls):
            yield _row(key, label, Measured(failures.outside_radius, "sphere states"), 0.0)
        else:
            unknown = Measured(None, "sphere states", "no wall of this scene has a side that is inside")
            yield Requirement(key, label, unknown, 0.0, "undefined")
    for (_, steady, peak, _), label in ((SURFACE, "angle of repose"), (CENTER, "centre-of-mass angle")):
        yield _angle_row(steady, f"{label}, steady", STEADY_WITHIN, candidate, replicas)
        yield _angle_row(peak, f"{label}, first peak", PEAK_WITHIN, candidate, replicas)
    # Of each replica from the others, as if it were a candidate.
    rests = [[*replicas[:k], *replicas[k + 1 :]] for k in range(len(replicas))] if len(replicas) > 1 else []
    own = [score(speed_distance, one, rest, "m/s") for one, rest in zip(replicas, rests, strict=False)]
    bound, why = _kept_by_the_dem(SPEED_WITHIN, own, 0.0, "m/s")
    distance = score(speed_distance, candidate, replicas, "m/s")
    yield _row("speed_w1", f"speeds, W1 a frame, at most {bound:.3g} m/s", distance, bound, why)


def _row(key: str, label: str, figure: Measured, bound: float, why: str = "") -> Requirement:
    verdict = "pass" if figure.defined and figure.number <= bound else "fail"
    note = "; ".join(filter(None, (figure.note, why)))
    return Requirement(key, label, replace(figure, note=note), bound, verdict)


def _angle_row(
    row: Comparison, label: str, asked: float, candidate: TrajectorySummary, replicas: Sequence[TrajectorySummary]
) -> Requirement:
    own = [row.figure(replica) for replica in replicas]
    truth = mean_of(own, "deg")
    if not truth.defined:
        return Requirement(row.key, f"{label}, within {asked:g}°", truth, asked, "undefined")
    bound, why = _kept_by_the_dem(asked, own, truth.number, "deg")
    return _row(row.key, f"{label}, within {bound:.3g}°", row.figure(candidate).difference(truth), bound, why)


def _kept_by_the_dem(asked: float, own: Sequence[Measured], middle: float, unit: str) -> tuple[float, str]:
    """The bound, and why it is not what is asked: how far from ``middle`` a further run of the DEM may lie."""
    defined = all(figure.defined for figure in own)
    interval = prediction_interval([figure.number for figure in own]) if defined else None
    if interval is None or interval.high - middle <= asked:
        return asked, ""
    bound = interval.high - middle
    return bound, f"not {asked:g} {unit}: runs of the DEM itself scatter more; a further one keeps {bound:.3g} {unit}"


def nearest_case(
    candidate: Trajectory, cases: Mapping[float, Trajectory], period: float = 0.0
) -> tuple[float | None, dict[float, Measured]]:
    """The case of the DEM (by its speed, rpm) with the speeds nearest to a rollout's, and the distances to all, m/s.

    The distance is the speed W1 a frame, with the ``period`` of the y axis in m; there is no nearest case where one of
    them is undefined. No case is a `ValueError`.
    """
    check_arguments(candidate=(candidate, Trajectory), cases=(cases, Mapping))
    if not cases:
        raise ValueError("no case to compare with; give runs of the DEM by their speed")
    mine, *theirs = (
        sorted_frames(speeds(velocities(run, candidate.velocity_kind, period))) for run in (candidate, *cases.values())
    )
    distances = {}
    for (rpm, case), other in zip(cases.items(), theirs, strict=True):
        distances[rpm] = wasserstein_series(candidate.time, mine, case.time, other).mean()
    defined = all(distance.defined for distance in distances.values())
    return min(distances, key=lambda rpm: distances[rpm].number) if defined else None, distances
