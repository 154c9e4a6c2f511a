"""The time scales of a flow, found from runs of the DEM: when it is steady, and when its first peak is over."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from gran_bench.config import RequirementsConfig
from gran_bench.metrics.measured import Measured, Series, within
from gran_bench.scene import Scene
from gran_bench.state import FloatArray

LATE = 0.5  # share of the span of constant speed, its end: what is steady, if anything is
SCATTERS = 3.0  # standard deviations of the late values that a steady state may lie off their mean
CREEP = 1.0  # standard deviations between the means of the two halves of the late values
NEGLIGIBLE = 0.01  # of all that a series passes through: the least that counts as its scatter
FEWEST = 8  # states at constant speed
PATTERN_AT = 0.25  # share of the scene's span; 2.5 s of the article's drum, its figures 2 and 3b


@dataclass(frozen=True)
class Phases:
    """When a flow is steady and when its first peak is over; one clock for all runs that are compared."""

    steady_from: float | None  # s; None where there is no steady part
    peak_before: float | None  # s; None where the flow has no first peak
    pattern_time: float  # s, the instant whose flow pattern and speeds are shown
    turns: float = 0.0  # of the wall from the start to the steady part
    not_steady_because: str = ""
    no_peak_because: str = ""

    def __str__(self) -> str:
        steady = f"no steady part ({self.not_steady_because})"
        if self.steady_from is not None:
            turns = f", after {self.turns:.2g} turns of the wall" if self.turns else ""
            steady = f"steady from {self.steady_from:.4g} s on{turns}"
        peak = f"no first peak ({self.no_peak_because})"
        return f"{steady}; {peak if self.peak_before is None else f'first peak before {self.peak_before:.4g} s'}"

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {**vars(self), "label": str(self)}


def find_phases(
    runs: Sequence[Mapping[str, Series | Measured]], scene: Scene, asked: RequirementsConfig | None = None
) -> Phases:
    """The phases of a flow, from what its runs of the DEM have measured (`TrajectorySummary.series`).

    Looked at is the centre-of-mass angle, or where there is none the height of the centre of mass and the mean speed,
    of the span of constant speed that ends the scene. Its later half gives mean and standard deviation, over states
    and runs. The flow is steady where the means of the two quarters of that half differ by at most one standard
    deviation, from the state on from which the mean over the runs stays within three. The first peak lies before
    that, and before the first change of a constant speed; an angle has one only if it falls again: the mean of the
    states after its highest lies lower by more than three times its scatter. Times that ``asked`` gives are taken
    instead.
    """
    asked = asked or RequirementsConfig()
    time, signals = _signals(runs)
    pattern = scene.start_time + scene.frame_interval * round(
        PATTERN_AT * (scene.end_time - scene.start_time) / scene.frame_interval
    )
    speed = np.round(scene.rotation.angular_speed(time), 12)
    if asked.steady_from is None:
        begin, why = _steady_state(signals, _last_change(speed))
        steady = None if why else float(time[begin])
    else:
        steady, why = asked.steady_from, _why_not_from(asked.steady_from, scene, time)
    found = Phases(None if why else steady, None, pattern, not_steady_because=why)
    if found.steady_from is not None:
        found = replace(found, turns=abs(scene.rotation.angle(scene.start_time, found.steady_from)) / (2.0 * math.pi))
    if asked.peak_before is not None:
        return replace(found, peak_before=asked.peak_before)
    change = _first_change(speed)
    ends = [found.steady_from, None if change is None else float(time[change]), scene.end_time + scene.frame_interval]
    before = min(end for end in ends if end is not None)
    if not within(time, -math.inf, before).any():
        return replace(found, no_peak_because="the flow is steady from its start")
    if "com_angle" in signals:
        why = _why_no_peak(signals["com_angle"][:, :change], int((time < before).sum()), found.steady_from is not None)
        if why:
            return replace(found, no_peak_because=why)
    return replace(found, peak_before=before)


def _why_no_peak(values: FloatArray, end: int, steady: bool) -> str:
    """Why an angle, ``(R, F)`` up to the first change of speed, has no peak in its first ``end`` states."""
    mean = values.mean(axis=0)
    mean = mean[: len(mean) if np.isfinite(mean).all() else int(np.argmin(np.isfinite(mean)))]
    if not len(mean[:end]):
        return "the angle is not finite at the start"
    highest = int(np.argmax(mean[:end]))
    late = mean[-max(FEWEST, round(LATE * len(mean))) :]
    # About a cubic, for a fall that is under way at the end is no scatter.
    place = np.linspace(-1.0, 1.0, len(late))
    residual = late - np.polynomial.Polynomial.fit(place, late, min(3, len(late) - 1))(place) if len(late) > 1 else 0.0
    scatter = max(float(np.std(residual)), NEGLIGIBLE * float(np.ptp(mean)))
    after = mean[highest + 1 :]
    if len(after) and mean[highest] - float(after.mean()) > SCATTERS * scatter:
        return ""
    if steady and len(after) and after.mean() > mean[highest]:
        return "the angle still rises where the flow counts as steady"
    quarter = max(1, len(late) // 2)
    if not steady and late[quarter:].size and late[quarter:].mean() > late[:quarter].mean():
        return "the angle still rises at the end"
    return "the angle does not fall from its highest value by more than it scatters"


def _signals(runs: Sequence[Mapping[str, Series | Measured]]) -> tuple[FloatArray, dict[str, FloatArray]]:
    """The clock that all runs share (s), and ``(R, F)`` of each series that tells whether a flow is steady."""
    shortest = min((run["mean_speed"].time for run in runs), key=len)
    angles = [run["com_angle"] for run in runs]
    names = ("center_height", "mean_speed")
    if not any(series.undefined_because for series in angles):
        names = ("com_angle",)
    return shortest, {name: np.array([run[name].value[: len(shortest)] for run in runs]) for name in names}


def _steady_state(signals: Mapping[str, FloatArray], first: int) -> tuple[int, str]:
    """The state from which all signals are steady, and why there is none."""
    begin = first
    for name, values in signals.items():
        found, why = _steady_one(values[:, first:], name.replace("_", " "))
        if why:
            return 0, why
        begin = max(begin, first + found)
    return begin, ""


def _steady_one(values: FloatArray, name: str) -> tuple[int, str]:
    """Of one signal, ``(R, F)`` at constant speed."""
    count = values.shape[1]
    if count < FEWEST:
        return 0, f"the speed is constant in the last {count} states alone"
    half = count - round(LATE * count)
    late, middle = values[:, half:], half + (count - half) // 2
    if not np.isfinite(late).all():
        return 0, f"{name} is not finite in every late state"
    mean, known = float(late.mean()), values[np.isfinite(values)]
    scatter = max(float(late.std()), NEGLIGIBLE * float(known.max() - known.min()))
    if abs(float(values[:, half:middle].mean() - values[:, middle:].mean())) > CREEP * scatter:
        return 0, f"{name} still changes in the later half of the span of constant speed"
    away = np.flatnonzero(~(np.abs(values[:, :half].mean(axis=0) - mean) <= SCATTERS * scatter))
    return (int(away[-1]) + 1 if len(away) else 0), ""


def _last_change(speed: FloatArray) -> int:
    """The first state of the span of constant speed that ends a schedule, of the speed in each state."""
    other = np.flatnonzero(speed != speed[-1])
    return int(other[-1]) + 1 if len(other) else 0


def _first_change(speed: FloatArray) -> int | None:
    """The state in which the first constant speed but 0 ends; None where it does not."""
    turning = next((i for i, (a, b) in enumerate(pairwise(speed)) if a == b != 0.0), None)
    if turning is None:
        return None
    other = np.flatnonzero(speed[turning:] != speed[turning])
    return turning + int(other[0]) if len(other) else None


def _why_not_from(start: float, scene: Scene, time: FloatArray) -> str:
    """Why a scene is not steady from a given time (s) on: its speed changes after it, or it ends before."""
    if scene.end_time < start + 0.5 * scene.frame_interval:
        return f"the scene ends at {scene.end_time:g} s, before the steady part from {start:g} s on"
    knots = [t for t in scene.rotation.times if start < t < scene.end_time]
    if len({round(float(scene.rotation.angular_speed(t)), 12) for t in (start, *knots, scene.end_time)}) > 1:
        return f"the speed is not constant after {start:g} s"
    return "" if within(time, start, np.inf).any() else f"no state after {start:g} s"
