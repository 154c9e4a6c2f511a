"""The command around the suite: arguments, a bar, tables, page and JSON, and an exit code: is everything met?"""

import argparse
import difflib
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gran_bench.files import markdown, write_part, write_text
from gran_bench.progress import Progress
from gran_bench.provenance import program, provenance, stamp
from gran_bench.verification import CASES
from gran_bench.verification.case import Case, Outcome, run_case

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
    return "\n".join(markdown([HEADS, *(row for outcome in outcomes for row in rows(outcome))], aligned=True))


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
    yield f"**{record['verdict']}.** {record['subset']}".rstrip() + "\n"
    rows, missed = [("case", "what is verified", "quantities", "points", "largest error / tolerance", "")], []
    for case in record["cases"]:
        checks, shares = case["checks"], [_share(check) for check in case["checks"]]
        points, worst = sum(len(check["expected"]) for check in checks), max(shares, default=math.nan)
        numbers = (str(len(checks)), str(points), f"{worst:.2g}")
        rows.append((case["name"], case["title"], *numbers, "met" if case["met"] else "FAILED"))
        missed += [f"- {case['name']}: {case['failure']}"] if case["failure"] is not None else []
        missed += [
            f"- {case['name']}, {check['quantity']}: {share:.3g} times its tolerance of {check['tolerance']}"
            for check, share in zip(checks, shares, strict=True)
            if not check["met"]
        ]
    yield from [*markdown(rows), "", *missed]
    yield from (f"![{caption}]({name})\n" for name, caption in FIGURES.items() if (folder / name).exists())
    yield f"Every point, and the source of each expected value: [`{JSON}`]({JSON}). {stamp(record['provenance'])}"


def _share(check: Mapping[str, Any]) -> float:
    """The largest error of a quantity in units of its tolerance; infinite where one is not finite."""
    largest = max(map(float, check["error"]), default=0.0)
    return largest / check["tolerance"] if check["tolerance"] else (math.inf if largest else 0.0)


MET, FAILED, REFUSED, INTERRUPTED = 0, 1, 2, 130
FOLDER = Path("results/verification")


def run(
    draw: Callable[[Sequence[Outcome], Path], object], words: Sequence[str] | None = None, cases: Sequence[Case] = CASES
) -> int:
    """Verify the DEM; print a table with the worst point of each quantity, and write a page.

    ``draw`` draws the figures of outcomes into a folder; ``words`` are the command line, this process's own where None.

    Returns:
        0 where every quantity is within its tolerance, 1 where one is not or a case stopped with an error, 2 for a bad
        argument, 130 after Ctrl-C.
    """
    arguments = _parser().parse_args(words)
    if arguments.list:
        width = max(len(case.name) for case in cases)
        print("\n".join(f"{case.name:{width}}  {'quick' if case.quick else '     '}  {case.title}" for case in cases))
        return MET
    names = [case.name for case in cases]
    for name in arguments.case:
        if name not in names:
            near = difflib.get_close_matches(name, names, 1)
            remedy = f"did you mean {near[0]}?" if near else "--list shows the names"
            return _refused(f"--case {name} is unknown; {remedy}")
    chosen = [c for c in cases if c.name in (arguments.case or names) and (c.quick or not arguments.quick)]
    if not chosen:
        return _refused("--quick leaves out the cases that --case names; give one of the two")
    whole = not (arguments.case or arguments.quick)
    # A part of the suite does not replace the page of the whole, unless it is told to.
    folder = arguments.output or (FOLDER if whole else None)
    try:
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
        bar = Progress(chosen, desc="verification", unit="case", leave=False)
        outcomes = [run_case(case) for case in bar]
        print(table(outcomes))
        if folder is not None:
            draw(outcomes, folder)
            subset = "" if whole else f"Of the whole suite's {len(cases)} cases these are {len(chosen)}."
            write_report(outcomes, folder, provenance(), subset)
            print(f"\nthe page is in {folder}")
    except BrokenPipeError:
        raise
    except OSError as error:
        return _refused(f"{error}; choose a folder for --output that can be written")
    except KeyboardInterrupt:
        print("interrupted; nothing was written", file=sys.stderr)
        return INTERRUPTED
    print(f"\n{verdict(outcomes)}")
    return MET if all(outcome.met for outcome in outcomes) else FAILED


def _refused(message: str) -> int:
    print(f"error: {message}", file=sys.stderr)
    return REFUSED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=" ".join(program()),
        description="Verify the DEM against theory; exit code 0 where all is within tolerance, 1 where it is not.",
    )
    page = f"where the page goes; {FOLDER} for the whole suite, nowhere for a part of it"
    parser.add_argument("--output", type=Path, metavar="FOLDER", help=page)
    parser.add_argument("--quick", action="store_true", help="leave out what takes long")
    parser.add_argument("--case", action="append", default=[], metavar="NAME", help="this case alone; may be repeated")
    parser.add_argument("--list", action="store_true", help="name the cases and end")
    return parser
