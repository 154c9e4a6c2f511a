"""The command around the suite: arguments, a bar, the table, the page, and an exit code: is everything met?"""

from __future__ import annotations

import argparse
import difflib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from gran_bench.progress import Progress
from gran_bench.provenance import program, provenance
from gran_bench.verification import CASES
from gran_bench.verification.case import Case, Outcome, run_case
from gran_bench.verification.report import table, verdict, write_report

MET, FAILED, REFUSED, INTERRUPTED = 0, 1, 2, 130
FOLDER = Path("results/verification")


Draw = Callable[[Sequence[Outcome], Path], object]


def run(draw: Draw, words: Sequence[str] | None = None, cases: Sequence[Case] = CASES) -> int:
    """Verify the DEM; print a table with the worst point of each quantity, and write a page.

    Args:
        draw: draws the figures of outcomes into a folder.
        words: the command line; this process's own where None.
        cases: of the suite.

    Returns:
        0 where every quantity of every case is within its tolerance, 1 where one is not or a case stopped with an
        error, 2 for a bad argument, 130 after Ctrl-C.
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
    chosen = [c for c in cases if (c.name in arguments.case or not arguments.case) and (c.quick or not arguments.quick)]
    if not chosen:
        return _refused("--quick leaves out the cases that --case names; give one of the two")
    whole = not (arguments.case or arguments.quick)
    # A part of the suite does not replace the page of the whole, unless it is told to.
    folder = arguments.output or (FOLDER if whole else None)
    outcomes = []
    try:
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
        # None: silent where stderr is no terminal.
        with Progress(chosen, desc="verification", unit="case", leave=False) as bar:
            for case in bar:
                bar.set_description(case.name)
                outcomes.append(run_case(case))
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
