"""The figures of a judgement: distances between two trajectories, and scalars of one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gran_bench.config.registry import METRICS
from gran_bench.metrics.measured import LEAST_VALID_SHARE, Measured, Series, frame_at, within
from gran_bench.metrics.position_error import separation_series
from gran_bench.metrics.speeds import wasserstein, wasserstein_series
from gran_bench.metrics.summary import PATTERN_TIME, PEAK_BEFORE, STEADY_FROM, TrajectorySummary

Distance = Callable[[TrajectorySummary, TrajectorySummary], Measured]
Scalar = Callable[[TrajectorySummary], Measured]


@dataclass(frozen=True)
class Comparison:
    """A distance between two trajectories: its key, its name for people, its unit and how to compute it."""

    key: str
    label: str
    unit: str
    distance: Distance


@dataclass(frozen=True)
class Figure:
    """A scalar of one trajectory, held against the replicas' interval."""

    key: str
    label: str
    unit: str
    measure: Scalar


def speed_distance(a: TrajectorySummary, b: TrajectorySummary) -> Measured:
    """Wasserstein-1 distance of the speeds a frame, mean over the frames, m/s."""
    _same_kind(a, b)
    return wasserstein_series(a.time, a.sorted_speed, b.time, b.sorted_speed).mean()


def speed_distance_at_pattern(a: TrajectorySummary, b: TrajectorySummary) -> Measured:
    """Wasserstein-1 distance of the speeds at 2.5 s, m/s."""
    _same_kind(a, b)
    frames = [frame_at(summary.time, PATTERN_TIME) for summary in (a, b)]
    if None in frames:
        return Measured.undefined("m/s", f"no state at {PATTERN_TIME:g} s")
    distance = wasserstein(a.sorted_speed[frames[0]], b.sorted_speed[frames[1]])
    return Measured.of(distance, "m/s", f"velocity is not finite at {PATTERN_TIME:g} s")


def speed_distance_pooled(a: TrajectorySummary, b: TrajectorySummary) -> Measured:
    """Wasserstein-1 distance of all speeds of the steady part, m/s."""
    _same_kind(a, b)
    for summary in (a, b):
        if summary.steady_undefined_because:
            return Measured.undefined("m/s", summary.steady_undefined_because)
        steady = summary.sorted_speed[within(summary.time, STEADY_FROM, np.inf)]
        bad = int((~np.isfinite(steady).all(axis=1)).sum())
        if bad > (1.0 - LEAST_VALID_SHARE) * len(steady):
            return Measured.undefined("m/s", f"velocity is not finite in {bad} of {len(steady)} states")
    return Measured.of(wasserstein(a.steady_speed, b.steady_speed), "m/s", "no finite state in the steady part")


def component_distance(axis: int) -> Distance:
    """Wasserstein-1 distance a frame of one component of velocity, mean over the frames, m/s."""

    def distance(a: TrajectorySummary, b: TrajectorySummary) -> Measured:
        _same_kind(a, b)
        return wasserstein_series(a.time, a.sorted_component[axis], b.time, b.sorted_component[axis]).mean()

    return distance


def layer_distance(a: TrajectorySummary, b: TrajectorySummary) -> Measured:
    """Mean over the layers that both have of the difference of their mean steady speeds, m/s."""
    for summary in (a, b):
        if summary.steady_undefined_because:
            return Measured.undefined("m/s", summary.steady_undefined_because)
    shared = min(len(a.layer_speed), len(b.layer_speed))
    gap = np.abs(a.layer_speed[:shared] - b.layer_speed[:shared])
    if not np.isfinite(gap).any():
        return Measured.undefined("m/s", "no layer under a valid surface")
    return Measured(float(np.nanmean(gap)), "m/s", f"{int(np.isfinite(gap).sum())} layers")


def series_distance(name: str) -> Distance:
    """Mean absolute difference of a series over the states valid in both."""
    return lambda a, b: a.series[name].difference(b.series[name])


def scalar_distance(measure: Scalar) -> Distance:
    """Absolute difference of a scalar."""

    def distance(a: TrajectorySummary, b: TrajectorySummary) -> Measured:
        mine, theirs = measure(a), measure(b)
        for figure in (mine, theirs):
            if not figure.defined:
                return figure
        return Measured(abs(mine.number - theirs.number), mine.unit, mine.note)

    return distance


def position_distance(frame: int) -> Distance:
    """Mean distance of the spheres ``frame`` frames after the settled state, m."""

    def distance(a: TrajectorySummary, b: TrajectorySummary) -> Measured:
        for summary in (a, b):
            if summary.position is None:
                return Measured.undefined("m", "statistics without particles")
            if len(summary.time) <= frame:
                return Measured.undefined("m", f"no state {frame} frames after the start")
        span = slice(frame, frame + 1)
        series = separation_series(a.time[span], a.position[span], b.time[span], b.position[span], a.period)
        return series.mean()

    return distance


def steady(name: str) -> Scalar:
    """Mean of a series over t ≥ 3.5 s, where the speed is constant there."""

    def measure(summary: TrajectorySummary) -> Measured:
        series = summary.series[name]
        if summary.steady_undefined_because and not series.undefined_because:
            return Measured.undefined(series.unit, summary.steady_undefined_because)
        return series.mean(STEADY_FROM)

    return measure


def peak(name: str) -> Scalar:
    """Largest value of a series before 3 s."""
    return lambda summary: summary.series[name].largest(end=PEAK_BEFORE)[0]


def peak_time(name: str) -> Scalar:
    """When a series is largest before 3 s, s."""
    return lambda summary: summary.series[name].largest(end=PEAK_BEFORE)[1]


def over_all(name: str) -> Scalar:
    """Mean of a series over all states."""
    return lambda summary: summary.series[name].mean()


def ever(name: str) -> Scalar:
    """Largest value of a series."""
    return lambda summary: summary.series[name].largest()[0]


def registered_figure(name: str, unit: str) -> Scalar:
    """What a registered metric says of one trajectory; the mean of a series over all its states."""

    def measure(summary: TrajectorySummary) -> Measured:
        found = summary.registered.get(name, Measured.undefined(unit, "statistics without particles"))
        return found.mean() if isinstance(found, Series) else found

    return measure


def registered_distance(name: str, unit: str) -> Distance:
    """Difference of what a registered metric says of two trajectories; of series, the mean over the states."""

    def distance(a: TrajectorySummary, b: TrajectorySummary) -> Measured:
        mine, theirs = a.registered.get(name), b.registered.get(name)
        if isinstance(mine, Series) and isinstance(theirs, Series):
            return mine.difference(theirs)
        return scalar_distance(registered_figure(name, unit))(a, b)

    return distance


def comparisons() -> tuple[Comparison, ...]:
    """Every distance of a judgement: the house's, then one for each registered metric."""
    return COMPARISONS + tuple(
        Comparison(name, metric.label, metric.unit, registered_distance(name, metric.unit))
        for name, metric in METRICS.items()
    )


def figures() -> tuple[Figure, ...]:
    """Every scalar of a judgement: the house's, then one for each registered metric."""
    return FIGURES + tuple(
        Figure(name, metric.label, metric.unit, registered_figure(name, metric.unit))
        for name, metric in METRICS.items()
    )


COMPARISONS = (
    Comparison("surface_angle", "angle of repose, over the series", "deg", series_distance("surface_angle")),
    Comparison("surface_angle_steady", "angle of repose, steady mean", "deg", scalar_distance(steady("surface_angle"))),
    Comparison("surface_angle_peak", "angle of repose, first peak", "deg", scalar_distance(peak("surface_angle"))),
    Comparison(
        "surface_angle_peak_time", "angle of repose, time of the peak", "s", scalar_distance(peak_time("surface_angle"))
    ),
    Comparison("com_angle", "centre-of-mass angle, over the series", "deg", series_distance("com_angle")),
    Comparison("com_angle_steady", "centre-of-mass angle, steady mean", "deg", scalar_distance(steady("com_angle"))),
    Comparison("com_angle_peak", "centre-of-mass angle, first peak", "deg", scalar_distance(peak("com_angle"))),
    Comparison(
        "com_angle_peak_time", "centre-of-mass angle, time of the peak", "s", scalar_distance(peak_time("com_angle"))
    ),
    Comparison("center_height", "height of the centre of mass, over the series", "m", series_distance("center_height")),
    Comparison("speed_w1", "speeds, W1 a frame", "m/s", speed_distance),
    Comparison("speed_w1_pattern", f"speeds at {PATTERN_TIME:g} s, W1", "m/s", speed_distance_at_pattern),
    Comparison("speed_w1_steady", "steady speeds, W1 pooled", "m/s", speed_distance_pooled),
    Comparison("velocity_x_w1", "velocity along x, W1 a frame", "m/s", component_distance(0)),
    Comparison("velocity_y_w1", "velocity along the axis y, W1 a frame", "m/s", component_distance(1)),
    Comparison("velocity_z_w1", "velocity along z, W1 a frame", "m/s", component_distance(2)),
    Comparison("layer_speed", "speed by depth, mean difference", "m/s", layer_distance),
    Comparison("position_1", "position 1 frame after the start", "m", position_distance(1)),
    Comparison("position_10", "position 10 frames after the start", "m", position_distance(10)),
    Comparison("position_30", "position 30 frames after the start", "m", position_distance(30)),
    Comparison(
        "translational_energy", "translational energy over the series", "J", series_distance("translational_energy")
    ),
    Comparison("rotational_energy", "rotational energy over the series", "J", series_distance("rotational_energy")),
    Comparison("mixing", "mixing entropy over the series", "-", series_distance("mixing")),
)

FIGURES = (
    Figure("surface_angle_steady", "angle of repose, steady mean", "deg", steady("surface_angle")),
    Figure("surface_angle_peak", "angle of repose, first peak", "deg", peak("surface_angle")),
    Figure("surface_angle_peak_time", "angle of repose, time of the peak", "s", peak_time("surface_angle")),
    Figure("com_angle_steady", "centre-of-mass angle, steady mean", "deg", steady("com_angle")),
    Figure("com_angle_peak", "centre-of-mass angle, first peak", "deg", peak("com_angle")),
    Figure("com_angle_peak_time", "centre-of-mass angle, time of the peak", "s", peak_time("com_angle")),
    Figure("mean_speed_steady", "mean speed, steady", "m/s", steady("mean_speed")),
    Figure("translational_energy_steady", "translational energy, steady", "J", steady("translational_energy")),
    Figure("rotational_energy_steady", "rotational energy, steady", "J", steady("rotational_energy")),
    Figure("overlap_mean", "overlap of pairs, mean", "m", over_all("overlap_mean")),
    Figure("overlap_max", "overlap of pairs, largest", "m", ever("overlap_max")),
    Figure("wall_overlap_mean", "overlap with walls, mean", "m", over_all("wall_overlap_mean")),
    Figure("wall_overlap_max", "overlap with walls, largest", "m", ever("wall_overlap_max")),
    Figure("mixing_end", "mixing entropy, steady", "-", steady("mixing")),
)


def _same_kind(a: TrajectorySummary, b: TrajectorySummary) -> None:
    if a.velocity_kind != b.velocity_kind:
        raise ValueError(
            f"speeds of two definitions ({a.velocity_kind}, {b.velocity_kind}) are not comparable; "
            "summarise both with one velocity_kind"
        )
