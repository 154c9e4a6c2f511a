"""What a method has to show: at most so many noise floors of the scene, or absolute bounds where they are asked for."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from gran_bench.config import RequirementsConfig
from gran_bench.metrics.comparisons import CENTER, COMPARISONS, SURFACE, Comparison, speed_distance
from gran_bench.metrics.floor import Floor
from gran_bench.metrics.judgement import Requirement
from gran_bench.metrics.measured import Measured, mean_of, prediction_interval, score
from gran_bench.metrics.sample import sample_rows
from gran_bench.metrics.summary import TrajectorySummary
from gran_bench.scene import Scene

ANGLES, SPEEDS = ("surface_angle", "com_angle"), "speed_w1"
WITHOUT_ANGLE = ("center_height", "discharge_rate", "packing_fraction")  # as far as a scene has them
FLOORS = "noise floors"
Runs = Sequence[TrajectorySummary]
Replays = Mapping[str, TrajectorySummary]


def held_rows(replicas: Runs) -> list[Comparison]:
    """The errors that a method is ranked by and held to: of both angles and the speeds.

    Without an angle they are of the bed's height, what the scene is for, and the speeds; those that the DEM itself
    has, which are 0 between a run and itself.
    """
    rows = {row.key: row for row in COMPARISONS}

    def known(*keys: str) -> list[Comparison]:
        return [rows[key] for key in keys if all(rows[key].distance(run, run).defined for run in replicas)]

    return [*(known(*ANGLES) or known(*WITHOUT_ANGLE)), *known(SPEEDS)]


def acceptance(
    candidate: TrajectorySummary, replicas: Runs, scene: Scene, replays: Replays, asked: RequirementsConfig,
    floor: Floor,
) -> Iterator[Requirement]:  # fmt: skip
    """What a method has to show; a figure that the DEM has and the candidate lacks is a failure.

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
    yield from sample_rows(candidate, replicas)
    absolute = list(_absolute_angles(candidate, replicas, asked))
    yield from absolute
    # A bound on what the DEM does not have holds nobody to anything.
    by_floors = all(row.verdict == "undefined" for row in absolute)
    for row in held_rows(replicas):
        if row.key == SPEEDS and asked.speed_w1 is not None:
            yield _speed_row(asked.speed_w1, candidate, replicas, floor)
        elif by_floors or row.key not in ANGLES:
            yield _floors_row(row, asked.floors, candidate, replicas, floor)
    if replays:
        yield from _replay_rows(candidate, replicas, replays, floor)


def _absolute_angles(candidate: TrajectorySummary, replicas: Runs, asked: RequirementsConfig) -> Iterator[Requirement]:
    for (_, steady, peak, _), label in ((SURFACE, "angle of repose"), (CENTER, "centre-of-mass angle")):
        if asked.steady_angle_deg is not None:
            yield _angle_row(steady, f"{label}, steady", asked.steady_angle_deg, candidate, replicas)
        if asked.peak_angle_deg is not None:
            yield _angle_row(peak, f"{label}, first peak", asked.peak_angle_deg, candidate, replicas)


def _row(key: str, label: str, figure: Measured, bound: float, why: str = "") -> Requirement:
    verdict = "pass" if figure.defined and figure.number <= bound else "fail"
    return Requirement(key, label, _noted(figure, why), bound, verdict)


def _noted(figure: Measured, why: str) -> Measured:
    return replace(figure, note="; ".join(filter(None, (figure.note, why))))


def _angle_row(row: Comparison, label: str, asked: float, candidate: TrajectorySummary, replicas: Runs) -> Requirement:
    own = [row.figure(replica) for replica in replicas]
    truth = mean_of(own, "deg")
    if not truth.defined:
        return Requirement(row.key, f"{label}, within {asked:g}°", truth, asked, "undefined")
    bound, why = _kept_by_the_dem(asked, own, truth.number, "deg")
    return _row(row.key, f"{label}, within {bound:.3g}°", row.figure(candidate).difference(truth), bound, why)


def _speed_row(asked: float, candidate: TrajectorySummary, replicas: Runs, floor: Floor) -> Requirement:
    own = floor.own(next(row for row in COMPARISONS if row.key == SPEEDS))
    bound, why = _kept_by_the_dem(asked, own, 0.0, "m/s")
    distance = score(speed_distance, candidate, replicas, "m/s")
    return _row(SPEEDS, f"speeds, W1 a frame, at most {bound:.3g} m/s", distance, bound, why)


def _floors_row(
    row: Comparison, asked: float, candidate: TrajectorySummary, replicas: Runs, floor: Floor
) -> Requirement:
    one, label = floor.of(row), row.short_label
    if not (one.defined and one.number):
        unknown = Measured(None, FLOORS, one.note or "runs of the DEM do not differ in it")
        return Requirement(row.key, f"{label}, at most {asked:g} {FLOORS}", unknown, asked, "undefined")
    own = [_in_floors(error, one) for error in floor.own(row)]
    bound, why = _kept_by_the_dem(asked, own, 0.0, FLOORS)
    error = _in_floors(score(row.distance, candidate, replicas, row.unit), one)
    return _row(row.key, f"{label}, at most {bound:.3g} {FLOORS}", error, bound, why)


def _in_floors(error: Measured, floor: Measured) -> Measured:
    return Measured(error.number / floor.number if error.defined else None, FLOORS, error.note)


def _kept_by_the_dem(asked: float, own: Sequence[Measured], middle: float, unit: str) -> tuple[float, str]:
    """The bound, and why it is not what is asked: how far from ``middle`` a further run of the DEM may lie."""
    defined = all(figure.defined for figure in own)
    interval = prediction_interval([figure.number for figure in own]) if defined else None
    if interval is None or interval.high - middle <= asked:
        return asked, ""
    bound = interval.high - middle
    return bound, f"not {asked:g} {unit}: runs of the DEM itself scatter more; a further one keeps {bound:.3g} {unit}"


def _replay_rows(candidate: TrajectorySummary, replicas: Runs, replays: Replays, floor: Floor) -> Iterator[Requirement]:
    """Runs of the DEM at other speeds err more, and the candidate's speeds are not theirs.

    The first row holds a model to be of use. The second finds a replay that errs less by chance. A replay that cannot
    be told from runs of the DEM holds nobody to anything.
    """
    held = [(row, one) for row in held_rows(replicas) if (one := floor.of(row)).defined and one.number]

    def worst(run: TrajectorySummary, truth: Runs) -> Measured:
        errors = [_in_floors(score(row.distance, run, truth, row.unit), one) for row, one in held]
        lacking = next((error for error in errors if not error.defined), None)
        return lacking or max(errors, key=lambda error: error.number)

    if held:
        errors = {name: worst(run, replicas) for name, run in replays.items()}
        errors = {name: error.number for name, error in errors.items() if error.defined}
        own = [worst(one, [*replicas[:k], *replicas[k + 1 :]]) for k, one in enumerate(replicas)]
        if errors:
            name = min(errors, key=errors.__getitem__)
            told = errors[name] > max(error.number for error in own)
            label = f"largest error, less than {errors[name]:.3g} {FLOORS} ({name})"
            yield _better("beats_replay", label, worst(candidate, replicas), errors[name], told)
    likeness = {name: speed_distance(candidate, run) for name, run in replays.items()}
    nearest = min(likeness, key=lambda name: likeness[name].value if likeness[name].defined else np.inf)
    mine, bound = score(speed_distance, candidate, replicas, "m/s"), likeness[nearest]
    told = all(
        speed_distance(one, replays[nearest]).number > np.mean([speed_distance(one, run).number for run in replicas])
        for one in replicas
    )
    label = f"speeds, nearer to the DEM than to {nearest}" + (f" ({bound.number:.3g} m/s)" if bound.defined else "")
    yield _better("not_a_replay", label, mine, bound.value or 0.0, told)


def _better(key: str, label: str, figure: Measured, bound: float, told: bool) -> Requirement:
    """Passed below the bound alone; undefined where runs of the DEM themselves would not pass."""
    if not told:
        unknown = Measured(None, figure.unit, "runs of the DEM itself cannot be told from it")
        return Requirement(key, label, unknown, bound, "undefined")
    return Requirement(key, label, figure, bound, "pass" if figure.defined and figure.number < bound else "fail")
