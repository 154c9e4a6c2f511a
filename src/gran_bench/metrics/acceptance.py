"""What a surrogate of the drum has to show: pass, fail, or undefined where the DEM has no such figure.

No bound is tighter than what a further run of the DEM would keep (95 %), so that a noisy scene is not asked for what
its own physics do not have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from gran_bench.metrics.comparisons import Scalar, peak, speed_distance, steady
from gran_bench.metrics.measured import Measured, mean_of
from gran_bench.metrics.noise_floor import prediction_interval, score
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
                f"{label}, steady",
                steady(name),
                STEADY_WITHIN,
                candidate,
                replicas,
            )
        )
        rows.append(
            _angle_row(
                f"{name}_peak",
                f"{label}, first peak",
                peak(name),
                PEAK_WITHIN,
                candidate,
                replicas,
            )
        )
    distance = score(speed_distance, candidate, replicas, "m/s")
    bound, why = _kept_by_the_dem(SPEED_WITHIN, _speed_distances(replicas), 0.0, "m/s")
    rows.append(_row("speed_w1", f"speeds, W1 a frame, at most {bound:.3g} m/s", distance, bound, why))
    return rows


def _row(key: str, label: str, figure: Measured, bound: float, why: str = "") -> Requirement:
    verdict = "pass" if figure.defined and figure.number <= bound else "fail"
    note = "; ".join(filter(None, (figure.note, why)))
    return Requirement(key, label, replace(figure, note=note), bound, verdict)


def _kept_by_the_dem(asked: float, own: Sequence[Measured], middle: float, unit: str) -> tuple[float, str]:
    """The bound: what is asked, or how far from ``middle`` a further run of the DEM may lie where that is more.

    Args:
        asked: bound of a scene without noise.
        own: the figure of each replica.
        middle: that distances are taken from.
        unit: of the figure.

    Returns:
        The bound, and why it is not what is asked; empty where it is.
    """
    if not all(figure.defined for figure in own):
        return asked, ""
    interval = prediction_interval([figure.number for figure in own])
    if interval is None or interval.high - middle <= asked:
        return asked, ""
    bound = interval.high - middle
    return bound, f"not {asked:g} {unit}: runs of the DEM itself scatter more; a further one keeps {bound:.3g} {unit}"


def _speed_distances(replicas: Sequence[TrajectorySummary]) -> list[Measured]:
    """Of each replica from the others, as if it were a candidate; none of a single one."""
    if len(replicas) < 2:
        return []
    others = [[*replicas[:k], *replicas[k + 1 :]] for k in range(len(replicas))]
    return [score(speed_distance, one, rest, "m/s") for one, rest in zip(replicas, others, strict=True)]


def _angle_row(
    key: str,
    label: str,
    measure: Scalar,
    asked: float,
    candidate: TrajectorySummary,
    replicas: Sequence[TrajectorySummary],
) -> Requirement:
    own = [measure(replica) for replica in replicas]
    truth = mean_of(own, "deg")
    if not truth.defined:
        return Requirement(key, f"{label}, within {asked:g}°", truth, asked, "undefined")
    bound, why = _kept_by_the_dem(asked, own, truth.number, "deg")
    found = measure(candidate)
    if found.defined:
        found = Measured(abs(found.number - truth.number), "deg", found.note)
    return _row(key, f"{label}, within {bound:.3g}°", found, bound, why)
