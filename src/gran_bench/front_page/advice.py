"""When not to use a surrogate: sentences that follow from the figures, at equal accuracy."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from gran_bench.comparison.claims import Entry, EqualAccuracy, equal_accuracy, paid_back, speed_up
from gran_bench.comparison.results import entries
from gran_bench.front_page.accuracy import RANKED
from gran_bench.front_page.failures import broken_cases
from gran_bench.front_page.records import Records, benchmark_of, judgement_of

SURROGATE = "surrogate"  # kind of a method


def advice_section(records: Records, mark: Callable[[str], str]) -> Iterator[str]:
    """Lines of the section.

    Args:
        records: as read.
        mark: of a record's name: a sign where code that made it has changed since.
    """
    for place, found in records.benchmarks.items():
        for line in benchmark_advice(found):
            yield f"- {line} [{place}](benchmark/README.md){mark(benchmark_of(place))}"
    if not records.benchmarks:
        yield "- Whether a surrogate pays beside a DEM that is as exact is not known yet: `make bench` decides."
    for name, summary in records.runs.items():
        for line in run_advice(name, summary):
            yield f"- {line}{mark(judgement_of(name))}"
    broken = broken_cases(records.stress)
    if broken:
        yield f"- Not where rollouts of trained models broke down: {', '.join(broken)}.{mark('stress/stress')}"


def benchmark_advice(found: Mapping[str, Any]) -> Iterator[str]:
    """For each surrogate of a benchmark, what its time says beside the fastest DEM that is as exact.

    Args:
        found: as in ``benchmark.json``.
    """
    every, accepted = entries(dict(found)), found["reference"]["accepted"]
    timed = {entry.name: entry for entry in every}
    for row in found["methods"]:
        name, scene = row["name"], f"`{found['scene']}`"
        if row["kind"] != SURROGATE:
            continue
        if row["unfit_because"]:
            yield f"Not **{name}** in {scene}: it does not fit, {row['unfit_because']}."
        elif row["failed"]:
            yield f"Not **{name}** in {scene}: it failed, {row['failure']}."
        elif name in timed:
            yield _beside(equal_accuracy(timed[name], every, accepted), scene)


def run_advice(name: str, summary: Mapping[str, Any]) -> Iterator[str]:
    """What the errors of one judged run say against using its surrogate; its times were not taken in turns.

    Error is the worst of the ranked ones, in noise floors.

    Args:
        name: of the run.
        summary: as in ``summary.json``.
    """
    shared, who = summary["judged"]["shared"], f"`{summary['model']['name']}` ({name})"
    own = worst_floors(shared["errors"])
    missed = [row["label"] for row in shared["requirements"].values() if row["verdict"] == "fail"]
    if own is None or missed:
        why = "an error is undefined" if own is None else f"it errs by {own:.2f} floors"
        total = len(shared["requirements"])
        yield f"Not {who} as it was trained here: it misses {len(missed)} of {total} requirements, and {why}."
        return
    for baseline, errors in summary["baselines"].items():
        floors = worst_floors(errors)
        if floors is not None and floors <= own and "ms_per_frame" not in errors:
            yield (
                f"Not where a baseline answers the question: {baseline} errs by {floors:.2f} floors, {who} by "
                f"{own:.2f}, and costs nothing."
            )


def worst_floors(errors: Mapping[str, Any]) -> float | None:
    """The worst of the ranked errors in noise floors; None where one is undefined."""
    multiples = [errors[key]["multiple_of_floor"] for key, _ in RANKED if key in errors]
    return None if not multiples or None in multiples else max(multiples)


def _beside(beside: EqualAccuracy, scene: str) -> str:
    """A surrogate beside the fastest DEM that is as exact, where the intervals of errors and times allow a word."""
    entry, rival = beside.entry, beside.rival or beside.lenient
    if rival is None:
        return f"In {scene} no DEM that was tried is as exact as **{entry.name}**, {entry.floors:.2f} floors."
    if beside.faster == "undecided":
        lenient = beside.lenient
        return (
            f"In {scene} it is undecided whether **{entry.name}** or a DEM that is as exact is faster: within the "
            f"intervals of the errors {lenient.name} is as exact ({_floors(lenient)} beside {_floors(entry)})."
        )
    ratio = speed_up(entry, rival)
    numbers = f"{rival.floors:.2f} floors beside {entry.floors:.2f}"
    if beside.faster == "neither":
        return (
            f"In {scene} **{entry.name}** and the DEM that is as exact ({rival.name}, {numbers}) are not told apart in "
            "time."
        )
    if beside.faster == "rival":
        return f"Not **{entry.name}** in {scene}: {rival.name} is {1 / ratio.middle:.2g} times as fast ({numbers})."
    return (
        f"Not **{entry.name}** in {scene} for fewer than {math.ceil(paid_back(beside)):,} simulated seconds, until "
        f"when its data and training are not paid back; it is {ratio.middle:.2g} times as fast as {rival.name} "
        f"({numbers})."
    )


def _floors(entry: Entry) -> str:
    return f"{entry.floors:.2f} floors, {entry.least:.2f} to {entry.most:.2f}"
