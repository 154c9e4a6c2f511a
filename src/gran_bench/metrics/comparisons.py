"""The rows of a judgement: what is compared of two runs, and which figures of one are held against the replicas."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gran_bench.config.registry import METRICS
from gran_bench.metrics.measured import LEAST_VALID_SHARE, Measured, Series, frame_at, within
from gran_bench.metrics.position_error import separation
from gran_bench.metrics.purpose import discharge_rate, packing_fraction
from gran_bench.metrics.speeds import wasserstein, wasserstein_series
from gran_bench.metrics.summary import TrajectorySummary

Measure = Callable[[TrajectorySummary], Measured | Series]
Between = Callable[[TrajectorySummary, TrajectorySummary], Measured]
OVER = ", over the series"


@dataclass(frozen=True)
class Comparison:
    """A row of a judgement: for machines, for people, in SI or the exception that it names.

    ``measure`` is what one run has, if it has something alone; ``between`` is the distance of two runs where it is not
    the difference of what each has.
    """

    key: str
    label: str
    unit: str
    measure: Measure | None = None
    between: Between | None = None

    @property
    def short_label(self) -> str:
        """The label of a series without the words that it is one."""
        return self.label.removesuffix(OVER)

    def figure(self, run: TrajectorySummary) -> Measured:
        """What a run has, of a series the mean over its states."""
        found = self.measure(run)
        return found.mean() if isinstance(found, Series) else found

    def distance(self, a: TrajectorySummary, b: TrajectorySummary) -> Measured:
        """How far two runs are apart; of series, the mean absolute difference over the states valid in both."""
        if self.between is not None:
            return self.between(a, b)
        mine, theirs = self.measure(a), self.measure(b)
        if isinstance(mine, Series) and isinstance(theirs, Series):
            return mine.difference(theirs)
        return self.figure(a).difference(self.figure(b))


def speed_distance(a: TrajectorySummary, b: TrajectorySummary) -> Measured:
    """Wasserstein-1 distance of the speeds a frame, mean over the frames, m/s."""
    return wasserstein_series(a.time, a.sorted_speed, b.time, b.sorted_speed).mean()


def _speed_distance_at_pattern(a: TrajectorySummary, b: TrajectorySummary) -> Measured:
    instant = a.phases.pattern_time
    frames = [frame_at(run.time, instant) for run in (a, b)]
    if None in frames:
        return Measured.undefined("m/s", f"no state at {instant:g} s")
    distance = wasserstein(a.sorted_speed[frames[0]], b.sorted_speed[frames[1]])
    return Measured.of(distance, "m/s", f"velocity is not finite at {instant:g} s")


def _speed_distance_pooled(a: TrajectorySummary, b: TrajectorySummary) -> Measured:
    """Of the finite states of the steady part, which must be nearly all."""
    pooled = []
    for run in (a, b):
        if run.phases.steady_from is None:
            return Measured.undefined("m/s", run.phases.not_steady_because)
        steady = run.sorted_speed[within(run.time, run.phases.steady_from, np.inf)]
        good = np.isfinite(steady).all(axis=1)
        bad = int((~good).sum())
        if bad > (1.0 - LEAST_VALID_SHARE) * len(steady):
            return Measured.undefined("m/s", f"velocity is not finite in {bad} of {len(steady)} states")
        pooled.append(np.sort(steady[good], axis=None))
    return Measured.of(wasserstein(*pooled), "m/s", "no finite state in the steady part")


def _component_distance(axis: int) -> Between:
    return lambda a, b: wasserstein_series(a.time, a.sorted_component[axis], b.time, b.sorted_component[axis]).mean()


def _layer_distance(a: TrajectorySummary, b: TrajectorySummary) -> Measured:
    """Mean over the layers that both have of the difference of their mean steady speeds."""
    for run in (a, b):
        if run.phases.steady_from is None:
            return Measured.undefined("m/s", run.phases.not_steady_because)
    mine, theirs = a.layer_speed, b.layer_speed
    shared = min(len(mine), len(theirs))
    gap = np.abs(mine[:shared] - theirs[:shared])
    if not np.isfinite(gap).any():
        return Measured.undefined("m/s", "no layer under a valid surface")
    return Measured(float(np.nanmean(gap)), "m/s", f"{int(np.isfinite(gap).sum())} layers")


def _position_distance(frame: int) -> Between:
    """Mean distance of the spheres ``frame`` frames after the settled state."""

    def distance(a: TrajectorySummary, b: TrajectorySummary) -> Measured:
        for run in (a, b):
            if run.position is None:
                return Measured.undefined("m", "statistics without particles")
            if len(run.time) <= frame:
                return Measured.undefined("m", f"no state {frame} frames after the start")
        if a.position.shape[1] != b.position.shape[1]:
            return Measured.undefined("m", "another number of spheres")
        apart = separation(a.position[[frame]], b.position[[frame]], a.period)[0]
        return Measured.of(apart, "m", "position is not finite, or missing, in 1 of 1 states")

    return distance


def _series(name: str) -> Measure:
    return lambda run: run.series[name]


def _steady(name: str) -> Measure:
    """Mean over the steady part."""

    def measure(run: TrajectorySummary) -> Measured:
        series = run.series[name]
        if run.phases.steady_from is None and not series.undefined_because:
            return Measured.undefined(series.unit, run.phases.not_steady_because)
        return series.mean(-np.inf if run.phases.steady_from is None else run.phases.steady_from)

    return measure


def _peak(name: str, part: int) -> Measure:
    """Largest value of the first peak (part 0), or when it is (part 1)."""

    def measure(run: TrajectorySummary) -> Measured:
        series = run.series[name]
        if run.phases.peak_before is None and not series.undefined_because:
            return Measured.undefined((series.unit, "s")[part], run.phases.no_peak_because)
        return series.largest(end=np.inf if run.phases.peak_before is None else run.phases.peak_before)[part]

    return measure


def _largest(name: str) -> Measure:
    return lambda run: run.series[name].largest()[0]


def _angles(name: str, label: str) -> tuple[Comparison, ...]:
    """Over the series, steady, the first peak, and when it is."""
    return (
        Comparison(name, f"{label}{OVER}", "deg", _series(name)),
        Comparison(f"{name}_steady", f"{label}, steady mean", "deg", _steady(name)),
        Comparison(f"{name}_peak", f"{label}, first peak", "deg", _peak(name, 0)),
        Comparison(f"{name}_peak_time", f"{label}, time of the peak", "s", _peak(name, 1)),
    )


def added() -> tuple[Comparison, ...]:
    """A row for each metric of a plugin, both of the distances and of the figures."""

    def row(name: str, unit: str) -> Comparison:
        nothing = Measured.undefined(unit, "statistics without particles")
        return Comparison(name, METRICS[name].label, unit, lambda run: run.series.get(name, nothing))

    return tuple(row(name, METRICS[name].unit) for name in METRICS.added())


SURFACE, CENTER = _angles("surface_angle", "angle of repose"), _angles("com_angle", "centre-of-mass angle")
COMPARISONS = (
    *(*SURFACE, *CENTER),
    Comparison("center_height", f"height of the centre of mass{OVER}", "m", _series("center_height")),
    DISCHARGE := Comparison("discharge_rate", f"discharge rate{OVER}", "kg/s", _series(discharge_rate.__name__)),
    PACKED := Comparison("packing_fraction", "packing fraction, at rest", "-", _steady(packing_fraction.__name__)),
    Comparison("speed_w1", "speeds, W1 a frame", "m/s", between=speed_distance),
    Comparison("speed_w1_pattern", "speeds a quarter into the scene, W1", "m/s", between=_speed_distance_at_pattern),
    Comparison("speed_w1_steady", "steady speeds, W1 pooled", "m/s", between=_speed_distance_pooled),
    Comparison("velocity_x_w1", "velocity along x, W1 a frame", "m/s", between=_component_distance(0)),
    Comparison("velocity_y_w1", "velocity along the axis y, W1 a frame", "m/s", between=_component_distance(1)),
    Comparison("velocity_z_w1", "velocity along z, W1 a frame", "m/s", between=_component_distance(2)),
    Comparison("layer_speed", "speed by depth, mean difference", "m/s", between=_layer_distance),
    Comparison("position_1", "position 1 frame after the start", "m", between=_position_distance(1)),
    Comparison("position_10", "position 10 frames after the start", "m", between=_position_distance(10)),
    Comparison("position_30", "position 30 frames after the start", "m", between=_position_distance(30)),
    Comparison("translational_energy", "translational energy over the series", "J", _series("translational_energy")),
    Comparison("rotational_energy", "rotational energy over the series", "J", _series("rotational_energy")),
    Comparison("mixing", "mixing entropy over the series", "-", _series("mixing")),
    Comparison("driving_torque", "torque that drives the drum, over the series", "N m", _series("driving_torque")),
)
FIGURES = (
    *(*SURFACE[1:], *CENTER[1:]),
    Comparison("mean_speed_steady", "mean speed, steady", "m/s", _steady("mean_speed")),
    Comparison("translational_energy_steady", "translational energy, steady", "J", _steady("translational_energy")),
    Comparison("rotational_energy_steady", "rotational energy, steady", "J", _steady("rotational_energy")),
    Comparison("overlap_mean", "overlap of pairs, mean", "m", _series("overlap_mean")),
    Comparison("overlap_max", "overlap of pairs, largest", "m", _largest("overlap_max")),
    Comparison("wall_overlap_mean", "overlap with walls, mean", "m", _series("wall_overlap_mean")),
    Comparison("wall_overlap_max", "overlap with walls, largest", "m", _largest("wall_overlap_max")),
    replace(DISCHARGE, label=f"{DISCHARGE.short_label}, mean"),
    PACKED,
    Comparison("mixing_end", "mixing entropy, steady", "-", _steady("mixing")),
    Comparison("driving_torque_steady", "torque that drives the drum, steady", "N m", _steady("driving_torque")),
    Comparison("driving_power_steady", "power that drives the drum, steady", "W", _steady("driving_power")),
)
