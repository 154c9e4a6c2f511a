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
from gran_bench.stress.run import Result

PAGE, TABLE = "README.md", "stress.csv"
HEADS = ("case", "model", "expectation", "found", "verdict", "s")
PARTS = {"dem": "The DEM", "surrogate": "Surrogates"}
FIGURES = {
    "time_to_failure.png": "Time to failure of each model's rollout in the paper's drum, against the speed: the first "
    "state that is not finite, has a centre outside by more than a radius, or has more than twice the energy that "
    "falling and turning give. Hollow triangles: no failure until the rollout ended.",
    "dem_step.png": "The DEM's step on the paper's drum at 30 rpm: error of the centre of mass's angle against the "
    "smallest step, over the floor of a run nudged by 1e-9 m, and cost of a frame on one thread.",
    "energy_drift.png": "Largest change of the energy of an elastic gas against the step.",
}


def row(result: Result) -> tuple[str, ...]:
    """A result in words, under `HEADS`."""
    end = result.verdict
    known = f" (known: {result.case.known})" if result.case.known and end.word == FAILED else ""
    return (
        result.case.name, result.model, str(result.case.expectation), end.found, end.word + known,
        f"{result.seconds:.1f}",
    )  # fmt: skip


def table(results: Sequence[Result], widest: int = 64) -> str:
    """All rows in columns, long cells cut; the page and the CSV have them whole."""

    def cut(cell: str) -> str:
        return cell if len(cell) <= widest else cell[: widest - 1] + "…"

    lines = [HEADS, *(tuple(map(cut, row(result))) for result in results)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(HEADS))]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines)


def closing_line(results: Sequence[Result], seconds: float) -> str:
    """How many cases ended how, and which failed, in a line."""
    words = Counter(result.verdict.word for result in results)
    failed = [result.name for result in results if result.verdict.word == FAILED]
    counted = ", ".join(f"{words[word]} {word}" for word in (MET, FLAGGED, FAILED) if words[word])
    return f"{len(results)} cases in {seconds:.0f} s: {counted}" + (f" ({', '.join(failed)})" if failed else "")


def write_results(results: Sequence[Result], folder: Path, origin: Mapping[str, str]) -> None:
    """The CSV, and what the page says of it; each whole or not there.

    Args:
        results: in order.
        folder: made where it is missing.
        origin: where the results come from.
    """
    write_table(folder / TABLE, _csv(results), origin)
    write_page(folder)


def write_page(folder: Path) -> None:
    """Renew what the page of a folder says of its CSV."""
    origin, table = read_table(folder / TABLE)
    text = "\n".join(_page(list(csv.DictReader(io.StringIO(table))), origin, folder))
    write_part(folder / PAGE, "cases", text, "Stress test of numerical stability")


def _csv(results: Sequence[Result]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["part", *HEADS[:-1], "seconds", "flags", "quantities"])
    for result in results:
        outcome = result.outcome
        seen = isinstance(outcome, Observation)
        quantities = {name: float(f"{value:.6g}") for name, value in outcome.quantities.items()} if seen else {}
        flags = " | ".join(outcome.flags) if seen else ""
        writer.writerow([result.case.part, *row(result), flags, json.dumps(quantities)])
    return text.getvalue()


def _page(rows: Sequence[dict[str, str]], origin: Mapping[str, str], folder: Path) -> Iterator[str]:
    """A table of verdicts by part, every case that failed, rollouts of models that ended early, and figures."""
    words = (MET, FLAGGED, FAILED)
    yield f"| {len(rows)} cases | {' | '.join(words)} |"
    yield "|---" + "|---:" * len(words) + "|"
    for part in dict.fromkeys(row["part"] for row in rows):
        some = [row for row in rows if row["part"] == part]
        yield f"| {PARTS.get(part, part)} | {' | '.join(str(count(some, word)) for word in words)} |"
    yield ""
    failed = [row for row in rows if row["verdict"].startswith(FAILED)]
    if failed:
        yield from (f"- {row['verdict']}: {row['case']} {row['model']}: {row['found']}" for row in failed)
        yield ""
    if early := early_ends(rows):
        yield "| rollout that failed before its end | model | after, s | of, s |"
        yield "|---|---|---:|---:|"
        for case, model, after, whole in early:
            yield f"| {case} | {model or 'untrained'} | {after:g} | {whole:g} |"
        yield ""
    for name, caption in FIGURES.items():
        if (folder / name).exists():
            yield f"![{caption}]({name})"
            yield ""
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
