"""What a benchmark allows to say, in words: at equal accuracy, at equal time, when training is paid back."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

from gran_bench.benchmark.claims import (
    Entry,
    EqualAccuracy,
    best_in_time,
    crossing,
    equal_accuracy,
    fastest_rival,
    frontier,
    not_told_apart,
    paid_back,
    speed_up,
)
from gran_bench.benchmark.results import entries, succeeded

BUSY = 0.05  # share of the time that methods waited for the processor, from which on pages say so


def winner(found: dict[str, Any]) -> str:
    """The fastest method of the DEM's own accuracy, and all methods whose times cannot be told from it."""
    every, accepted = entries(found), found["reference"]["accepted"]
    if accepted is None:
        return f"Who wins is not known: {why_no_accuracy(found)}."
    exact = [entry for entry in every if entry.floors is not None and entry.floors <= accepted]
    if not exact:
        return f"No method has the DEM's own accuracy.{_perhaps(every, None, accepted)}"
    first = min(exact, key=lambda entry: entry.seconds)
    same = not_told_apart(first, exact)
    said = f"Fastest of the DEM's own accuracy ({accepted:.2f} floors){', not told apart' * (len(same) > 1)}: "
    said += "; ".join(f"**{entry.name}** ({_cost(entry)})" for entry in same)
    rival = fastest_rival(every, accepted, accepted)
    if rival is None or rival in same:
        return f"{said}.{_perhaps(every, first, accepted)}"
    said += f". Fastest DEM of that accuracy: **{rival.name}** ({_time(rival.seconds)}, {rival.floors:.2f} floors)"
    return f"{said}.{_perhaps(every, first, accepted)}"


def why_no_accuracy(found: dict[str, Any]) -> str:
    """Why the DEM's own accuracy is not known."""
    return f"{found['reference']['replicas']} replicas do not give the DEM's own accuracy; three or more do"


def _cost(entry: Entry) -> str:
    """Time and error of a method, and what an answer of it lacks or took."""
    said = f"{_time(entry.seconds)} a simulated second, {entry.floors:.2f} floors"
    said += f", after {entry.data_seconds:.0f} s of data" if entry.kind == "baseline" and entry.data_seconds else ""
    return said + (", and statistics without spheres" if entry.name.startswith("interpolation") else "")


def _perhaps(every: list[Entry], first: Entry | None, accepted: float) -> str:
    """Who is faster than the first and may be as exact: its interval reaches the DEM's own accuracy, its error not."""
    near = [entry for entry in every if entry.floors is not None and entry.least <= accepted < entry.floors]
    if first is not None:
        near = [entry for entry in near if speed_up(first, entry).high < 1.0]
    if not near:
        return ""
    words = [f"**{e.name}** ({_time(e.seconds)}, {e.floors:.2f} floors, {e.least:.2f} to {e.most:.2f})" for e in near]
    return f" {'Faster and p' if first else 'P'}erhaps of that accuracy, by their intervals: {', '.join(words)}."


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
        beside = equal_accuracy(entry, every, accepted)
        parts = (_equal_accuracy(beside), _equal_time(entry, every), _paid(beside))
        yield " ".join([f"{said} the frontier.", *parts])


def _equal_accuracy(beside: EqualAccuracy) -> str:
    rival, lenient = beside.rival, beside.lenient
    if lenient is None:
        return "No DEM of the ladder is as exact."
    if beside.faster == "undecided":
        perhaps = f"{_beside(beside.entry, lenient)}, which is as exact within the intervals"
        if rival is None:
            return f"At equal accuracy it is undecided who is faster: no DEM errs by as little; {perhaps}."
        return f"At equal accuracy it is undecided who is faster: {_beside(beside.entry, rival)}; {perhaps}."
    shown = rival or lenient
    within = "" if rival else ", as exact within the intervals"
    return f"At equal accuracy the rival is {shown.name} ({_numbers(shown)}{within}): {_verdict(beside.entry, shown)}."


def _beside(entry: Entry, rival: Entry) -> str:
    return f"{_verdict(entry, rival)} beside {rival.name} ({_numbers(rival)})"


def _numbers(entry: Entry) -> str:
    return f"{_time(entry.seconds)}, {entry.floors:.2f} floors"


def _verdict(entry: Entry, rival: Entry) -> str:
    ratio = speed_up(entry, rival)
    if not ratio.decides:
        return "neither is faster: the ranges overlap"
    if ratio.middle > 1.0:
        return f"the surrogate is {ratio.middle:.2g} times as fast ({ratio.low:.2g} to {ratio.high:.2g})"
    return f"**the DEM is {1 / ratio.middle:.2g} times as fast** ({1 / ratio.high:.2g} to {1 / ratio.low:.2g})"


def _equal_time(entry: Entry, every: list[Entry]) -> str:
    rival = best_in_time(every, entry.seconds)
    if rival is None:
        return "No DEM of the ladder is as fast."
    return f"In no more time, {rival.name} errs by {rival.floors:.2f} floors."


def _paid(beside: EqualAccuracy) -> str:
    entry, seconds = beside.entry, paid_back(beside)
    spent = f"{entry.data_seconds:.0f} s of data and {entry.training_seconds:.0f} s of training"
    if seconds is None:
        return f"It took {spent}."
    if math.isnan(seconds):
        return f"Whether its {spent} are ever paid back is undecided."
    if math.isinf(seconds):
        return f"Its {spent} are never paid back."
    return f"Its {spent} are paid back after {seconds:,.0f} simulated seconds."


def stiffness_sentences(found: dict[str, Any]) -> Iterator[str]:
    """From which stiffness on a surrogate takes less time than the DEM, beside the fastest DEM that is as exact.

    Times alone: errors were measured at the scene's own modulus, and nowhere else.
    """
    study, modulus = found["stiffness"], _modulus(found["modulus"])
    soft, accepted = softened(found), found["reference"]["accepted"]
    for name, points in study.items():
        if name in ("automatic", "largest") or not succeeded(points[0]):
            continue
        level = points[0]["wall"]["median"]
        for label, words in (("largest", "its largest allowed step"), ("automatic", "its automatic step")):
            done = [point for point in study[label] if succeeded(point)]
            at = crossing([p["at"] for p in done], [p["wall"]["median"] for p in done], level) if done else None
            where = "at no stiffness that was timed" if at is None else f"from {_modulus(at)} on"
            yield f"- **{name}** ({_time(level)} a simulated second) takes less time than the DEM at {words} {where}."
        yield (
            f"- That is time alone: errors were measured at {modulus}, what **{name}** was trained on, and the flow of "
            "stiffer spheres was not judged."
        )
        if soft is not None:
            costs = f"{_time(soft.seconds)}, {'less' if soft.seconds < level else 'more'} than **{name}**"
            yield (
                f"- The fastest DEM as exact as the DEM itself at {modulus} ({soft.name}, {soft.floors:.2f} of "
                f"{accepted:.2f} floors) takes {costs}; whether it can stand in for stiffer spheres was not measured."
            )
    names = {"automatic": "the DEM at its automatic step", "largest": "the DEM at its largest allowed step"}
    yield from _failed_points(study, names, _modulus)


def count_sentences(found: dict[str, Any]) -> Iterator[str]:
    """What a surrogate costs in units of the DEM's cost at its automatic step, for each number of spheres."""
    study = found["counts"]
    dem = {point["at"]: point["wall"]["median"] for point in study.get("DEM", []) if succeeded(point)}
    for name, points in study.items():
        shares = [(p["at"], p["wall"]["median"] / dem[p["at"]]) for p in points if succeeded(p) and p["at"] in dem]
        if name != "DEM" and shares:
            words = ", ".join(f"{share:.2g} with {count:g} spheres" for count, share in shares)
            yield f"- **{name}** takes these times the time of the DEM at its automatic step: {words}."
    yield from _failed_points(study, {"DEM": "the DEM at its automatic step"}, lambda count: f"{count:g} spheres")


def _failed_points(study: dict[str, Any], names: dict[str, str], words: Callable[[float], str]) -> Iterator[str]:
    for name, points in study.items():
        for point in points:
            if not succeeded(point):
                who = names.get(name, f"**{name}**")
                yield f"- ✗ {who[0].upper()}{who[1:]} failed at {words(point['at'])}: {point['failure']}."


def _modulus(modulus: float) -> str:
    return f"E = {modulus:.1e} Pa"


def busy_sentences(found: dict[str, Any]) -> Iterator[str]:
    """That the machine had other work, where methods waited for the processor more than a share of their time."""
    if found["waited"] > BUSY:
        share = f"{100 * found['waited']:.0f} % of their time"
        yield f"Methods waited {share} for the processor: the machine had other work."


def equal_accuracy_words(beside: EqualAccuracy) -> str:
    """Who is faster at equal accuracy, in a cell of a table."""
    rival = beside.rival or beside.lenient
    if rival is None:
        return "no DEM is as exact"
    if beside.faster in ("undecided", "neither"):
        return "neither is faster" if beside.faster == "neither" else "undecided"
    ratio = speed_up(beside.entry, rival).middle
    who, times = (rival.name, 1 / ratio) if ratio < 1.0 else ("the surrogate", ratio)
    return f"{who} is {times:.2g} times as fast"


def softened(found: dict[str, Any]) -> Entry | None:
    """The fastest DEM of the DEM's own accuracy; None where there is none, or that accuracy is not known."""
    accepted = found["reference"]["accepted"]
    return None if accepted is None else fastest_rival(entries(found), accepted, accepted)


def _time(seconds: float) -> str:
    if seconds < 1e-3:
        return f"{1e6 * seconds:.2g} µs"
    return f"{1e3 * seconds:.3g} ms" if seconds < 0.1 else f"{seconds:.3g} s"
