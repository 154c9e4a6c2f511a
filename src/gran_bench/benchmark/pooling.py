"""Judgements of several rounds of one method as one: what is averaged, and what is the worst of the rounds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

# How each table of a pooled judgement is made of the rounds'; it stands beside them.
RULES = {"errors": "mean", "figures": "mean", "requirements": "worst round", "failures": "worst round, each count"}
Row = dict[str, Any]


def pooled_judgement(judgements: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One judgement of several, in the layout of a single one (`Judgement.to_dict`), with the rule of each table.

    Args:
        judgements: of the rounds of one method, held against the same replicas.
    """
    found = judgements[0] | {"rounds": len(judgements), "pooled": RULES}
    for table, pool in {"errors": mean_error, "figures": mean_figure, "requirements": worst_requirement}.items():
        found[table] = _by_key([judgement[table] for judgement in judgements], pool)
    found["accepted"] = all(judgement["accepted"] for judgement in judgements)
    counts = [judgement["failures"] for judgement in judgements]
    found["failures"] = None if None in counts else worst_failures(counts)
    return found


def mean_error(rows: Sequence[Row]) -> Row:
    """One kind of error over several rounds: means; undefined as in the first round that lacks it."""
    found = mean_value(rows)
    if found["value"] is not None and found["multiple_of_floor"] is not None:
        found["multiple_of_floor"] = float(np.mean([row["multiple_of_floor"] for row in rows]))
    return found


def mean_figure(rows: Sequence[Row]) -> Row:
    """A figure over several rounds: the mean, and whether each round is inside the replicas' interval."""
    found, inside = mean_value(rows), [row["inside_interval"] for row in rows]
    return found | {"inside_interval": None if None in inside else all(inside), "rounds_inside": inside.count(True)}


def mean_value(rows: Sequence[Row]) -> Row:
    """A row with the mean of the values; as in the first round without a value, where there is such a round."""
    missing = next((row for row in rows if row["value"] is None), None)
    return dict(missing or rows[0], **({} if missing else {"value": float(np.mean([row["value"] for row in rows]))}))


def worst_requirement(rows: Sequence[Row]) -> Row:
    """A requirement in the round that is farthest beyond its bound; a round without a figure is the worst."""
    missing = next((row for row in rows if row["value"] is None), None)
    return missing or max(rows, key=lambda row: row["value"])


def worst_failures(counts: Sequence[Row]) -> Row:
    """Each count in the round where it is worst: the largest, the fewest states, the first time without a figure."""
    found = {name: max(count[name] for count in counts) for name in counts[0] if name != "first_non_finite"}
    times = [count["first_non_finite"] for count in counts if count["first_non_finite"] is not None]
    return found | {"states": min(count["states"] for count in counts), "first_non_finite": min(times, default=None)}


def _by_key(tables: Sequence[dict[str, Row]], pool: Callable[[Sequence[Row]], Row]) -> dict[str, Row]:
    return {key: pool([table[key] for table in tables]) for key in tables[0]}
