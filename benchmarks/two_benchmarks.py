"""Whether two runs of the benchmark agree: each method's time and error beside what the other run expects of it.

    python -m gran_bench.benchmark root=FIRST
    python -m gran_bench.benchmark root=SECOND seed=1
    python benchmarks/two_benchmarks.py FIRST/quick/drum SECOND/quick/drum --output results/benchmark

Another seed gives another order of turns and other nudges, so that nothing but machine and scene is shared. A run says
for each method where the median time and the mean error of another run lie with 95 % confidence: of twenty such
figures one is expected to fall outside by chance.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from gran_bench.benchmark.page import PAGE
from gran_bench.benchmark.results import RESULTS, read_results
from gran_bench.files import write_part
from gran_bench.provenance import stamp

NAME = "two runs"
QUANTITIES = ("time, s", "error, floors")


def figures(row: dict[str, Any]) -> list[tuple[float, float, float] | None]:
    """Of a method: (what was found, and the two ends of where another run's figure is expected), time and error."""
    wall, time, error = row["wall"], None, None
    if wall and wall["expected_low"] is not None and not row["failed"]:
        time = wall["median"], wall["expected_low"], wall["expected_high"]
    if row["floors"] is not None and not row["failed"]:
        error = row["floors"], row["floors_low"], row["floors_high"]
    return [time, error]


def verdict(one: tuple[float, float, float], other: tuple[float, float, float]) -> str:
    """Whether each figure lies where the other run expects it."""
    if other[1] <= one[0] <= other[2] and one[1] <= other[0] <= one[2]:
        return "agree"
    return "overlap" if one[1] <= other[2] and other[1] <= one[2] else "**differ**"


def part(first: dict[str, Any], second: dict[str, Any]) -> str:
    """How much of both runs agrees, and a row for each method of which something does not."""
    others, said, lines = {row["name"]: row for row in second["methods"]}, {name: [] for name in QUANTITIES}, []
    for row in first["methods"]:
        cells, words = [row["name"]], []
        for one, other in zip(figures(row), figures(others[row["name"]]), strict=True):
            if one is None or other is None:
                words.append("" if (one, other) == (None, None) else "**in one alone**")
                cells.append(words[-1])
                continue
            words.append(verdict(one, other))
            shown = " and ".join(f"{x[0]:.3g} ({x[1]:.3g} to {x[2]:.3g})" for x in (one, other))
            cells.append(f"{shown}: {words[-1]}")
        for name, word in zip(QUANTITIES, words, strict=True):
            said[name] += [word] if word else []
        if set(words) - {"", "agree"}:
            lines.append(f"| {' | '.join(cells)} |")
    counts = [
        f"- {name.partition(',')[0]}: {words.count('agree')} of {len(words)} lie where both runs expect them, "
        f"{words.count('overlap')} outside one of the two intervals, which overlap, the other "
        f"{len(words) - words.count('agree') - words.count('overlap')} differ."
        for name, words in said.items()
    ]
    table = [f"| method | {' | '.join(QUANTITIES)} |", "|---|---|---|", *lines, ""] if lines else []
    return "\n".join([*counts, "", *table, *(f"- {stamp(found['provenance'])}" for found in (first, second))])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=Path, help="folder of the results of one scene")
    parser.add_argument("second", type=Path)
    parser.add_argument("--output", type=Path, help="folder whose page gets the table")
    given = parser.parse_args()
    text = part(read_results(given.first / RESULTS), read_results(given.second / RESULTS))
    print(text)
    if given.output:
        write_part(given.output / PAGE, NAME, text, heading="Two runs")
