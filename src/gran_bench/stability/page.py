"""What a stress run found, as a table on the terminal, as CSV, and as a page."""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from gran_bench.atomic import write_text
from gran_bench.provenance import write_origin
from gran_bench.stability.expectation import ABSENT, FAILED, FLAGGED, MET, Observation
from gran_bench.stability.run import Result

PAGE, TABLE = "README.md", "stress.csv"
HEADS = ("case", "model", "expectation", "found", "verdict", "s")
PARTS = {
    "dem": "The DEM",
    "surrogate": "Surrogates",
    "data": "Data, files and processes",
}
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
    counted = ", ".join(f"{words[word]} {word}" for word in (MET, FLAGGED, ABSENT, FAILED) if words[word])
    return f"{len(results)} cases in {seconds:.0f} s: {counted}" + (f" ({', '.join(failed)})" if failed else "")


def write_page(
    results: Sequence[Result], folder: Path, origin: Mapping[str, str], figures: Sequence[str], seconds: float
) -> None:
    """The page, the CSV and its origin; each whole or not there.

    Args:
        results: in order.
        folder: made where it is missing.
        origin: where the results come from.
        figures: files in the folder that the page shows.
        seconds: of the whole run.
    """
    write_text(folder / TABLE, _csv(results))
    write_origin(folder / TABLE, origin)
    write_text(folder / PAGE, "\n".join(_page(results, origin, figures, seconds)) + "\n")


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


def _page(
    results: Sequence[Result], origin: Mapping[str, str], figures: Sequence[str], seconds: float
) -> Iterator[str]:
    yield "# Stress test of numerical stability"
    yield ""
    yield f"**{closing_line(results, seconds)}.**"
    yield ""
    yield (
        "Every case has an expectation that was written before it ran: a bound that is *met*; a named *error* that "
        "says what to do; or *flagged*: it may fail, but the program says so itself, and the failure keeps its bounds. "
        f"Every figure and flag is in [`{TABLE}`]({TABLE}); the lists are in `src/gran_bench/stability/lists/`."
    )
    yield ""
    yield from _failures(results)
    for name in figures:
        yield f"![{FIGURES[name]}]({name})"
        yield ""
        yield f"*{FIGURES[name]}*"
        yield ""
    for part in dict.fromkeys(result.case.part for result in results):
        yield f"## {PARTS.get(part, part)}"
        yield ""
        yield "| " + " | ".join(HEADS) + " |"
        yield "|---" * (len(HEADS) - 1) + "|---:|"
        for result in results:
            if result.case.part == part:
                yield "| " + " | ".join(cell.replace("|", "\\|") for cell in row(result)) + " |"
        yield ""
    yield "## Where this comes from"
    yield ""
    yield "| | |"
    yield "|---|---|"
    for name, value in origin.items():
        yield f"| {name.replace('_', ' ')} | `{value}` |"
    kept = sum(result.kept for result in results)
    if kept:
        yield f"| taken from an interrupted run of the same code | {kept} cases |"


def _failures(results: Sequence[Result]) -> Iterator[str]:
    """What every surrogate did wrong, in one list: nobody has to look for it."""
    told = [
        (result, result.outcome.flags)
        for result in results
        if result.case.part == "surrogate" and isinstance(result.outcome, Observation) and result.outcome.flags
    ]
    if not told:
        return
    yield "## What the surrogates did wrong"
    yield ""
    for result, flags in told:
        yield f"- {result.name}: {'; '.join(flags)}"
    yield ""
