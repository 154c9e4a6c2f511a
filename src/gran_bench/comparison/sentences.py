"""What a benchmark allows to say, in words: at equal accuracy, at equal time, when training is paid back."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from gran_bench.comparison.claims import (
    Entry,
    best_in_time,
    break_even,
    crossing,
    fastest_rival,
    frontier,
    speed_up,
)
from gran_bench.comparison.results import entries


def winner(found: dict[str, Any]) -> str:
    """Who gives an answer of the DEM's own accuracy in the least time."""
    every, accepted = entries(found), found["reference"]["accepted"]
    exact = [entry for entry in every if entry.floors is not None and entry.floors <= accepted]
    if not exact:
        return "No method has the DEM's own accuracy."
    first = min(exact, key=lambda entry: entry.seconds)
    said = f"Of the DEM's own accuracy ({accepted:.2f} floors) the fastest is **{first.name}**: {_time(first.seconds)}"
    said += f" a simulated second, {first.floors:.2f} floors"
    if first.kind == "dem":
        return said + "."
    rival = fastest_rival(every, accepted, accepted)
    if first.kind == "baseline":
        said += f", after {first.data_seconds:.0f} s of data; it gives statistics and no spheres"
    if rival is None:
        return said + "."
    return f"{said}. The fastest DEM there is **{rival.name}**: {_time(rival.seconds)}, {rival.floors:.2f} floors."


def verdicts(found: dict[str, Any]) -> Iterator[str]:
    """A paragraph for each surrogate: what it is against the fastest DEM as exact, and the most exact DEM as fast."""
    every, accepted = entries(found), found["reference"]["accepted"]
    front = {entry.name for entry in frontier(every)}
    for row in found["methods"]:
        if row["kind"] != "surrogate":
            continue
        if row["unfit_because"]:
            yield f"- **{row['name']}** does not fit this scene: {row['unfit_because']}."
            continue
        entry = next((entry for entry in every if entry.name == row["name"]), None)
        if entry is None or entry.floors is None:
            yield f"- **{row['name']}** failed: {row['failure']}."
            continue
        place = "is on" if entry.name in front else "is not on"
        said = f"- **{entry.name}**: {entry.floors:.2f} floors in {_time(entry.seconds)} a simulated second; it {place}"
        parts = (_equal_accuracy(entry, every, accepted), _equal_time(entry, every), _paid(entry, every, accepted))
        yield " ".join([f"{said} the frontier.", *parts])


def _equal_accuracy(entry: Entry, every: list[Entry], accepted: float) -> str:
    rival = fastest_rival(every, entry.floors, accepted)
    if rival is None:
        return "No DEM of the ladder is as exact."
    ratio = speed_up(entry, rival)
    numbers = f"{_time(rival.seconds)}, {rival.floors:.2f} floors"
    if not ratio.decides:
        verdict = "neither is faster: the ranges overlap"
    elif ratio.middle > 1.0:
        verdict = f"the surrogate is {ratio.middle:.2g} times as fast ({ratio.low:.2g} to {ratio.high:.2g})"
    else:
        verdict = f"**the DEM is {1 / ratio.middle:.2g} times as fast** ({1 / ratio.high:.2g} to {1 / ratio.low:.2g})"
    return f"At equal accuracy the rival is {rival.name} ({numbers}): {verdict}."


def _equal_time(entry: Entry, every: list[Entry]) -> str:
    rival = best_in_time(every, entry.seconds)
    if rival is None:
        return "No DEM of the ladder is as fast."
    return f"In no more time, {rival.name} errs by {rival.floors:.2f} floors."


def _paid(entry: Entry, every: list[Entry], accepted: float) -> str:
    rival = fastest_rival(every, entry.floors, accepted)
    spent = f"{entry.data_seconds:.0f} s of data and {entry.training_seconds:.0f} s of training"
    if rival is None:
        return f"It took {spent}."
    seconds = break_even(entry, rival)
    if math.isinf(seconds):
        return f"Its {spent} are never paid back."
    return f"Its {spent} are paid back after {seconds:,.0f} simulated seconds."


def stiffness_sentences(found: dict[str, Any]) -> Iterator[str]:
    """From which stiffness on a surrogate costs less than the DEM, and what the softened DEM makes of it."""
    study = found["stiffness"]
    soft, accepted = softened(found), found["reference"]["accepted"]
    for name, points in study.items():
        if name in ("automatic", "largest") or points[0]["wall"] is None:
            continue
        level = points[0]["wall"]["median"]
        for label, words in (("largest", "its largest allowed step"), ("automatic", "its automatic step")):
            done = [point for point in study[label] if point["wall"]]
            at = crossing([p["at"] for p in done], [p["wall"]["median"] for p in done], level) if done else None
            where = "at no stiffness that was tried" if at is None else f"from E = {at:.1e} Pa on"
            yield f"- **{name}** ({_time(level)} a simulated second) costs less than the DEM at {words} {where}."
        if soft is not None:
            costs = f"{_time(soft.seconds)}, {'less' if soft.seconds < level else 'more'} than **{name}**"
            yield (
                f"- The fastest DEM as exact as the DEM itself ({soft.name}, {soft.floors:.2f} of {accepted:.2f} "
                f"floors) can stand in for any stiffer material: it costs {costs}."
            )


def count_sentences(found: dict[str, Any]) -> Iterator[str]:
    """What a surrogate costs in units of the DEM's cost at its automatic step, for each number of spheres."""
    dem = {point["at"]: point["wall"]["median"] for point in found["counts"].get("DEM", []) if point["wall"]}
    for name, points in found["counts"].items():
        shares = [(p["at"], p["wall"]["median"] / dem[p["at"]]) for p in points if p["wall"] and p["at"] in dem]
        if name != "DEM" and shares:
            words = ", ".join(f"{share:.2g} with {count:g} spheres" for count, share in shares)
            yield f"- **{name}** takes these times the time of the DEM at its automatic step: {words}."


def softened(found: dict[str, Any]) -> Entry | None:
    """The fastest DEM of the DEM's own accuracy: it stands in for any stiffer material."""
    accepted = found["reference"]["accepted"]
    return fastest_rival(entries(found), accepted, accepted)


def _time(seconds: float) -> str:
    if seconds < 1e-3:
        return f"{1e6 * seconds:.2g} µs"
    return f"{1e3 * seconds:.3g} ms" if seconds < 0.1 else f"{seconds:.3g} s"
