"""What failed, counted: requirements, rollouts, cases of the stress test, runs of sweeps, methods of the benchmark."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence

from gran_bench.front_page.records import Records, benchmark_of, judgement_of
from gran_bench.metrics.outside import FailureCount, counted
from gran_bench.run_summary import missed_requirements
from gran_bench.stability.expectation import ABSENT, FAILED, FLAGGED, MET
from gran_bench.stability.page import PARTS
from gran_bench.sweep.run_file import FAILED as RUN_FAILED
from gran_bench.sweep.run_file import RunFile

NAMED = 3  # failures that are spelt out; all are counted
SURROGATE = "surrogate"  # part of the stress test


def failure_section(records: Records, mark: Callable[[str], str]) -> Iterator[str]:
    """Lines of the section.

    Args:
        records: as read.
        mark: of a record's name: a sign where code that made it has changed since.
    """
    for name, summary in records.runs.items():
        missed = missed_requirements(summary)
        said = f"- [{name}]({name}/README.md){mark(judgement_of(name))}: {counted(len(missed), 'requirement')} not met"
        yield f"{said}{_first(missed)}."
        for rollout, facts in summary["rollouts"].items():
            if facts["failed_frame"] is not None:
                yield f"  - rollout {rollout} broke down at frame {facts['failed_frame']}."
        for packing, judged in summary["judged"].items():
            if judged["failures"]:
                yield f"  - {packing} packing: {outright(FailureCount(**judged['failures']))}."
    if records.verification is not None:
        cases = records.verification["cases"]
        broken = [case["name"] for case in cases if not case["met"]]
        rest = f": {', '.join(broken)}" if broken else ""
        yield (
            f"- [The DEM's verification](verification/README.md){mark('verification')}: {len(broken)} of {len(cases)} "
            f"cases not met{rest}."
        )
    yield from _stress(records.stress, mark)
    for name, runs in records.sweeps.items():
        yield f"- [{name}](sweeps/{name}/README.md){mark(name)}: {sweep_failures(runs, records.waiting[name])}."
    for place, found in records.benchmarks.items():
        failed = [f"{row['name']} ({row['failure']})" for row in found["methods"] if row["failed"]]
        unfit = [row["name"] for row in found["methods"] if row["unfit_because"]]
        words = f"{len(failed)} of {len(found['methods'])} methods failed{_first(failed)}"
        words += f"; {len(unfit)} did not fit the scene" if unfit else ""
        yield f"- [benchmark {place}](benchmark/README.md){mark(benchmark_of(place))}: {words}."


def _first(words: Sequence[str]) -> str:
    """The first few of a list, and how many more there are: the page behind has them all."""
    more = f"; and {len(words) - NAMED} more" if len(words) > NAMED else ""
    return f": {'; '.join(words[:NAMED])}{more}" if words else ""


def outright(count: FailureCount) -> str:
    """What a rollout got wrong outright, in a line."""
    missing = max(0, count.expected_states - count.states)
    farthest = f"{1e3 * count.farthest:.3g} mm" if count.farthest < 1.0 else f"{count.farthest:.3g} m"
    return (
        f"{count.non_finite_states} of {count.expected_states} states not finite, {missing} missing; "
        f"{count.outside_tolerated} sphere states outside by > 5 mm, {count.outside_radius} by > r "
        f"({counted(count.outside_spheres, 'sphere')}); farthest {farthest}"
    )


def sweep_failures(runs: Sequence[RunFile], waiting: int) -> str:
    """Runs that failed, wait, broke down on the way or have an undefined figure, in a line."""
    failed = [run for run in runs if run.status == RUN_FAILED]
    done = [run for run in runs if run.status != RUN_FAILED]
    broken = sum(bool(run.facts.get("broken_rollouts")) for run in done)
    undefined = sum(None in run.figures.values() for run in done)
    outside = sum(
        any((judged["failures"] or {}).get("outside_radius") for judged in run.packings.values()) for run in done
    )
    missed = sum((run.figures.get("requirements_failed") or 0) > 0 for run in done)
    reasons = Counter((run.reason or "").partition(";")[0] for run in failed)
    why = f" ({'; '.join(f'{count} × {reason}' for reason, count in reasons.items())})" if failed else ""
    return (
        f"{len(failed)} of {len(runs)} runs failed{why}, {waiting} wait; of those that finished {broken} broke down in "
        f"a rollout, {undefined} have an undefined figure, {outside} lost spheres, {missed} miss a requirement"
    )


def broken_cases(rows: Sequence[dict[str, str]]) -> list[str]:
    """The stress cases of trained models whose rollout failed before its end, and when.

    A rollout fails at its first state that is not finite, has a centre outside by more than a radius, or has more
    than twice the energy that falling and turning give.
    """
    found = []
    for row in rows:
        quantities = json.loads(row["quantities"] or "{}")
        if row["part"] == SURROGATE and row["model"] and "horizon" in quantities:
            failed = quantities["time_to_failure"]
            if failed < quantities["horizon"]:
                found.append(f"{row['case']} (after {failed:g} s)")
    return found


def _stress(rows: Sequence[dict[str, str]], mark: Callable[[str], str]) -> Iterator[str]:
    if not rows:
        yield "- The stress test: not made yet; `python -m gran_bench.stress` (`make stress`)."
        return
    yield f"- [The stress test](stress/README.md){mark('stress/stress')}: {len(rows)} cases."
    yield ""
    words = [word for word in (MET, FLAGGED, ABSENT, FAILED) if word in (MET, FLAGGED, FAILED) or _count(rows, word)]
    yield f"  | | cases | {' | '.join(words)} |"
    yield "  |---|---:|" + "---:|" * len(words)
    for part, title in PARTS.items():
        some = [row for row in rows if row["part"] == part]
        yield f"  | {title} | {len(some)} | {' | '.join(str(_count(some, word)) for word in words)} |"
    yield ""
    yield "  *Flagged*: it may fail, and the program says so itself."
    broken = broken_cases(rows)
    if broken:
        yield f"  Rollouts of trained models that failed before their end, {len(broken)}: {', '.join(broken)}."
    for word in (FAILED, ABSENT):
        names = [row["case"] for row in rows if row["verdict"].startswith(word)]
        if names:
            yield f"  {word.capitalize()}: {', '.join(names)}."


def _count(rows: Sequence[dict[str, str]], word: str) -> int:
    return sum(row["verdict"].startswith(word) for row in rows)
