"""The page of all benchmarks and the table of each, made from their results alone."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from gran_bench.atomic import write_atomically, write_text
from gran_bench.comparison.claims import equal_accuracy, frontier, paid_back
from gran_bench.comparison.results import entries, read_all
from gran_bench.comparison.sentences import count_sentences, stiffness_sentences, verdicts, why_no_accuracy, winner

PAGE, TABLE = "README.md", "methods.csv"
BUSY = 0.05  # share of the time that methods waited for the processor, from which on a page says so

INTRODUCTION = """\
# Run time against error

Every method on the same scene, the same machine, from the same settled state (a packing that no training saw), one
thread each, in turns. `python -m gran_bench.benchmark` (`make bench`) made the figures and this page.

**How to read it**

- *Time* is wall time for a simulated second: the median over the rounds, with the smallest and the largest.
- *Expected* is where the median of another run of the benchmark lies with 95 % confidence, from the scatter over the
  rounds. *CPU* is what the processor worked; where it is less than the time, the method waited for others.
- *Relative* is the time in units of the DEM's at its automatic step in the same round, which a machine that is slow as
  a whole does not change.
- *Error* is the distance from nudged replicas of the DEM at half its automatic step, in noise floors (the mean distance
  of two replicas): the mean over runs of the method that start from nudges of their own, with the 95 % interval of the
  mean of as many others. Of two kinds of error the worse counts.
- *Noise* is the error up to which nothing can be told from the DEM itself. Each replica is judged by the others; of
  three or more, the scatter of their errors says where the mean over as many further runs of the DEM lies with 95 %
  confidence, and noise is the upper end of that. *The DEM's own accuracy* is the noise, or the error of the DEM at
  its automatic step where that is larger: in a bed that comes to rest, nudges hardly grow. It is shaded in the figures.
- *Memory* is the peak of the method's process during a run; in brackets, what came on top of Python, libraries and the
  loaded state.
- Data and training were timed where and when they were made.
- The softened DEM starts from the same bed as all others, which settled with the scene's own stiffness.

Comparisons are made at equal accuracy or at equal time only. At equal accuracy the rival of a surrogate is the fastest
DEM whose error is no larger, or is within the DEM's own accuracy: large steps, float32 and softened spheres included.
The same is asked of the fastest DEM that is not significantly worse: the low end of its interval is below the high end
of the surrogate's. Where the two give different answers, it is undecided who is faster.
"""


def write_page(root: Path) -> Path:
    """Write the page of all results below a folder, whole or not at all."""
    write_text(root / PAGE, page_text(read_all(root)))
    return root / PAGE


def page_text(results: dict[str, dict[str, Any]]) -> str:
    """The page as text.

    Args:
        results: by ``profile/scene``, as `results.read_all` gives them.
    """
    lines = [INTRODUCTION, "## Who wins", ""]
    lines += [f"- [{found['scene']}](#{_anchor(place, found)}): {winner(found)}" for place, found in results.items()]
    for place, found in results.items():
        lines += ["", *_section(place, found)]
    return "\n".join(lines).rstrip() + "\n"


def write_table(path: Path, found: dict[str, Any]) -> Path:
    """Write the methods of one benchmark as CSV: a row each, errors in their unit and in floors."""
    table = table_of(found)
    write_atomically(path, lambda file: table.to_csv(file, index=False))
    return path


def table_of(found: dict[str, Any]) -> pd.DataFrame:
    """A row for each method: times in s for a simulated second, memory in bytes, every error, failures."""
    front = {entry.name for entry in frontier(entries(found))}
    rows = []
    for row in found["methods"]:
        wall, relative = row["wall"] or {}, row["relative"] or {}
        flat = {"scene": found["scene"], "method": row["name"], "kind": row["kind"], "failed": row["failed"]}
        flat |= {"reason": row["unfit_because"] or row["failure"], "on_frontier": row["name"] in front}
        flat |= {f"seconds_{name}": wall.get(name) for name in _SPREAD}
        flat |= {f"relative_{name}": relative.get(name) for name in _SPREAD}
        flat |= {name: row[name] for name in ("cpu_seconds", "peak_bytes", "own_bytes")}
        flat |= {name: row[name] for name in ("data_seconds", "training_seconds")}
        flat |= {"break_even_seconds": _break_even(row["name"], found)}
        flat |= {name: row[name] for name in ("floors", "floors_low", "floors_high", "by", "outside")}
        for key, error in ((row["judgement"] or {}).get("errors") or {}).items():
            unit = error["unit"].replace("/", "_per_")
            flat |= {f"{key}_{unit}": error["value"], f"{key}_floors": error["multiple_of_floor"]}
        rows.append(flat)
    return pd.DataFrame(rows)


_SPREAD = ("median", "low", "high", "expected_low", "expected_high")


def _break_even(name: str, found: dict[str, Any]) -> float | None:
    """Simulated seconds until a method that needed data or training is paid back; None where nothing was spent.

    NaN where it is undecided who is faster.
    """
    every, accepted = entries(found), found["reference"]["accepted"]
    entry = next((entry for entry in every if entry.name == name and entry.floors is not None), None)
    if entry is None or not entry.data_seconds + entry.training_seconds:
        return None
    return paid_back(equal_accuracy(entry, every, accepted))


def _section(place: str, found: dict[str, Any]) -> Iterator[str]:
    reference, made = found["reference"], found["provenance"]
    yield f"## {_title(place, found)}"
    yield ""
    yield (
        f"{found['spheres']} spheres, {found['simulated_seconds']:g} s, {found['motion']}, "
        f"E = {found['modulus']:.0e} Pa; {found['rounds']} rounds; {reference['replicas']} replicas. "
        f"Error: the worse of {' and '.join(row['label'] for row in reference['ranked'])}. "
        f"{_noise(found)}"
    ).replace("e+0", "e")
    yield ""
    yield f"![Time against error]({place}/time_error.png)"
    yield ""
    yield winner(found)
    yield ""
    yield from verdicts(found)
    yield ""
    yield from _table(found)
    if found["stiffness"]:
        yield from ("", "**Against stiffness.**", "", f"![Cost against stiffness]({place}/stiffness.png)", "")
        yield from stiffness_sentences(found)
    if found["counts"]:
        yield from ("", "**Against the number of spheres.**", "", f"![Cost against number]({place}/counts.png)", "")
        yield from count_sentences(found)
    yield ""
    busy = f" Methods waited {100 * found['waited']:.0f} % of their time for the processor: the machine had other work."
    busy = busy if found["waited"] > BUSY else ""
    yield (
        f"Made by `{made['command']}` at commit {made['commit']} on {made['hardware']}; {made['versions']}.{busy} "
        f"Everything: [`{TABLE}`]({place}/{TABLE}), [`benchmark.json`]({place}/benchmark.json)."
    )


def _noise(found: dict[str, Any]) -> str:
    reference = found["reference"]
    if reference["accepted"] is None:
        return f"Noise: undefined, {why_no_accuracy(found)}."
    said = f"Noise: {reference['noise']:.2f} floors; the DEM's own accuracy: {reference['accepted']:.2f} floors."
    # Results of before runs and replicas were compared by their means.
    older = " (By an older rule: the bound for a single replica. `measure=false` gives today's.)"
    return said if "judged_runs" in reference else said + older


def _table(found: dict[str, Any]) -> Iterator[str]:
    ranked = found["reference"]["ranked"]
    yield (
        "| method | time, s | expected | CPU, s | relative | error, floors | "
        + " | ".join(f"{row['label']}, {_unit(row['unit'])} (floors)" for row in ranked)
        + " | memory, MiB | data, s | training, s | break-even, s |"
    )
    yield "|---" * (10 + len(ranked)) + "|"
    front = {entry.name for entry in frontier(entries(found))}
    for row in found["methods"]:
        name = f"**{row['name']}**" if row["name"] in front else row["name"]
        if row["unfit_because"]:
            yield f"| {name} | does not fit: {row['unfit_because']} " + "| " * (8 + len(ranked)) + "|"
            continue
        errors = (row["judgement"] or {}).get("errors", {})
        cells = [name, _range(row["wall"]), _expected(row["wall"])]
        cells.append("" if row["cpu_seconds"] is None else f"{row['cpu_seconds']:.3g}")
        cells += [_range(row["relative"]), _error(row)]
        cells += [_ranked(errors.get(kind["key"])) for kind in ranked]
        cells.append(_memory(row))
        cells += [f"{row[spent]:.0f}" if row[spent] else "–" for spent in ("data_seconds", "training_seconds")]
        cells.append(_paid(_break_even(row["name"], found)))
        yield "| " + " | ".join(cells) + " |"
    yield ""
    yield "Bold: on the frontier, nothing is faster and as exact."


def _paid(seconds: float | None) -> str:
    if seconds is None:
        return "–"
    return "undecided" if math.isnan(seconds) else "never" if math.isinf(seconds) else f"{seconds:,.0f}"


def _error(row: dict[str, Any]) -> str:
    if row["failed"]:
        return f"✗ failed: {row['failure']}"
    if row["floors"] is None:
        return "time alone"
    return f"{row['floors']:.2f} ({row['floors_low']:.2f} to {row['floors_high']:.2f})"


def _ranked(error: dict[str, Any] | None) -> str:
    if error is None:
        return ""
    if error["value"] is None:
        return "undefined"
    scale = 1e3 if error["unit"] == "m" else 1.0
    multiple = error["multiple_of_floor"]
    return f"{scale * error['value']:.3g}" + (f" ({multiple:.2f})" if multiple is not None else "")


def _range(spread: dict[str, Any] | None) -> str:
    return "" if spread is None else f"{spread['median']:.3g} ({spread['low']:.3g} to {spread['high']:.3g})"


def _expected(spread: dict[str, Any] | None) -> str:
    if spread is None or spread["expected_low"] is None:
        return "" if spread is None else "–"
    return f"{spread['expected_low']:.3g} to {spread['expected_high']:.3g}"


def _memory(row: dict[str, Any]) -> str:
    if row["peak_bytes"] is None:
        return ""
    return f"{row['peak_bytes'] / 2**20:.0f} ({row['own_bytes'] / 2**20:.0f})"


def _unit(unit: str) -> str:
    return "mm" if unit == "m" else "°" if unit == "deg" else unit


def _title(place: str, found: dict[str, Any]) -> str:
    return f"{found['scene']}, {place.partition('/')[0]}"


def _anchor(place: str, found: dict[str, Any]) -> str:
    return _title(place, found).replace(",", "").replace(" ", "-")


if __name__ == "__main__":
    print(write_page(Path(sys.argv[1] if len(sys.argv) > 1 else "results/benchmark")))
