"""The page in a few lines, for a reader with a minute: how accurate, how fast, what failed, when not."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

from gran_bench.comparison.sentences import winner
from gran_bench.front_page.accuracy import RANKED
from gran_bench.front_page.advice import benchmark_advice, run_advice, worst_floors
from gran_bench.front_page.failures import broken_cases
from gran_bench.front_page.records import Records
from gran_bench.run_summary import missed_requirements
from gran_bench.stability.expectation import ABSENT, FAILED
from gran_bench.sweep.run_file import FAILED as RUN_FAILED


def in_short(records: Records) -> Iterator[str]:
    """A line for each question that the page answers; one that no record answers is left to its section."""
    for name, summary in list(records.runs.items())[:1]:
        who = f"`{summary['model']['name']}` ({name})"
        words = []
        for packing, judged in summary["judged"].items():
            floors = worst_floors(judged["errors"])
            shown = "undefined" if floors is None else f"{floors:.1f} noise floors"
            words.append(f"{shown} from a packing that training {'saw' if packing == 'shared' else 'did not see'}")
        yield (
            f"- **How accurate?** At {summary['judged_rpm']:g} rpm, {summary['judged_as']}, the worst of {len(RANKED)} "
            f"errors of {who} is {', '.join(words)}; the DEM against itself is at 1."
        )
        if not records.benchmarks:
            rollout = summary["rollouts"][f"{summary['judged_rpm']:g}rpm"]
            others = [f"the DEM {rollout['dem_ms_per_frame']:.1f} ms"]
            others += [f"{n} {row['ms_per_frame']:.1f} ms" for n, row in summary["baselines"].items() if _timed(row)]
            yield (
                f"- **How fast?** {who} takes {rollout['ms_per_frame_median']:.1f} ms for a frame of "
                f"{summary['frame_ms']:g} ms; {'; '.join(others)}: not timed in turns, so these don't say who wins."
            )
    for found in records.benchmarks.values():
        yield f"- **How fast, in `{found['scene']}`?** {winner(found)}"
    yield f"- **What failed?** {'; '.join(_failures(records)) or 'Nothing has been tried.'}."
    advice = list(chain(*map(benchmark_advice, records.benchmarks.values())))
    advice += chain(*(run_advice(*run) for run in records.runs.items()))
    if advice:
        yield f"- **When not to use a surrogate?** {' '.join(advice)}"


def _timed(errors: dict) -> bool:
    return "ms_per_frame" in errors


def _failures(records: Records) -> Iterator[str]:
    for name, summary in records.runs.items():
        yield f"{len(missed_requirements(summary))} requirements of {name}"
    if records.verification is not None:
        cases = records.verification["cases"]
        yield f"{sum(not case['met'] for case in cases)} of the DEM's {len(cases)} verifications"
    if records.stress:
        unmet = sum(row["verdict"].startswith(FAILED) for row in records.stress)
        absent = sum(row["verdict"].startswith(ABSENT) for row in records.stress)
        rest = f" ({absent} {ABSENT})" if absent else ""
        yield f"{unmet} of {len(records.stress)} expectations of the stress test{rest}"
        yield f"{len(broken_cases(records.stress))} of its rollouts of trained models, before their end"
    if records.sweeps:
        runs = [run for some in records.sweeps.values() for run in some]
        yield f"{sum(run.status == RUN_FAILED for run in runs)} of {len(runs)} runs of sweeps"
    for place, found in records.benchmarks.items():
        yield f"{sum(row['failed'] for row in found['methods'])} of {len(found['methods'])} methods of {place}"
