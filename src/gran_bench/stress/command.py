"""The command around the list: which part of it, the run, the table, the page, and an error where one is not met."""

from __future__ import annotations

import csv
import io
import os
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from gran_bench.config import StressConfig
from gran_bench.config.rules import ConfigError
from gran_bench.files import locked
from gran_bench.plots.stability import draw_dem_step, draw_energy_drift, draw_time_to_failure
from gran_bench.processes import stop_on_signals
from gran_bench.provenance import provenance, read_table
from gran_bench.run.cost import PROCESS_BYTES, Cost, makespan
from gran_bench.shipped import SHIPPED, shipped_model
from gran_bench.stress.case_list import StressCase, cases_of_file, near_match, shipped_cases
from gran_bench.stress.expectation import FAILED, Observation
from gran_bench.stress.page import PAGE, TABLE, closing_line, table, write_results
from gran_bench.stress.run import Errand, carry_out, errands, forget

USUAL_SECONDS = 6.0  # of a case, where no earlier page says it
LOCK = ".lock"  # in the folder of the page
PART = "part"  # folder of the page of less than the whole list


class StressFailed(RuntimeError):
    """At least one expectation was not met; the message names the cases."""


def run_stress(config: StressConfig) -> list[Errand]:
    """Carry out the list that a config describes; print its table and write its page.

    Raises:
        ConfigError: a list, or a case's name, that cannot be.
        StressFailed: an expectation that is not met, after everything is told and written.
        KeyboardInterrupt: SIGTERM or Ctrl-C; what is finished is kept.
    """
    cases, whole = chosen(config)
    folder = Path(config.output) if whole else Path(config.output) / PART
    files = [shipped_model() if file == SHIPPED else Path(file) for file in (config.checkpoint, *config.also)]
    results = errands(cases, files, folder)
    if stress_cost(results, folder, config).tell(config.dry_run):
        return []
    # Two at once would empty each other's work folders.
    with stop_on_signals(), locked(folder / LOCK, lambda: _tell_of_another(folder)):
        began = time.perf_counter()
        carry_out(results, folder, config.workers, config.patience)
        print(table(results))
        seconds = time.perf_counter() - began
        # Times are of a machine that may have had other work.
        origin = provenance() | {"load, mean of 1, 5 and 15 min": ", ".join(f"{load:.1f}" for load in os.getloadavg())}
        draw_figures(results, folder)
        write_results(results, folder, origin)
        forget(folder)
    print(f"\nthe page is {folder / PAGE}\n{closing_line(results, seconds)}")
    failed = [result.name for result in results if result.verdict[0] == FAILED]
    if failed:
        raise StressFailed(f"{len(failed)} of {len(results)} expectations are not met: {', '.join(failed)}")
    return results


def stress_cost(todo: Sequence[Errand], folder: Path, config: StressConfig) -> Cost:
    """What is left of a list, and what it will take: as long as it took when the page in its folder was written."""
    left = [errand for errand in todo if not errand.file.exists()]
    line = f"stress test: {len(left)} cases to do, {len(todo) - len(left)} kept from an interrupted run; "
    line += f"{config.workers} at a time, each at most {config.patience:g} s"
    known = io.StringIO(read_table(folder / TABLE)[1] if (folder / TABLE).exists() else "")
    seconds = {(row["case"], row["model"]): float(row["seconds"]) for row in csv.DictReader(known)}
    usual = sum(seconds.values()) / len(seconds) if seconds else USUAL_SECONDS
    expected = [seconds.get((errand.case.name, errand.model), usual) for errand in left]
    return Cost([line], {"cases": makespan(expected, config.workers)}, config.workers * PROCESS_BYTES["torch"], 1.0e8)


def _tell_of_another(folder: Path) -> None:
    message = f"another stress test runs in {folder}; waiting for it to end (output=FOLDER would be one of its own)"
    print(message, file=sys.stderr, flush=True)


def chosen(config: StressConfig) -> tuple[list[StressCase], bool]:
    """The cases that a config asks for, and whether they are the whole list for the shipped model.

    Raises:
        ConfigError: an unknown case, or nothing left.
    """
    everything = shipped_cases() if config.case_list is None else cases_of_file(Path(config.case_list))
    names = [case.name for case in everything]
    for name in config.cases:
        if name not in names:
            remedy = near_match(name, names, f"it has {', '.join(names)}")
            raise ConfigError(f"cases={config.cases}: {name!r} is not in the list; {remedy}")
    cases = [case for case in everything if case.name in (config.cases or names)]
    cases = [case for case in cases if case.short or config.selection == "full"]
    if not cases:
        raise ConfigError(f"selection={config.selection} leaves no case of cases={config.cases}; choose selection=full")
    ships = config.case_list is None and config.checkpoint == SHIPPED and not config.also
    return cases, ships and len(cases) == len(everything)


def draw_figures(results: Sequence[Errand], folder: Path) -> None:
    """The figures that the results have curves for."""
    folder.mkdir(parents=True, exist_ok=True)
    runs = defaultdict(list)
    for result in results:
        if not isinstance(result.outcome, Observation):
            continue
        curves = result.outcome.curves
        if result.case.kind == "step_ladder":
            draw_dem_step(curves, folder / "dem_step.png")
        elif result.case.kind == "energy_drift":
            draw_energy_drift(curves, folder / "energy_drift.png")
        elif label := _label_in_drum(result):
            runs[label].append((curves["speed_rpm"][0], curves["time_to_failure"][0], bool(curves["survived"][0])))
    if runs:
        draw_time_to_failure(runs, folder / "time_to_failure.png")


def _label_in_drum(result: Errand) -> str:
    """The model whose rollout in the paper's drum, unchanged but for its speed, a result is; empty for any other."""
    values, kind = result.case.parameters, result.case.kind
    plain = values.get("scene", "drum") == "drum" and not {"changes", "then"} & set(values)
    if kind == "model_rollout" and plain:
        return result.model
    return f"{values['model']}, untrained" if kind == "untrained_rollout" and values.get("scene") == "drum" else ""
