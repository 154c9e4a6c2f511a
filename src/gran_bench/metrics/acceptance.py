"""What a surrogate of the drum has to show: pass, fail, or undefined where the DEM has no such figure.

No bound is tighter than what a further run of the DEM would keep (95 %), so that a noisy scene is not asked for what
its own physics do not have.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from gran_bench.metrics.comparisons import CENTER, SURFACE, Comparison, speed_distance
from gran_bench.metrics.measured import Measured, mean_of
from gran_bench.metrics.noise_floor import prediction_interval, score
from gran_bench.metrics.summary import TrajectorySummary

STEADY_WITHIN = 3.0  # deg
PEAK_WITHIN = 10.0  # deg
SPEED_WITHIN = 0.08  # m/s


@dataclass(frozen=True)
class Requirement:
    """One requirement: the largest figure that passes, what was found, and how it came out.

    The verdict is ``pass``, ``fail``, or ``undefined`` where the DEM itself has no such figure.
    """

    key: str
    label: str
    figure: Measured
    bound: float
    verdict: str


def acceptance(candidate: TrajectorySummary, replicas: Sequence[TrajectorySummary]) -> Iterator[Requirement]:
    """Every requirement, in order; a figure that the DEM has and the candidate lacks is a failure."""
    if (failures := candidate.failures) is not None:
        broken = Measured(failures.non_finite_states + failures.missing_states, "states")
        yield _row("all_finite", "every state there and finite", broken, 0.0)
        escaped = Measured(failures.outside_radius, "sphere states")
        yield _row("none_outside", "no centre more than a radius outside", escaped, 0.0)
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
