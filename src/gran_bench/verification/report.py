"""What the suite found, as a table for the terminal, as JSON with every point, and as a table of its page."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gran_bench.files import write_part, write_text
from gran_bench.provenance import stamp
from gran_bench.verification.case import Outcome

JSON, PAGE = "verification.json", "README.md"
HEADS = ("case", "quantity", "points", "expected", "found", "error", "tolerance", "source", "")
FIGURES = {
    "oblique_impact.png": "Oblique impacts: points are found at t_c/200, lines are the equations in continuous time, "
    "dashes are rigid bodies that slide.",
    "step.png": "What the step does: the order of the error, and the energy of an elastic gas.",
}


def rows(outcome: Outcome) -> Iterator[tuple[str, ...]]:
    """A row for each quantity of a case, at the point with the largest error; one for the error that stopped it."""
    name = outcome.case.name
    if outcome.failure is not None or not outcome.checks:
        yield (name, outcome.failure or "nothing was checked", *[""] * 6, "FAILED")
    for check in outcome.checks:
        k = int(np.argmax(check.error))
        numbers = (str(len(check.expected)), f"{check.expected[k]:.6g}", f"{check.found[k]:.6g}")
        error = (f"{check.error[k]:.1e} {check.unit}", f"{check.tolerance:.2g}", check.source)
        where = f" at {check.at[k]}" if check.at else ""
        yield (name, check.quantity + where, *numbers, *error, "met" if check.met else "FAILED")


def table(outcomes: Sequence[Outcome]) -> str:
    """All rows, in columns; the worst point of each quantity."""
    lines = [HEADS, *(row for outcome in outcomes for row in rows(outcome))]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines)


def verdict(outcomes: Sequence[Outcome]) -> str:
    """How many cases, quantities and points there were, and which cases failed, in a line."""
    checks = [check for outcome in outcomes for check in outcome.checks]
    points, failed = sum(len(check.expected) for check in checks), [o.case.name for o in outcomes if not o.met]
    seconds = sum(outcome.seconds for outcome in outcomes)
    counted = f"{len(outcomes)} cases, {len(checks)} quantities, {points} points, {seconds:.0f} s: "
    return counted + (f"{len(failed)} FAILED: {', '.join(failed)}" if failed else "all within tolerance")


def write_report(outcomes: Sequence[Outcome], folder: Path, provenance: dict[str, str], subset: str = "") -> None:
    """The JSON, and what the page says of it, each whole or not there; ``subset`` says in words what was left out."""
    record = {"provenance": provenance, "verdict": verdict(outcomes), "met": all(o.met for o in outcomes)}
    record |= {"subset": subset, "cases": [_record(outcome) for outcome in outcomes]}
    write_text(folder / JSON, json.dumps(record, ensure_ascii=False, allow_nan=False, separators=(",", ":")) + "\n")
    write_page(folder)


def write_page(folder: Path) -> None:
    """Renew the table of cases on the page of a folder, from its JSON."""
    record = json.loads((folder / JSON).read_text("utf-8"))
    write_part(folder / PAGE, "cases", "\n".join(_page(record, folder)), "Verification of the DEM")


def _record(outcome: Outcome) -> dict[str, Any]:
    found = {"name": outcome.case.name, "title": outcome.case.title, "met": outcome.met}
    found |= {"failure": outcome.failure, "seconds": round(outcome.seconds, 3), "checks": []}
    for check in outcome.checks:
        words = {name: getattr(check, name) for name in ("quantity", "met", "tolerance", "unit", "source")}
        digits = {"expected": 10, "found": 10, "error": 4}
        numbers = {name: _numbers(getattr(check, name), count) for name, count in digits.items()}
        found["checks"].append(words | {"at": list(check.at)} | numbers)
    return found | {"curves": {name: _numbers(values, 6) for name, values in outcome.curves.items()}}


def _numbers(values: np.ndarray, digits: int) -> list[float | str]:
    """Rounded; what is not finite in words, which JSON has no numbers for."""
    return [float(f"{v:.{digits}g}") if math.isfinite(v) else str(v) for v in np.asarray(values, float)]


def _page(record: Mapping[str, Any], folder: Path) -> Iterator[str]:
    """The verdict, a row a case, every quantity that is not within its tolerance, and figures."""
    yield f"**{record['verdict']}.**" + (f" {record['subset']}" if record["subset"] else "")
    yield "\n| case | what is verified | quantities | points | largest error / tolerance | |"
    yield "|---|---|---:|---:|---:|---|"
    missed = []
    for case in record["cases"]:
        checks, shares = case["checks"], [_share(check) for check in case["checks"]]
        numbers = (
            f"{len(checks)} | {sum(len(check['expected']) for check in checks)} | {max(shares, default=math.nan):.2g}"
        )
        yield f"| {case['name']} | {case['title']} | {numbers} | {'met' if case['met'] else 'FAILED'} |"
        missed += [f"- {case['name']}: {case['failure']}"] if case["failure"] is not None else []
        for check, share in zip(checks, shares, strict=True):
            if not check["met"]:
                times = f"{share:.3g} times its tolerance of {check['tolerance']}"
                missed.append(f"- {case['name']}, {check['quantity']}: {times}")
    yield from ["", *missed]
    yield from (f"![{caption}]({name})\n" for name, caption in FIGURES.items() if (folder / name).exists())
    yield f"Every point, and the source of each expected value: [`{JSON}`]({JSON}). {stamp(record['provenance'])}"


def _share(check: Mapping[str, Any]) -> float:
    """The largest error of a quantity in units of its tolerance; infinite where one is not finite."""
    largest = max(map(float, check["error"]), default=0.0)
    return largest / check["tolerance"] if check["tolerance"] else (math.inf if largest else 0.0)
