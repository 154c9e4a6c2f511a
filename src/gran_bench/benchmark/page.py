"""What the page says of each benchmark, and its table as CSV, made from results alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from textwrap import shorten
from typing import Any

import pandas as pd

from gran_bench.benchmark.claims import equal_accuracy, frontier, paid_back
from gran_bench.benchmark.results import entries, read_all
from gran_bench.benchmark.sentences import (
    busy_sentences,
    count_sentences,
    stiffness_sentences,
    verdicts,
    why_no_accuracy,
    winner,
)
from gran_bench.files import write_atomically, write_part
from gran_bench.provenance import stamp

PAGE, TABLE = "README.md", "methods.csv"
FIGURES = {
    "time_error": "Time against error.",
    "stiffness": "Cost against stiffness.",
    "counts": "Cost against the number of spheres.",
}
TITLE = "Run time against error"


def write_page(root: Path) -> Path:
    """Renew a part for each benchmark on the page of a folder, from all results below it."""
    for place, found in read_all(root).items():
        write_part(root / PAGE, found["scene"], part_text(place, found), TITLE, found["scene"])
    return root / PAGE


def part_text(place: str, found: dict[str, Any]) -> str:
    """What the page says of one benchmark.

    Args:
        place: ``profile/scene``.
        found: as in ``benchmark.json``.
    """
    return "\n".join(_part(place, found)).strip()


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


def _part(place: str, found: dict[str, Any]) -> Iterator[str]:
    reference, made = found["reference"], found["provenance"]
    yield winner(found)
    yield ""
    yield from verdicts(found)
    yield ""
    yield (
        f"{found['spheres']} spheres, {found['simulated_seconds']:g} s, {found['motion']}, E = {found['modulus']:.0e} "
        f"Pa; {found['rounds']} rounds. Error: the worse of "
        f"{' and '.join(row['label'] for row in reference['ranked'])}, beside {reference['replicas']} replicas. "
        f"{_noise(found)}"
    ).replace("e+0", "e")
    yield ""
    yield from _table(found)
    for study, sentences in (("stiffness", stiffness_sentences), ("counts", count_sentences)):
        if found[study]:
            yield ""
            yield from sentences(found)
    yield ""
    for figure in FIGURES:
        if figure == "time_error" or found[figure]:
            yield f"![{FIGURES[figure]}]({place}/{figure}.png)"
    yield ""
    busy = "".join(f" {sentence}" for sentence in busy_sentences(found))
    yield f"{stamp(made)}{busy} [CSV]({place}/{TABLE}), [JSON]({place}/benchmark.json)."


def _noise(found: dict[str, Any]) -> str:
    reference = found["reference"]
    if reference["accepted"] is None:
        return f"Noise: undefined, {why_no_accuracy(found)}."
    return f"Noise: {reference['noise']:.2f} floors; the DEM's own accuracy: {reference['accepted']:.2f} floors."


def _table(found: dict[str, Any]) -> Iterator[str]:
    """The methods on the frontier (bold), the DEM at its automatic step and what is no DEM; then every failure."""
    yield "| method | time, s (another run) | × the DEM | error, floors |"
    yield "|---|---:|---:|---|"
    front, failed = {entry.name for entry in frontier(entries(found))}, []
    for row in found["methods"]:
        if row["failed"]:
            failed.append(f"- ✗ {row['name']} failed: {shorten(row['failure'], 80, placeholder=' …')}")
        elif row["name"] in front or row["name"] == found["automatic"] or row["kind"] != "dem":
            name = f"**{row['name']}**" if row["name"] in front else row["name"]
            wall, relative = row["wall"] or {}, row["relative"] or {}
            time = f"{_number(wall.get('median'))}{_expected(row['wall'])}"
            yield f"| {name} | {time} | {_number(relative.get('median'))} | {_error(row)} |"
    yield ""
    yield from failed


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


def _error(row: dict[str, Any]) -> str:
    if row["unfit_because"]:
        return f"does not fit: {row['unfit_because']}"
    if row["floors"] is None:
        return "time alone"
    return f"{row['floors']:.2f} ({row['floors_low']:.2f} to {row['floors_high']:.2f})"


def _expected(spread: dict[str, Any] | None) -> str:
    if spread is None or spread["expected_low"] is None:
        return ""
    return f" ({spread['expected_low']:.3g} to {spread['expected_high']:.3g})"
