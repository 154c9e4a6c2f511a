"""Whether a candidate is a sample of the flow: spheres that start at the settled bed, move as they say and keep apart.

A predictor of the mean, a run that starts later and one that jumps between runs are closer to replicas, or as close,
as a run of the DEM. None of them is a trajectory of the scene. The mean of several runs puts spheres into each other.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from gran_bench.metrics.judgement import Requirement
from gran_bench.metrics.measured import Measured
from gran_bench.metrics.position_error import separation
from gran_bench.metrics.summary import TrajectorySummary

START_WITHIN = 0.01  # diameters, mean over the spheres
START_APART = 2.0  # times the distance of the replicas themselves, where they start farther apart
JUMPS = 10.0  # times the DEM's own
ROUNDING = 1.0e-4  # diameters a frame, of stored positions: mean velocities of the DEM follow from them exactly
DEEPEST = 0.5  # diameters: two centres nearer than half a diameter
DEEPER = 2.0  # times the DEM's own largest overlap, where its spheres are that soft
SAMPLE = ("is_sample", "starts_settled", "moves_by_velocity")  # keys of the requirements on a sample


def sample_rows(candidate: TrajectorySummary, replicas: Sequence[TrajectorySummary]) -> Iterator[Requirement]:
    """The requirements on a sample; a candidate of other spheres starts from a bed of its own."""
    if candidate.position is None:
        nothing = Measured(None, "spheres", "statistics without particles, which their energy score judges")
        yield Requirement("is_sample", "a trajectory of spheres", nothing, 0.0, "fail")
        return
    truth = [run for run in replicas if run.position is not None]
    if not truth or not len(candidate.time):
        return
    if len({run.position.shape[1] for run in (candidate, *truth)}) == 1:
        start = Measured.of(_apart_at_start(candidate, truth), "d", "position is not finite")
        own = _apart_at_start(truth[0], truth[1:]) if len(truth) > 1 else 0.0
        bound = max(START_WITHIN, START_APART * own)
        verdict = "pass" if start.defined and start.number <= bound else "fail"
        yield Requirement("starts_settled", f"starts at the settled bed, within {bound:.2g} d", start, bound, verdict)
    if len(candidate.time) > 1:
        own = float(np.mean([run.jump for run in truth]))
        found, bound = Measured.of(candidate.jump, "d", "not finite in a state"), max(ROUNDING, JUMPS * own)
        verdict = "pass" if found.defined and found.number <= bound else "fail"
        yield Requirement("moves_by_velocity", f"moves as its velocities say, within {bound:.2g} d a frame", found,
                          bound, verdict)  # fmt: skip
    own = [run.series["overlap_max"].largest()[0] for run in truth]
    if all(figure.defined for figure in own):
        found = candidate.series["overlap_max"].largest()[0]
        found = replace(found, value=found.number / candidate.diameter, unit="d") if found.defined else found
        bound = max(DEEPEST, DEEPER * max(figure.number for figure in own) / candidate.diameter)
        verdict = "pass" if found.defined and found.number <= bound else "fail"
        yield Requirement(
            "keeps_apart", f"largest overlap of two spheres, at most {bound:.2g} d", found, bound, verdict
        )


def _apart_at_start(run: TrajectorySummary, others: Sequence[TrajectorySummary]) -> float:
    """Mean distance of the spheres of two first states, d."""
    apart = [separation(run.position[:1], other.position[:1], run.period)[0] for other in others]
    return float(np.mean(apart)) / run.diameter
