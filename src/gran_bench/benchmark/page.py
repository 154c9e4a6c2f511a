"""What the page says of each benchmark, and its table as CSV, made from results alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from textwrap import shorten
from typing import Any

import pandas as pd

from gran_bench.benchmark import claims
from gran_bench.benchmark.claims import Entry, EqualAccuracy
from gran_bench.benchmark.results import SPREAD, entries, read_all, succeeded
from gran_bench.files import write_atomically, write_part
from gran_bench.plots.time_error import frontier
from gran_bench.provenance import stamp

PAGE, TABLE = "README.md", "methods.csv"
FIGURES = {
    "time_error": "Time against error.",
    "stiffness": "Cost against stiffness.",
    "counts": "Cost against the number of spheres.",
}
BUSY = 0.05  # share of the time that methods waited for the processor, from which on pages say so
AUTOMATIC, LARGEST = "the DEM at its automatic step", "the DEM at its largest allowed step"
Found = dict[str, Any]  # as in ``benchmark.json``


def write_page(root: Path) -> Path:
    """Renew a part for each benchmark on the page of a folder, from all results below it."""
    for place, found in read_all(root).items():
        write_part(root / PAGE, found["scene"], part_text(place, found), "Run time against error", found["scene"])
    return root / PAGE


def write_table(path: Path, found: Found) -> None:
    """Write the methods of one benchmark as CSV: a row each, errors in their unit and in floors."""
    write_atomically(path, lambda file: table_of(found).to_csv(file, index=False))


def table_of(found: Found) -> pd.DataFrame:
    """A row for each method: times in s for a simulated second, memory in bytes, every error, failures."""
    every, accepted = entries(found), found["reference"]["accepted"]
    front, judged = {entry.name for entry in frontier(every)}, {e.name: e for e in every if e.floors is not None}
    rows = []
    for row in found["methods"]:
        entry = judged.get(row["name"])
        spent = entry is not None and entry.data_seconds + entry.training_seconds
        flat = {"scene": found["scene"], "method": row["name"], "kind": row["kind"], "failed": row["failed"]}
        flat |= {"reason": row["unfit_because"] or row["failure"], "on_frontier": row["name"] in front}
        flat |= {f"seconds_{name}": (row["wall"] or {}).get(name) for name in SPREAD}
        flat |= {f"relative_{name}": (row["relative"] or {}).get(name) for name in SPREAD}
        names = ("cpu_seconds", "peak_bytes", "own_bytes", "data_seconds", "training_seconds")
        flat |= {name: row[name] for name in names}
        beside = claims.equal_accuracy(entry, every, accepted) if spent else None
        flat["break_even_seconds"] = beside and claims.paid_back(beside)
        flat |= {name: row[name] for name in ("floors", "floors_low", "floors_high", "by", "outside")}
        for key, error in ((row["judgement"] or {}).get("errors") or {}).items():
            unit = error["unit"].replace("/", "_per_")
            flat |= {f"{key}_{unit}": error["value"], f"{key}_floors": error["multiple_of_floor"]}
        rows.append(flat)
    return pd.DataFrame(rows)


def part_text(place: str, found: Found) -> str:
    """What the page says of one benchmark; its place is ``profile/scene``."""
    reference = found["reference"]
    labels, noise = " and ".join(row["label"] for row in reference["ranked"]), f"undefined, {why_no_accuracy(found)}."
    if reference["accepted"] is not None:
        noise = f"{reference['noise']:.2f} floors; the DEM's own accuracy: {reference['accepted']:.2f} floors."
    setting = f"{found['spheres']} spheres, {found['simulated_seconds']:g} s, {found['motion']}, "
    setting += f"E = {found['modulus']:.0e} Pa; {found['rounds']} rounds. Error: the worse of {labels}, "
    setting += f"beside {reference['replicas']} replicas. Noise: {noise}"
    lines = [winner(found), "", *verdicts(found), "", setting.replace("e+0", "e"), "", *_table(found)]
    for study, sentences in (("stiffness", stiffness_sentences), ("counts", count_sentences)):
        lines += ["", *sentences(found)] if found[study] else []
    shown = [figure for figure in FIGURES if figure == "time_error" or found[figure]]
    lines += ["", *(f"![{FIGURES[figure]}]({place}/{figure}.png)" for figure in shown), ""]
    made = " ".join([stamp(found["provenance"]), *busy_sentences(found)])
    return "\n".join([*lines, f"{made} [CSV]({place}/{TABLE}), [JSON]({place}/benchmark.json)."]).strip()


def _table(found: Found) -> Iterator[str]:
    """The methods on the frontier (bold), the DEM at its automatic step and what is no DEM; then every failure."""
    yield "| method | time, s (another run) | × the DEM | error, floors |"
    yield "|---|---:|---:|---|"
    front, failed = {entry.name for entry in frontier(entries(found))}, []
    for row in found["methods"]:
        if row["failed"]:
            failed.append(f"- ✗ {row['name']} failed: {shorten(row['failure'], 80, placeholder=' …')}")
        elif row["name"] in front or row["name"] == found["automatic"] or row["kind"] != "dem":
            name, time, relative, error = row["name"], "", "", "time alone"
            name = f"**{name}**" if name in front else name
            if wall := row["wall"]:
                time = f"{wall['median']:.3g}"
                if wall["expected_low"] is not None:
                    time += f" ({wall['expected_low']:.3g} to {wall['expected_high']:.3g})"
            if row["relative"]:
                relative = f"{row['relative']['median']:.3g}"
            if row["unfit_because"]:
                error = f"does not fit: {row['unfit_because']}"
            elif row["floors"] is not None:
                error = f"{row['floors']:.2f} ({row['floors_low']:.2f} to {row['floors_high']:.2f})"
            yield f"| {name} | {time} | {relative} | {error} |"
    yield from ["", *failed]


def winner(found: Found) -> str:
    """The fastest method of the DEM's own accuracy, and all methods whose times cannot be told from it."""
    every, accepted = entries(found), found["reference"]["accepted"]
    if accepted is None:
        return f"Who wins is not known: {why_no_accuracy(found)}."
    sound = sorted((entry for entry in every if entry.floors is not None), key=lambda entry: entry.seconds)
    exact = [entry for entry in sound if entry.floors <= accepted]
    # Whose interval reaches the DEM's own accuracy, and whose error does not.
    perhaps, word = [entry for entry in every if entry in sound and entry.least <= accepted < entry.floors], "P"
    said = "No method has the DEM's own accuracy"
    if exact:
        first, rival = exact[0], claims.fastest_rival(every, accepted, accepted)
        same, word = claims.not_told_apart(first, exact), "Faster and p"
        perhaps = [entry for entry in perhaps if claims.speed_up(first, entry).high < 1.0]
        said = f"Fastest of the DEM's own accuracy ({accepted:.2f} floors){', not told apart' * (len(same) > 1)}: "
        said += "; ".join(f"**{entry.name}** ({_cost(entry)})" for entry in same)
        if rival is not None and rival not in same:
            said += f". Fastest DEM of that accuracy: **{rival.name}** ({_numbers(rival)})"
    names = ", ".join(f"**{e.name}** ({_numbers(e)}, {e.least:.2f} to {e.most:.2f})" for e in perhaps)
    return f"{said}." + (f" {word}erhaps of that accuracy, by their intervals: {names}." if perhaps else "")


def why_no_accuracy(found: Found) -> str:
    """Why the DEM's own accuracy is not known."""
    return f"{found['reference']['replicas']} replicas do not give the DEM's own accuracy; three or more do"


def verdicts(found: Found) -> Iterator[str]:
    """A paragraph for each surrogate: what it is against the fastest DEM as exact, and the most exact DEM as fast."""
    every, accepted = entries(found), found["reference"]["accepted"]
    front, judged = {entry.name for entry in frontier(every)}, {e.name: e for e in every if e.floors is not None}
    for row in found["methods"]:
        if row["kind"] != "surrogate":
            continue
        entry, name = judged.get(row["name"]), f"- **{row['name']}**"
        if row["unfit_because"]:
            yield f"{name} does not fit this scene: {row['unfit_because']}."
        elif entry is None:
            yield f"{name} failed: {row['failure']}."
        else:
            beside, quick = claims.equal_accuracy(entry, every, accepted), claims.best_in_time(every, entry.seconds)
            place = f"it is{'' if entry.name in front else ' not'} on the frontier"
            said = f"{name}: {entry.floors:.2f} floors in {_time(entry.seconds)} a simulated second; {place}."
            in_time = "No DEM of the ladder is as fast."
            if quick is not None:
                in_time = f"In no more time, {quick.name} errs by {quick.floors:.2f} floors."
            yield " ".join([said, _equal_accuracy(beside), in_time, _paid(beside)])


def _equal_accuracy(beside: EqualAccuracy) -> str:
    entry, rival, lenient = beside.entry, beside.rival, beside.lenient
    if lenient is None:
        return "No DEM of the ladder is as exact."
    if beside.faster == "undecided":
        dems = [f"{_verdict(entry, dem)} beside {dem.name} ({_numbers(dem)})" for dem in (rival, lenient) if dem]
        dems = dems if rival else ["no DEM errs by as little", *dems]
        said = f"At equal accuracy it is undecided who is faster: {'; '.join(dems)}"
        return f"{said}, which is as exact within the intervals."
    shown, within = (rival, "") if rival else (lenient, ", as exact within the intervals")
    return f"At equal accuracy the rival is {shown.name} ({_numbers(shown)}{within}): {_verdict(entry, shown)}."


def _verdict(entry: Entry, rival: Entry) -> str:
    ratio = claims.speed_up(entry, rival)
    if not ratio.decides:
        return "neither is faster: the ranges overlap"
    if ratio.middle > 1.0:
        return f"the surrogate is {ratio.middle:.2g} times as fast ({ratio.low:.2g} to {ratio.high:.2g})"
    return f"**the DEM is {1 / ratio.middle:.2g} times as fast** ({1 / ratio.high:.2g} to {1 / ratio.low:.2g})"


def _paid(beside: EqualAccuracy) -> str:
    entry, seconds = beside.entry, claims.paid_back(beside)
    spent = f"{entry.data_seconds:.0f} s of data and {entry.training_seconds:.0f} s of training"
    if seconds is None:
        return f"It took {spent}."
    if math.isnan(seconds):
        return f"Whether its {spent} are ever paid back is undecided."
    return f"Its {spent} are " + (
        "never paid back." if math.isinf(seconds) else f"paid back after {seconds:,.0f} simulated seconds."
    )


def equal_accuracy_words(beside: EqualAccuracy) -> str:
    """Who is faster at equal accuracy, in a cell of a table."""
    rival = beside.rival or beside.lenient
    if rival is None:
        return "no DEM is as exact"
    if beside.faster in ("undecided", "neither"):
        return "neither is faster" if beside.faster == "neither" else "undecided"
    ratio = claims.speed_up(beside.entry, rival).middle
    who, times = (rival.name, 1 / ratio) if ratio < 1.0 else ("the surrogate", ratio)
    return f"{who} is {times:.2g} times as fast"


def softened(found: Found) -> Entry | None:
    """The fastest DEM of the DEM's own accuracy; None where there is none, or that accuracy is not known."""
    accepted = found["reference"]["accepted"]
    return None if accepted is None else claims.fastest_rival(entries(found), accepted, accepted)


def stiffness_sentences(found: Found) -> Iterator[str]:
    """From which stiffness on a surrogate takes less time than the DEM, beside the fastest DEM that is as exact.

    Times alone: errors were measured at the scene's own modulus, and nowhere else.
    """
    study, soft, accepted = found["stiffness"], softened(found), found["reference"]["accepted"]
    modulus = _modulus(found["modulus"])
    for name, points in study.items():
        if name in ("automatic", "largest") or not succeeded(points[0]):
            continue
        level = points[0]["wall"]["median"]
        for label, words in (("largest", LARGEST), ("automatic", AUTOMATIC)):
            costs = {point["at"]: point["wall"]["median"] for point in study[label] if succeeded(point)}
            at = claims.crossing([*costs], [*costs.values()], level) if costs else None
            where = "at no stiffness that was timed" if at is None else f"from {_modulus(at)} on"
            yield f"- **{name}** ({_time(level)} a simulated second) takes less time than {words} {where}."
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
    yield from _failed_points(study, {"automatic": AUTOMATIC, "largest": LARGEST}, _modulus)


def count_sentences(found: Found) -> Iterator[str]:
    """What a surrogate costs in units of the DEM's cost at its automatic step, for each number of spheres."""
    study = found["counts"]
    dem = {point["at"]: point["wall"]["median"] for point in study.get("DEM", []) if succeeded(point)}
    for name, points in study.items():
        shares = [(p["at"], p["wall"]["median"] / dem[p["at"]]) for p in points if succeeded(p) and p["at"] in dem]
        if name != "DEM" and shares:
            words = ", ".join(f"{share:.2g} with {count:g} spheres" for count, share in shares)
            yield f"- **{name}** takes these times the time of {AUTOMATIC}: {words}."
    yield from _failed_points(study, {"DEM": AUTOMATIC}, lambda count: f"{count:g} spheres")


def _failed_points(study: Found, names: Mapping[str, str], words: Callable[[float], str]) -> Iterator[str]:
    for name, point in ((name, point) for name, points in study.items() for point in points):
        if not succeeded(point):
            who = names.get(name, f"**{name}**")
            yield f"- ✗ {who[0].upper()}{who[1:]} failed at {words(point['at'])}: {point['failure']}."


def busy_sentences(found: Found) -> Iterator[str]:
    """That the machine had other work, where methods waited for the processor more than a share of their time."""
    if found["waited"] > BUSY:
        share = f"{100 * found['waited']:.0f} % of their time"
        yield f"Methods waited {share} for the processor: the machine had other work."


def _cost(entry: Entry) -> str:
    """Time and error of a method, and what an answer of it lacks or took."""
    said = f"{_time(entry.seconds)} a simulated second, {entry.floors:.2f} floors"
    said += f", after {entry.data_seconds:.0f} s of data" if entry.kind == "baseline" and entry.data_seconds else ""
    return said + (", and statistics without spheres" if entry.name.startswith("interpolation") else "")


def _numbers(entry: Entry) -> str:
    return f"{_time(entry.seconds)}, {entry.floors:.2f} floors"


def _modulus(modulus: float) -> str:
    return f"E = {modulus:.1e} Pa"


def _time(seconds: float) -> str:
    if seconds < 1e-3:
        return f"{1e6 * seconds:.2g} µs"
    return f"{1e3 * seconds:.3g} ms" if seconds < 0.1 else f"{seconds:.3g} s"
