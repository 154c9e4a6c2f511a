"""What a stress run found, as a table on the terminal, as CSV, and as a page."""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from gran_bench.files import write_part
from gran_bench.provenance import read_table, stamp, write_table
from gran_bench.stress.expectation import FAILED, FLAGGED, MET, Observation
from gran_bench.stress.run import Errand

PAGE, TABLE = "README.md", "stress.csv"
HEADS = ("case", "model", "expectation", "found", "verdict", "s")
PARTS = {"dem": "The DEM", "surrogate": "Surrogates"}
WORDS = (MET, FLAGGED, FAILED)
FIGURES = {
    "time_to_failure.png": "Time to failure of each model's rollout in the paper's drum, against the speed: the first "
    "state that is not finite, has a centre outside by more than a radius, or has more than twice the energy that "
    "falling and turning give. Hollow triangles: no failure until the rollout ended.",
    "dem_step.png": "The DEM's step on the paper's drum at 30 rpm: error of the centre of mass's angle against the "
    "smallest step, over the floor of a run nudged by 1e-9 m, and cost of a frame on one thread.",
    "energy_drift.png": "Largest change of the energy of an elastic gas against the step.",
}


def row(result: Errand) -> tuple[str, ...]:
    """A result in words, under `HEADS`."""
    case, (word, found) = result.case, result.verdict
    word += f" (known: {case.known})" if case.known and word == FAILED else ""
    return (case.name, result.model, str(case.expectation), found, word, f"{result.seconds:.1f}")


def table(results: Sequence[Errand], widest: int = 64) -> str:
    """All rows in columns, long cells cut; the page and the CSV have them whole."""
    rows = [HEADS, *map(row, results)]
    lines = [[cell if len(cell) <= widest else cell[: widest - 1] + "…" for cell in line] for line in rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines)


def closing_line(results: Sequence[Errand], seconds: float) -> str:
    """How many cases ended how, and which failed, in a line."""
    words = Counter(result.verdict[0] for result in results)
    failed = [result.name for result in results if result.verdict[0] == FAILED]
    counted = ", ".join(f"{words[word]} {word}" for word in WORDS if words[word])
    return f"{len(results)} cases in {seconds:.0f} s: {counted}" + (f" ({', '.join(failed)})" if failed else "")


def write_results(results: Sequence[Errand], folder: Path, origin: Mapping[str, str]) -> None:
    """The CSV, and what the page says of it, each whole or not there; ``origin`` says where the results come from."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["part", *HEADS[:-1], "seconds", "flags", "quantities"])
    for result in results:
        seen = result.outcome if isinstance(result.outcome, Observation) else Observation()
        quantities = {name: float(f"{value:.6g}") for name, value in seen.quantities.items()}
        writer.writerow([result.case.part, *row(result), " | ".join(seen.flags), json.dumps(quantities)])
    write_table(folder / TABLE, text.getvalue(), origin)
    write_page(folder)


def write_page(folder: Path) -> None:
    """Renew what the page of a folder says of its CSV."""
    origin, table = read_table(folder / TABLE)
    text = "\n".join(_page(list(csv.DictReader(io.StringIO(table))), origin, folder))
    write_part(folder / PAGE, "cases", text, "Stress test of numerical stability")


def _page(rows: Sequence[dict[str, str]], origin: Mapping[str, str], folder: Path) -> Iterator[str]:
    """A table of verdicts by part, every case that failed, rollouts of models that ended early, and figures."""
    yield f"| {len(rows)} cases | {' | '.join(WORDS)} |"
    yield "|---" + "|---:" * len(WORDS) + "|"
    for part in dict.fromkeys(row["part"] for row in rows):
        some = [row for row in rows if row["part"] == part]
        yield f"| {PARTS.get(part, part)} | {' | '.join(str(count(some, word)) for word in WORDS)} |"
    yield ""
    if failed := [row for row in rows if row["verdict"].startswith(FAILED)]:
        yield from (f"- {row['verdict']}: {row['case']} {row['model']}: {row['found']}" for row in failed)
        yield ""
    if early := early_ends(rows):
        yield "| rollout that failed before its end | model | after, s | of, s |"
        yield "|---|---|---:|---:|"
        yield from (
            f"| {case} | {model or 'untrained'} | {after:g} | {whole:g} |" for case, model, after, whole in early
        )
        yield ""
    yield from (f"![{caption}]({name})\n" for name, caption in FIGURES.items() if (folder / name).exists())
    yield f"Every expectation, figure and flag: [`{TABLE}`]({TABLE}). {stamp(origin)}"


def count(rows: Sequence[dict[str, str]], word: str) -> int:
    """How many rows of the CSV have a verdict."""
    return sum(row["verdict"].startswith(word) for row in rows)


def early_ends(rows: Sequence[dict[str, str]]) -> list[tuple[str, str, float, float]]:
    """Rollouts that failed before their end: case, model (empty for random weights), when, and of how long, s.

    A rollout fails at its first state that is not finite, has a centre outside by more than a radius, or has more
    than twice the energy that falling and turning give.
    """
    found = []
    for row in rows:
        quantities = json.loads(row["quantities"] or "{}")
        after, whole = quantities.get("time_to_failure"), quantities.get("horizon")
        if row["part"] == "surrogate" and whole is not None and after < whole:
            found.append((row["case"], row["model"], after, whole))
    return found
