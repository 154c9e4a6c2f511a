"""Methods without particles: what they claim of the flow, beside the replicas of the DEM, in a class of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gran_bench.metrics.comparisons import COMPARISONS, Comparison
from gran_bench.metrics.measured import LEAST_VALID_SHARE, Measured, Series
from gran_bench.metrics.statistics import energy_score, spread_ratio
from gran_bench.metrics.summary import TrajectorySummary
from gran_bench.state import FloatArray

SPEEDS = "speed_w1"
Claims = Mapping[str, FloatArray]  # by key of the row: members (M, F), or of the speeds (M, F, Q) rising quantiles


@dataclass(frozen=True)
class EnsembleRow:
    """One quantity of an ensemble beside the replicas."""

    key: str
    label: str
    unit: str
    score: Measured  # energy score, in the unit
    multiple: float | None  # of half the noise floor: 1 is a run of the DEM; None where either is undefined
    mean_error: float | None  # of the members' mean, in units of that of a replica's others
    mean_multiple: float | None  # as multiple, of a replica's others, without a spread
    spread: float | None  # ratio to the replicas' spread, 1 is right; None where they have none
    members: int  # M


def judge_ensemble(
    claims: Claims, replicas: Sequence[TrajectorySummary], rows: Sequence[Comparison] = ()
) -> list[EnsembleRow]:
    """Hold an ensemble of statistics against two or more replicas, by its energy score and its spread.

    Args:
        claims: members by key of a row of the judgement: ``(M, F)`` of a series, in its unit and on the replicas'
            clock; of ``speed_w1`` ``(M, F, Q)`` quantiles at levels (k + ½)/Q, m/s. One member claims no spread.
        replicas: runs of the DEM.
        rows: what is judged; all that ``claims`` has where empty.

    Raises:
        ValueError: a key that no row has, or arrays of another clock; fewer than two replicas.
    """
    known = {row.key: row for row in COMPARISONS}
    missing = [key for key in claims if key not in known]
    if missing:
        raise ValueError(f"claims has {missing[0]!r}; choose from {', '.join(known)}")
    if len(replicas) < 2:
        raise ValueError(f"replicas has {len(replicas)} runs, which have no spread; give two or more")
    keys = [row.key for row in rows] or list(claims)
    return [_row(known[key], claims.get(key), replicas) for key in keys]


def claims_of(summary: TrajectorySummary, rows: Sequence[Comparison]) -> Claims:
    """What a summary claims, as an ensemble of one member, which has no spread."""
    return {row.key: _of_run(row, summary)[None] for row in rows}


def _row(row: Comparison, members: FloatArray | None, replicas: Sequence[TrajectorySummary]) -> EnsembleRow:
    if members is None:
        nothing = Measured.undefined(row.unit, "the method says nothing of it")
        return EnsembleRow(row.key, row.label, row.unit, nothing, None, None, None, None, 0)
    members = np.asarray(members, np.float64)
    quantiles = members.shape[2] if members.ndim == 3 else None
    truth = np.array([_of_run(row, run, quantiles) for run in replicas])
    few = f"no finite figure in more than {1.0 - LEAST_VALID_SHARE:.0%} of the states"
    score = Measured.of(energy_score(members, truth), row.unit, few)
    rest = range(len(truth))
    # Of a run among the others as one member: its mean distance, half of which is what a run of the DEM scores.
    floor = float(np.mean([energy_score(truth[k][None], np.delete(truth, k, axis=0)) for k in rest]))
    mean = [energy_score(np.delete(truth, k, axis=0).mean(axis=0)[None], truth[k][None]) for k in rest]
    ratio, own = spread_ratio(members, truth), float(np.mean(mean))
    return EnsembleRow(
        *(row.key, row.label, row.unit, score),
        multiple=_ratio(score.value, 0.5 * floor),
        mean_error=_ratio(energy_score(members.mean(axis=0)[None], truth), own),
        mean_multiple=_ratio(own, 0.5 * floor),
        spread=ratio if np.isfinite(ratio) else None,
        members=len(members),
    )


def _ratio(value: float | None, unit: float) -> float | None:
    found = np.nan if value is None or not unit > 0.0 else value / unit
    return float(found) if np.isfinite(found) else None


def _of_run(row: Comparison, run: TrajectorySummary, quantiles: int | None = None) -> FloatArray:
    """``(F,)`` of a series; of the speeds ``(F, Q)`` at levels (k + ½)/Q, all of them where Q is None."""
    if row.key == SPEEDS:
        speed = run.sorted_speed.astype(np.float64)
        if quantiles is None:
            return speed
        level = (np.arange(quantiles) + 0.5) / quantiles
        return speed[:, np.minimum((level * speed.shape[1]).astype(np.int64), speed.shape[1] - 1)]
    series = row.measure(run) if row.measure else None
    if not isinstance(series, Series):
        raise ValueError(f"{row.key!r} is no series, so no ensemble has it; choose a series or {SPEEDS}")
    return np.where(series.valid, series.value, np.nan)


def plain(rows: Sequence[EnsembleRow]) -> dict[str, Any]:
    """Plain values for JSON, by key."""
    return {row.key: asdict(row) | {"score": row.score.value, "note": row.score.note} for row in rows}
