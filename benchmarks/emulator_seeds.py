"""The emulator from several seeds: a table of finished runs, on the page of the benchmark.

    python -m gran_bench.train -m +experiment=emulator seed=0,1,2
    python benchmarks/emulator_seeds.py results/runs/emulator+seed-* --output results/benchmark

Errors are in units of the error that the mean of the other replicas has, means over all schedules of a packing.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dem_page import keep

from gran_bench.emulator.judging import SPREAD, WORST
from gran_bench.emulator.runs import COMPARED, FIGURES
from gran_bench.files import markdown

NAME, WORST_SCHEDULES = "emulator", 5


def rows(runs: Sequence[Mapping[str, Any]]) -> list[dict[str, object]]:
    """A row for each packing, measure and figure, a column for each run, and what is asked."""
    found = []
    for packing, bound in (("shared", WORST[False]), ("unseen", WORST[True])):
        measures = {"ratio": f"at most {bound:g}", "mean_ratio": "", "spread": "{:g} to {:g}".format(*SPREAD)}
        for measure, asked in measures.items():
            for figure in COMPARED:
                row = {"packing": packing, "measure": measure, "figure": FIGURES[figure][0], "asked": asked}
                values = (run["statistics"]["averages"][packing][figure][measure] for run in runs)
                found.append(row | {f"seed {k}": round(value, 3) for k, value in enumerate(values)})
    return found


def worst(runs: Sequence[Mapping[str, Any]]) -> str:
    """The schedules with the largest mean error of the centre-of-mass angle, and how often a DEM is slower."""
    schedules = {
        name: sum(run["statistics"]["schedules"][name]["com_angle"]["ratio"] for run in runs) / len(runs)
        for name in runs[0]["statistics"]["schedules"]
    }
    hardest = sorted(schedules, key=schedules.__getitem__)[-WORST_SCHEDULES:][::-1]
    times = ", ".join(f"{run['statistics']['times_faster'] or float('nan'):.0f}" for run in runs)
    lines = [f"farthest off, centre of mass: {', '.join(f'{name} {schedules[name]:.2f}' for name in hardest)}"]
    lines += [f"times as fast as the fastest DEM of the DEM's accuracy, side by side: {times}"]
    return "\n".join(lines)


def main() -> None:
    """Prints the table, and puts it on the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="folders of finished runs, in the order of their seeds")
    parser.add_argument("--output", type=Path, help="folder whose page gets the table")
    chosen = parser.parse_args()
    runs = [json.loads((folder / "summary.json").read_text("utf-8")) for folder in chosen.runs]
    table = rows(runs)
    lines = markdown([tuple(table[0]), *(tuple(map(str, row.values())) for row in table)], aligned=True)
    keep(NAME, "\n".join([*lines, "", worst(runs)]), chosen.output, table)


if __name__ == "__main__":
    main()
