"""What a surrogate of the drum has to show: pass, fail, or undefined where the DEM has no such figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gran_bench.metrics.comparisons import Scalar, peak, speed_distance, steady
from gran_bench.metrics.measured import Measured, mean_of
from gran_bench.metrics.noise_floor import score
from gran_bench.metrics.summary import TrajectorySummary

STEADY_WITHIN = 3.0  # deg
PEAK_WITHIN = 10.0  # deg
SPEED_WITHIN = 0.08  # m/s


@dataclass(frozen=True)
class Requirement:
    """One requirement and how it came out.

    Attributes:
        key: for machines.
        label: for people, the bound included.
        figure: what was found.
        bound: largest figure that passes.
        verdict: ``pass``, ``fail``, or ``undefined`` where the DEM itself has no such figure.
    """

    key: str
    label: str
    figure: Measured
    bound: float
    verdict: str


def acceptance(candidate: TrajectorySummary, replicas: Sequence[TrajectorySummary]) -> list[Requirement]:
    """Every requirement, in order; a figure that the DEM has and the candidate lacks is a failure."""
    rows = []
    if candidate.failures is not None:
        failures = candidate.failures
        missing = max(0, failures.expected_states - failures.states)
        broken = Measured(failures.non_finite_states + missing, "states")
        rows.append(_row("all_finite", "every state there and finite", broken, 0.0))
        escaped = Measured(failures.outside_radius, "sphere states")
        rows.append(_row("none_outside", "no centre more than a radius outside", escaped, 0.0))
    angles = (("surface_angle", "angle of repose"), ("com_angle", "centre-of-mass angle"))
    for name, label in angles:
        rows.append(
            _angle_row(
                f"{name}_steady",
                f"{label}, steady, within {STEADY_WITHIN:g}°",
                steady(name),
                STEADY_WITHIN,
                candidate,
                replicas,
            )
        )
        rows.append(
            _angle_row(
                f"{name}_peak",
                f"{label}, first peak, within {PEAK_WITHIN:g}°",
                peak(name),
                PEAK_WITHIN,
                candidate,
                replicas,
            )
        )
    distance = score(speed_distance, candidate, replicas, "m/s")
    rows.append(_row("speed_w1", f"speeds, W1 a frame, at most {SPEED_WITHIN:g} m/s", distance, SPEED_WITHIN))
    return rows


def _row(key: str, label: str, figure: Measured, bound: float) -> Requirement:
    return Requirement(key, label, figure, bound, "pass" if figure.defined and figure.number <= bound else "fail")


def _angle_row(
    key: str,
    label: str,
    measure: Scalar,
    bound: float,
    candidate: TrajectorySummary,
    replicas: Sequence[TrajectorySummary],
) -> Requirement:
    truth = mean_of([measure(replica) for replica in replicas], "deg")
    if not truth.defined:
        return Requirement(key, label, truth, bound, "undefined")
    found = measure(candidate)
    if not found.defined:
        return Requirement(key, label, found, bound, "fail")
    return _row(key, label, Measured(abs(found.number - truth.number), "deg", found.note), bound)
