"""What a stress run found, as a table on the terminal, as CSV, and as a page."""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from gran_bench.files import markdown, write_part
from gran_bench.provenance import read_table, stamp, write_table
from gran_bench.stress.expectation import FAILED, FLAGGED, MET, Observation, Outcome, verdict

if TYPE_CHECKING:
    from gran_bench.stress.case_list import StressCase

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


@dataclass
class Errand:
    """A case for the DEM or for one model, and what came of it once it is carried out."""

    case: StressCase
    checkpoint: str  # model file; empty for the DEM
    model: str  # its label
    file: Path  # where the outcome is kept until the whole run ends
    outcome: Outcome | None = None
    seconds: float = 0.0  # wall time

    @property
    def name(self) -> str:
        """Of the case, and of its model where it has one."""
        return f"{self.case.name}, {self.model}" if self.model else self.case.name

    @property
    def verdict(self) -> tuple[str, str]:
        """How it ended, in a word, and what was found."""
        return verdict(self.case.expectation, self.outcome)


def row(result: Errand) -> tuple[str, ...]:
    """A result in words, under `HEADS`."""
    case, (word, found) = result.case, result.verdict
    return (case.name, result.model, str(case.expectation), found, word, f"{result.seconds:.1f}")


def table(results: Sequence[Errand], widest: int = 64) -> str:
    """All rows in columns, long cells cut; the page and the CSV have them whole."""
    cut = [[cell if len(cell) <= widest else cell[: widest - 1] + "…" for cell in row(result)] for result in results]
    return "\n".join(markdown([HEADS, *cut], aligned=True))


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
    parts = {part: [row for row in rows if row["part"] == part] for part in dict.fromkeys(row["part"] for row in rows)}
    counts = [[PARTS.get(part, part), *(str(count(some, word)) for word in WORDS)] for part, some in parts.items()]
    failed = [row for row in rows if row["verdict"].startswith(FAILED)]
    heads = ("rollout that failed before its end", "model", "after, s", "of, s")
    early = [(case, model or "untrained", f"{after:g}", f"{whole:g}") for case, model, after, whole in early_ends(rows)]
    yield from [*markdown([(f"{len(rows)} cases", *WORDS), *counts]), ""]
    if failed:
        yield from (f"- {row['verdict']}: {row['case']} {row['model']}: {row['found']}" for row in failed)
        yield ""
    if early:
        yield from [*markdown([heads, *early]), ""]
    yield from (f"![{caption}]({name})\n" for name, caption in FIGURES.items() if (folder / name).exists())
    yield f"Every expectation, figure and flag: [`{TABLE}`]({TABLE}). {stamp(origin)}"


def count(rows: Sequence[dict[str, str]], word: str) -> int:
    """How many rows of the CSV have a verdict."""
    return sum(row["verdict"].startswith(word) for row in rows)


def early_ends(rows: Sequence[dict[str, str]]) -> list[tuple[str, str, float, float]]:
    """Rollouts that failed (`rollouts.observed`) before their end: case, model or "", when, and of how long, s."""
    found = []
    for row in rows:
        quantities = json.loads(row["quantities"] or "{}")
        after, whole = quantities.get("time_to_failure"), quantities.get("horizon")
        if row["part"] == "surrogate" and whole is not None and after < whole:
            found.append((row["case"], row["model"], after, whole))
    return found
