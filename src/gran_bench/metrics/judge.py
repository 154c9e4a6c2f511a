"""The judge: one candidate against the replicas of the DEM, every figure in its unit and in noise floors."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from gran_bench.config import RequirementsConfig
from gran_bench.config.rules import check_arguments
from gran_bench.metrics.comparisons import COMPARISONS, FIGURES, Comparison, added
from gran_bench.metrics.floor import Floor, beside_floor
from gran_bench.metrics.judgement import ErrorRow, FigureRow, Judgement
from gran_bench.metrics.measured import Measured, mean_of, prediction_interval, score, shared_states
from gran_bench.metrics.outside import distance_outside
from gran_bench.metrics.phases import find_phases
from gran_bench.metrics.requirements import acceptance
from gran_bench.metrics.speeds import sorted_frames, speeds, velocities, wasserstein_series
from gran_bench.metrics.summary import TrajectorySummary, of_one_bed, summarise
from gran_bench.scene import Scene
from gran_bench.state import Trajectory

Run = Trajectory | TrajectorySummary
NO_REPLAYS = "whether a run at another speed does as well; give replays={name: run of the DEM}"


def judge(
    candidate: Run, replicas: Sequence[Run], scene: Scene, others: Mapping[str, Run] | None = None,
    replays: Mapping[str, Run] | None = None, asked: RequirementsConfig | None = None, packings: Sequence[Run] = (),
    floor: Floor | None = None,
) -> Judgement:  # fmt: skip
    """Hold a candidate against the replicas of the DEM.

    Velocities are compared by the candidate's definition on both sides. Summaries may be given instead of
    trajectories, so that replicas are summarised once for many candidates; they must then have that definition.

    Args:
        candidate: a rollout, another run of the DEM, or a baseline's statistics.
        replicas: runs of the DEM from one settled state; two or more for a noise floor.
        scene: that all were made for.
        others: further runs of the DEM by name, each a column of its own beside the noise floor.
        replays: the DEM's runs at the speeds of training, by name, which a model has to be better than; without them
            the judgement says that this was not asked.
        asked: what counts as met; by default so many noise floors of the scene.
        packings: runs of the DEM from different packings, which give the noise floor where nudges hardly grow.
        floor: of these replicas and packings beside as many spheres as the candidate has, known from before.

    Raises:
        ValueError: no replica, or runs that are not of the scene or not comparable.
    """
    others, replays, asked = others or {}, replays or {}, asked or RequirementsConfig()
    check_arguments(candidate=(candidate, Run), replicas=(replicas, list[Run]), scene=(scene, Scene))
    check_arguments(packings=(packings, list[Run]))
    check_arguments(others=(others, Mapping), replays=(replays, Mapping), asked=(asked, RequirementsConfig))
    for what, given in (("others", others), ("replays", replays)):
        check_arguments(**{f"{what}[{name}]": (run, Run) for name, run in given.items()})
    if not replicas:
        raise ValueError("no replica to judge against; make at least one run of the DEM")
    kind = candidate.velocity_kind
    runs = {"candidate": candidate, **{f"replica {i}": run for i, run in enumerate(replicas)}, **others, **replays}
    runs |= {f"packing {i}": run for i, run in enumerate(packings)}
    for name, run in runs.items():
        _hold_scene(name, run, scene, is_dem=run is not candidate)
    mine, *theirs = (
        run if isinstance(run, TrajectorySummary) else summarise(run, scene, kind) for run in runs.values()
    )
    for name, summary in zip(runs, (mine, *theirs), strict=True):
        _hold_alike(name, summary, mine)
    # One clock for all: a run's own would compare a mean over one span with a mean over another.
    phases = find_phases([run.series for run in theirs[: len(replicas)]], scene, asked)
    mine, *theirs = (replace(run, phases=phases) for run in (mine, *theirs))
    truth, more = theirs[: len(replicas)], theirs[len(replicas) :]
    beside, again = dict(zip(others, more, strict=False)), dict(zip(replays, more[len(others) :], strict=False))
    mine, own = beside_floor(mine, truth, more[len(others) + len(replays) :])
    floor = floor or own
    failures, plugins = [run.failures for run in truth], added()
    return Judgement(
        errors=[_error_row(row, mine, truth, beside, floor) for row in (*COMPARISONS, *plugins)],
        figures=[_figure_row(row, mine, truth) for row in (*FIGURES, *plugins)],
        requirements=list(acceptance(mine, truth, scene, again, asked, floor)),
        failures=mine.failures,
        dem_outside=None if None in failures else float(np.mean([count.share(count.outside) for count in failures])),
        velocity_kind=kind,
        replicas=len(truth),
        phases=phases,
        floor_between=floor.words,
        not_asked="" if replays or scene.rotation.is_still else NO_REPLAYS,
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
    """Refuse runs of different spheres, times or velocities; one that ended early is counted as such.

    Fewer and larger spheres of the same volume are the same bed, coarse-grained.
    """
    own, other = (run.sorted_speed.shape[1] for run in (mine, summary))
    if own != other and not of_one_bed(mine, summary):
        told = f"candidate has {own} spheres and {name} has {other}"
        raise ValueError(f"{told}; compare runs of one scene's spheres, or of fewer spheres of the same volume")
    if summary.velocity_kind != mine.velocity_kind:
        kinds = f"({mine.velocity_kind}, {summary.velocity_kind}) are not comparable"
        raise ValueError(f"speeds of two definitions {kinds}; summarise both with one velocity_kind")
    shared_states(mine.time, summary.time)


def _error_row(
    row: Comparison,
    mine: TrajectorySummary,
    truth: Sequence[TrajectorySummary],
    beside: Mapping[str, TrajectorySummary],
    floor: Floor,
) -> ErrorRow:
    error = score(row.distance, mine, truth, row.unit)
    further = {name: score(row.distance, run, truth, row.unit) for name, run in beside.items()}
    return ErrorRow(row.key, row.label, row.unit, error, floor.of(row), further)


def _figure_row(row: Comparison, mine: TrajectorySummary, truth: Sequence[TrajectorySummary]) -> FigureRow:
    found = [row.figure(replica) for replica in truth]
    mean = mean_of(found, row.unit)
    interval = prediction_interval([figure.number for figure in found]) if mean.defined else None
    return FigureRow(row.key, row.label, row.unit, row.figure(mine), mean, interval)


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
