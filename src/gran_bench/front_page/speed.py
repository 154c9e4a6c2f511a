"""How fast, against what: the time of a frame of each surrogate beside the DEM and the DEM at a larger step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain
from typing import Any

import pandas as pd

from gran_bench.comparison.claims import frontier
from gran_bench.comparison.results import entries
from gran_bench.comparison.sentences import winner
from gran_bench.front_page.accuracy import baseline_words, run_words
from gran_bench.front_page.records import Records, benchmark_of, judgement_of


def speed_section(records: Records, mark: Callable[[str], str]) -> Iterator[str]:
    """Lines of the section.

    Args:
        records: as read.
        mark: of a record's name: a sign where code that made it has changed since.
    """
    yield from _benchmarks(records, mark)
    if records.runs:
        yield (
            "By the way, each judgement of a run timed its surrogate and the DEM, one thread, one after the other; "
            "other work on the machine counts, so that these times don't say who wins:"
        )
        yield ""
        yield "| | ms a frame | of | × the DEM |"
        yield "|---|---:|---:|---:|"
        rows = [_rows(name, summary, mark(judgement_of(name))) for name, summary in records.runs.items()]
        yield from dict.fromkeys(chain(*rows))  # two runs that were judged by the same DEM cases tell its time once
        yield ""
    if records.lammps is not None:
        yield f"{lammps_sentence(records.lammps)} [More](dem_speed/README.md){mark('dem_speed/lammps')}."


def _benchmarks(records: Records, mark: Callable[[str], str]) -> Iterator[str]:
    if not records.benchmarks:
        yield (
            "**Every method in turns, run time against error: not made yet.** `python -m gran_bench.benchmark` "
            "(`make bench`) makes it."
        )
        yield ""
        return
    for place, found in records.benchmarks.items():
        yield (
            f"**{found['scene']}** ([{place}](benchmark/README.md){mark(benchmark_of(place))}), {found['spheres']} "
            f"spheres, {found['motion']}; every method in turns, one thread. {winner(found)}"
        )
        yield ""
        yield "| | s for a simulated second | × the DEM | error, floors |"
        yield "|---|---:|---:|---:|"
        exact = {entry.name for entry in frontier(entries(found)) if entry.kind == "dem"}
        for row in found["methods"]:
            if row["kind"] != "dem" or row["name"] in exact or row["name"] == found["automatic"]:
                yield _method(row)
        yield ""


def _method(row: dict[str, Any]) -> str:
    """A method of the benchmark."""
    if row["unfit_because"]:
        return f"| {row['name']} | does not fit this scene | | |"
    times = [f"{row[key]['median']:.3g}" if row[key] else "–" for key in ("wall", "relative")]
    error = "failed" if row["failed"] else "time alone" if row["floors"] is None else f"{row['floors']:.2f}"
    return f"| {row['name']} | {' | '.join(times)} | {error} |"


def _rows(name: str, summary: dict[str, Any], mark: str) -> Iterator[str]:
    """Surrogate, DEM and the DEM of larger steps, of one judgement."""
    rollout = summary["rollouts"][f"{summary['judged_rpm']:g}rpm"]
    frame, dem = f"{summary['frame_ms']:g} ms", rollout["dem_ms_per_frame"]
    times = {f"{run_words(name, summary)}{mark}": rollout["ms_per_frame_median"], "the DEM at its own step": dem}
    times |= {
        baseline_words(baseline, errors): errors["ms_per_frame"]
        for baseline, errors in summary["baselines"].items()
        if "ms_per_frame" in errors
    }
    for who, time in times.items():
        yield f"| {who} | {time:.1f} | {frame} | {time / dem:.2f} |"


def lammps_sentence(table: pd.DataFrame) -> str:
    """The DEM beside LAMMPS at its best skin, on as many cores."""
    words = []
    for cores, rows in table.groupby("cores"):
        ours = rows[rows["solver"].str.startswith("gran-bench")]["median_us"].min()
        theirs = rows[rows["solver"].str.startswith("LAMMPS")]["median_us"].min()
        words.append(f"{ours:.0f} µs a step against {theirs:.0f} on {cores} core{'s' * (cores > 1)}")
        words[-1] += f" (LAMMPS takes {theirs / ours:.1f} times the time)"
    return f"This DEM beside LAMMPS `granular` on the same bed of `drum`: {', '.join(words)}."
