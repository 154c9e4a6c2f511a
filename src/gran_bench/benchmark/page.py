"""What the page says of each benchmark, and its table as CSV, made from results alone."""

import math
from collections.abc import Iterator
from pathlib import Path
from textwrap import shorten
from typing import Any

import pandas as pd

from gran_bench.benchmark import overview
from gran_bench.benchmark import results as claims
from gran_bench.benchmark.results import SPREAD, Entry, EqualAccuracy, entries, read_all, succeeded
from gran_bench.config.registry import METRICS
from gran_bench.files import markdown, write_part
from gran_bench.metrics.floor import PACKINGS
from gran_bench.plots.time_error import frontier
from gran_bench.provenance import stamp

PAGE, TABLE = "README.md", "methods.csv"
FIGURES = {
    "time_error": "Time against error.",
    "stiffness": "Cost against stiffness.",
    "counts": "Cost against the number of spheres.",
}
BUSY = 0.05  # share of the time that methods waited for the processor, from which on pages say so
# Lines of the studies that are a DEM, as figures and pages name them.
DEMS = {"automatic": "DEM, automatic step", "largest": "DEM, largest allowed step", "DEM": "DEM, automatic step"}
Found = dict[str, Any]  # as in ``benchmark.json``


def write_page(root: Path) -> Path:
    """Renew a part for each benchmark on the page of a folder, from all results below it."""
    every = read_all(root)
    if every:
        write_part(root / PAGE, "overview", overview.overview_text(root, every), "Run time against error")
    for place, found in every.items():
        write_part(root / PAGE, found["scene"], part_text(place, found), "Run time against error", found["scene"])
    return root / PAGE


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
        flat |= {"beyond": row.get("beyond", ""), "packings": row.get("packings", 1)}
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
        figures = (row["judgement"] or {}).get("figures") or {}
        flat |= {f"{key}_mean": figures[key]["value"] for key in METRICS.added() if key in figures}
        for key, one in (row.get("statistics") or {}).items():
            flat |= {f"{key}_energy_score": one["multiple"], f"{key}_spread": one["spread"]}
            flat[f"{key}_mean_error"] = one.get("mean_error")
        rows.append(flat)
    return pd.DataFrame(rows)


def part_text(place: str, found: Found) -> str:
    """What the page says of one benchmark; its place is ``profile/scene``."""
    reference = found["reference"]
    labels, own = listed([row["label"] for row in reference["ranked"]]), f"undefined, {why_no_accuracy(found)}"
    if reference["accepted"] is not None:
        own = f"{reference['accepted']:.2f} floors"
        own += f" (noise: {reference['noise']:.2f})" * (reference["noise"] < reference["accepted"])
    setting = (
        f"{found['spheres']} spheres, {found['simulated_seconds']:g} s, {found['motion'].replace('rpm', ' rpm')}, "
    )
    setting += f"E = {found['modulus']:.0e} Pa; {found['rounds']} rounds, {reference['replicas']} replicas. "
    setting += f"Error: the {'worse' if len(reference['ranked']) < 3 else 'worst'} of {labels}. "
    setting += f"The DEM's own accuracy: {own}."
    if reference.get("floor_between") == PACKINGS:
        setting += " Nudges hardly grow here, so one floor is the distance between packings."
    studies = [*_stiffness(found), *_counts(found), *_failed_points(found)]
    heads = ("surrogate", "at equal accuracy", "DEMs as exact: × is its speed beside theirs")
    heads += ("most exact DEM in no more time", "making its data, s", "training, s", "paid back after, simulated s")
    beside = markdown([heads, *surrogate_rows(found)])
    tables = [*_table(found), "", *statistics_table(found), *studies]
    said = " ".join([on_frontier(found), *surrogate_sentences(found), winner(found)])
    lines = [said, "", *beside, "", setting.replace("e+0", "e"), "", *tables]
    shown = [figure for figure in FIGURES if figure == "time_error" or found[figure]]
    lines += ["", *(f"![{FIGURES[figure]}]({place}/{figure}.png)" for figure in shown), ""]
    made = " ".join([stamp(found["provenance"]), *busy_sentences(found)])
    return "\n".join([*lines, f"{made} [CSV]({place}/{TABLE}), [JSON]({place}/benchmark.json)."]).strip()


def _table(found: Found) -> Iterator[str]:
    """The methods on the frontier (bold), the DEM at its automatic step and what is no DEM; then every failure."""
    heads = ("method", "time of a simulated second, s (of another run)", "× the DEM's automatic step")
    rows, front = [(*heads, "error, floors (95 %)")], frontier(entries(found))
    names, failed = {entry.name for entry in front}, []
    for row in found["methods"]:
        if row["failed"]:
            failed.append(f"- ✗ {row['name']} failed: {shorten(row['failure'], 80, placeholder=' …')}")
        elif row.get("statistics"):
            continue  # in a table of their own
        elif row["name"] in names or row["name"] == found["automatic"] or row["kind"] != "dem":
            time = relative = ""
            if wall := row["wall"]:
                time = f"{wall['median']:.3g}"
                if wall["expected_low"] is not None:
                    time += f" ({wall['expected_low']:.3g} to {wall['expected_high']:.3g})"
            if row["relative"]:
                relative = f"{row['relative']['median']:.3g}"
            error = f"does not fit: {row['unfit_because']}" if row["unfit_because"] else "time alone"
            if row["floors"] is not None:
                error = f"{row['floors']:.2f} ({row['floors_low']:.2f} to {row['floors_high']:.2f})"
            name = f"**{row['name']}**" if row["name"] in names else row["name"]
            name += f", {row['packings']} packings" if row.get("packings", 1) > 1 else ""
            rows.append((name, time, relative, error))
    yield from [*markdown(rows), "", *failed]


def statistics_table(found: Found) -> Iterator[str]:
    """The methods without particles, in a class of their own; nothing where there is none."""
    methods = [row for row in found["methods"] if row.get("statistics")]
    if not methods:
        return
    heads = (
        "statistics, no particles",
        "time of a simulated second, s",
        "making its data, s",
        "training, s",
        "quantity",
    )
    rows = [(*heads, "error of the mean", "energy score", "spread")]
    for row in methods:
        facts = (row["name"], f"{row['wall']['median']:.3g}" if row["wall"] else "")
        facts += (f"{row['data_seconds']:.0f}", f"{row['training_seconds']:.0f}")
        for one in row["statistics"].values():
            cells = (one.get(key) for key in ("mean_error", "multiple", "spread"))
            shown = ("undefined" if cell is None else f"{cell:.2f}" for cell in cells)
            rows.append((*facts, one["label"], *shown))
            facts = ("",) * len(facts)
    said = "Statistics are not ranked beside samples. Error of the mean: in units of the error that the mean of the "
    said += (
        "other replicas has. A run of the DEM has an energy score of 1; replicas have a spread of 1, a mean without "
    )
    beyond = (f" {row['name']} goes beyond what it learned: {row['beyond']}." for row in methods if row.get("beyond"))
    yield from [f"{said}a spread has 0.{''.join(beyond)}", "", *markdown(rows), ""]


def listed(labels: list[str]) -> str:
    """Words in a row: ``a, b and c``."""
    return " and ".join(filter(None, (", ".join(labels[:-1]), labels[-1])))


def on_frontier(found: Found) -> str:
    """Who, of samples of the flow, is on the frontier, from fast to exact."""
    ahead = frontier([entry for entry in entries(found) if entry.kind in ("dem", "surrogate")])
    names = listed([entry.name for entry in ahead]) if ahead else "no method"
    return f"On the frontier, where nothing is both faster and as exact: {names}."


def surrogate_sentences(found: Found) -> Iterator[str]:
    """Where each surrogate stands that has an error."""
    every, accepted = entries(found), found["reference"]["accepted"]
    for entry in (one for one in every if one.kind == "surrogate" and one.floors is not None):
        words = equal_accuracy_words(claims.equal_accuracy(entry, every, accepted))
        yield f"The surrogate {_numbers(entry)}: at equal accuracy {words}."


def winner(found: Found) -> str:
    """The fastest method of the DEM's own accuracy, and all methods whose times cannot be told from it."""
    every, accepted = entries(found), found["reference"]["accepted"]
    if accepted is None:
        return f"Who wins is not known: {why_no_accuracy(found)}."
    sound = sorted((entry for entry in every if entry.floors is not None), key=lambda entry: entry.seconds)
    exact = [entry for entry in sound if entry.floors <= accepted]
    # Whose interval reaches the DEM's own accuracy, and whose error does not.
    perhaps, word = [entry for entry in sound if entry.least <= accepted < entry.floors], "P"
    said = "No method has the DEM's own accuracy"
    if exact:
        first, rival = exact[0], claims.fastest_rival(every, accepted, accepted)
        same = [entry for entry in exact if entry == first or not claims.speed_up(first, entry).decides]
        word = "Faster and p"
        perhaps = [entry for entry in perhaps if claims.speed_up(first, entry).high < 1.0]
        said = f"Fastest of the DEM's own accuracy ({accepted:.2f} floors){', not told apart' * (len(same) > 1)}: "
        said += "; ".join(map(_numbers, same))
        if rival is not None and rival not in same:
            said += f". Fastest DEM of that accuracy: {_numbers(rival)}"
    names = ", ".join(f"{_numbers(entry)} ({entry.least:.2f} to {entry.most:.2f})" for entry in perhaps)
    return f"{said}." + (f" {word}erhaps of that accuracy, by their intervals: {names}." if perhaps else "")


def why_no_accuracy(found: Found) -> str:
    """Why the DEM's own accuracy is not known."""
    return f"{found['reference']['replicas']} replicas do not give the DEM's own accuracy; three or more do"


def surrogate_rows(found: Found) -> Iterator[list[str]]:
    """Each surrogate beside the fastest DEM that is as exact (measured; within the intervals), and the best as fast."""
    every, accepted = entries(found), found["reference"]["accepted"]
    for row in found["methods"]:
        if row["kind"] != "surrogate":
            continue
        entry = next((one for one in every if one.name == row["name"] and one.floors is not None), None)
        if entry is None:
            yield [row["name"], row["unfit_because"] or row["failure"], *[""] * 5]
            continue
        beside, quick = claims.equal_accuracy(entry, every, accepted), claims.best_in_time(every, entry.seconds)
        dems = [dem for dem in dict.fromkeys((beside.rival, beside.lenient)) if dem is not None]
        ratios = ((_numbers(dem), claims.speed_up(entry, dem)) for dem in dems)
        shown = "; ".join(f"{dem}: × {ratio.middle:.2g} ({ratio.low:.2g} to {ratio.high:.2g})" for dem, ratio in ratios)
        seconds, fast = claims.paid_back(beside), "none" if quick is None else _numbers(quick)
        paid = "" if seconds is None else "undecided" if math.isnan(seconds) else f"{seconds:,.0f}"
        spent = f"{entry.data_seconds:.0f}", f"{entry.training_seconds:.0f}", paid.replace("inf", "never")
        yield [entry.name, equal_accuracy_words(beside), shown, fast, *spent]


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


def _stiffness(found: Found) -> list[str]:
    """From which stiffness on a surrogate takes less time than the DEM: times alone."""
    study, rows = found["stiffness"], [["surrogate", "time, s", "faster than the DEM's automatic step", "largest step"]]
    for name, points in study.items():
        if name not in DEMS and succeeded(points[0]):
            rows.append([name, f"{points[0]['wall']['median']:.3g}"])
            for label in ("automatic", "largest"):
                costs = {point["at"]: point["wall"]["median"] for point in study[label] if succeeded(point)}
                at = claims.crossing([*costs], [*costs.values()], points[0]["wall"]["median"]) if costs else None
                rows[-1].append("at no stiffness that was timed" if at is None else f"from {_modulus(at)} on")
    caveat = f"\nErrors were measured at {_modulus(found['modulus'])} alone: flows of stiffer spheres were not judged."
    return [*markdown(rows), caveat] if rows[1:] else []


def _counts(found: Found) -> list[str]:
    """What a surrogate costs in units of the DEM's cost at its automatic step, for each number of spheres."""
    study = found["counts"]
    dem = {point["at"]: point["wall"]["median"] for point in study.get("DEM", []) if succeeded(point)}
    rows = [["× the DEM", *(f"{count:g} spheres" for count in dem)]]
    for name, points in study.items():
        costs = {point["at"]: point["wall"]["median"] for point in points if succeeded(point)}
        if name != "DEM":
            rows.append([name, *(f"{costs[at] / dem[at]:.2g}" if at in costs else "" for at in dem)])
    return ["", *markdown(rows)]


def _failed_points(found: Found) -> Iterator[str]:
    yield ""
    for study, words in (("stiffness", _modulus), ("counts", "{:g} spheres".format)):
        for name, point in ((name, point) for name, points in found[study].items() for point in points):
            if not succeeded(point):
                yield f"- ✗ {DEMS.get(name, name)} failed at {words(point['at'])}: {point['failure']}"


def busy_sentences(found: Found) -> Iterator[str]:
    """That the machine had other work, where methods waited for the processor more than a share of their time."""
    if found["waited"] > BUSY:
        share = f"{100 * found['waited']:.0f} % of their time"
        yield f"Methods waited {share} for the processor: the machine had other work."


def _numbers(entry: Entry) -> str:
    """Name, time and error of a method, and what an answer of it lacks or took."""
    said = f"{entry.name} ({entry.seconds:.3g} s, {entry.floors:.2f} floors"
    said += f", after {entry.data_seconds:.0f} s of data" if entry.kind == "baseline" and entry.data_seconds else ""
    return said + (", statistics without spheres)" if entry.name.startswith("interpolation") else ")")


def _modulus(modulus: float) -> str:
    return f"E = {modulus:.1e} Pa"
