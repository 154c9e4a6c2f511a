"""The stress test: which cases, two at a time where they may, each kept as it ends; then table, page and verdict."""

import csv
import functools
import hashlib
import io
import json
import os
import queue
import shutil
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path

from gran_bench.config import StressConfig
from gran_bench.config.rules import ConfigError
from gran_bench.files import locked, write_text
from gran_bench.plots.stability import draw_dem_step, draw_energy_drift, draw_time_to_failure
from gran_bench.plots.style import titled
from gran_bench.processes import stop_on_signals, tell
from gran_bench.progress import Progress
from gran_bench.provenance import provenance, read_table
from gran_bench.provenance.source_digest import source_digest
from gran_bench.run.cost import PROCESS_BYTES, Cost, makespan
from gran_bench.shipped import SHIPPED, shipped_model
from gran_bench.stress.case_list import StressCase, cases_of_file, near_match, shipped_cases
from gran_bench.stress.expectation import FAILED, Observation
from gran_bench.stress.page import PAGE, TABLE, Errand, closing_line, table, write_results
from gran_bench.stress.perform import EXPERIMENTS, model_words, outcome_of, perform
from gran_bench.surrogate.checkpoint import file_digest
from gran_bench.workers import Worker, crew

USUAL_SECONDS = 6.0  # of a case, where no earlier page says it
LOCK = ".lock"  # in the folder of the page
PART = "part"  # folder of the page of less than the whole list
KEPT, SHARED = "kept", "beds"


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
        for name in (KEPT, SHARED):  # so that the next one does everything anew
            shutil.rmtree(folder / name, ignore_errors=True)
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
    tell(f"another stress test runs in {folder}; waiting for it to end (output=FOLDER would be one of its own)")


def chosen(config: StressConfig) -> tuple[list[StressCase], bool]:
    """The cases of a config, and whether they are the whole list for the shipped model; `ConfigError` of none."""
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
    for result in (result for result in results if isinstance(result.outcome, Observation)):
        curves = result.outcome.curves
        if result.case.kind == "step_ladder":
            with titled("drum, 30 rpm, one packing"):
                draw_dem_step(curves, folder / "dem_step.png")
        elif result.case.kind == "energy_drift":
            draw_energy_drift(curves, folder / "energy_drift.png")
        elif result.case.kind in ("model_rollout", "untrained_rollout"):
            values, known = result.case.parameters, EXPERIMENTS[result.case.kind].parameters
            # The paper's drum, unchanged but for its speed.
            if values.get("scene", known["scene"].default) == "drum" and not {"changes", "then"} & set(values):
                end = curves["speed_rpm"][0], curves["time_to_failure"][0], bool(curves["survived"][0])
                runs[result.model or f"{values['model']}, untrained"].append(end)
    if runs:
        with titled("drum, one packing"):
            draw_time_to_failure(runs, folder / "time_to_failure.png")


def errands(cases: Sequence[StressCase], checkpoints: Sequence[Path], folder: Path) -> list[Errand]:
    """Every case once, or once for each model file it is for; raises what `model_words` raises."""
    code, found = package_digest(), []
    models = [(path, *model_words(path), file_digest(path)) for path in checkpoints]
    for case in cases:
        fitting = [m for m in models if not case.models or m[1] in case.models]
        for path, _, label, digest in fitting if EXPERIMENTS[case.kind].of_model else [("", "", "", "")]:
            words = json.dumps([case.kind, case.parameters, digest, code], sort_keys=True)
            name = hashlib.sha256(words.encode()).hexdigest()[:16]
            found.append(Errand(case, str(path), label, folder / KEPT / f"{name}.json"))
    return found


@functools.cache
def package_digest() -> str:
    """SHA-256 (64 hex digits) of all code, configs and lists of the package: a case may go through any of it."""
    digest = hashlib.sha256(source_digest(["."]).encode())
    for folder in (files("gran_bench.conf"), files("gran_bench.stress") / "lists"):
        for path in sorted(Path(str(folder)).rglob("*.yaml")):
            content = path.read_bytes()
            digest.update(f"{path.relative_to(str(folder))}\n{len(content)}\n".encode() + content)
    return digest.hexdigest()


def carry_out(todo: Sequence[Errand], folder: Path, workers: int, patience: float) -> None:
    """Give each errand its outcome; what an interrupted run in the folder has finished is taken from there.

    ``workers`` cases run at a time, each for ``patience`` s at most; a single one runs here, and nothing ends its hang.
    """
    shared, idle = str((folder / SHARED).resolve()), queue.SimpleQueue()
    # Threads of the DEM are a case's own choice: some compare them.
    hands = [Worker("gran_bench.stress.perform", {"OMP_NUM_THREADS": "1"}) for _ in range(workers * (workers > 1))]
    for worker in hands or [None]:
        idle.put(worker)
    alone = [errand for errand in todo if EXPERIMENTS[errand.case.kind].alone]
    groups = [[errand for errand in todo if errand not in alone], *([errand] for errand in alone)]
    bar = Progress(total=len(todo), desc="stress", unit="case", leave=False)
    with bar, crew(hands, workers) as threads:

        def one(errand: Errand) -> None:
            worker = idle.get()
            _carry_out(errand, shared, worker, patience)
            idle.put(worker)
            bar.set_postfix_str(errand.case.name[:40], refresh=False)
            bar.update()

        for some in groups:
            list((threads.map if hands else map)(one, some))


def _carry_out(errand: Errand, shared: str, worker: Worker | None, patience: float) -> None:
    case, began = errand.case, time.perf_counter()
    if errand.file.exists():
        answer, errand.seconds = json.loads(errand.file.read_text("utf-8"))
    else:
        task = {"kind": case.kind, "parameters": case.parameters, "checkpoint": errand.checkpoint, "shared": shared}
        answer = asdict(perform(**task)) if worker is None else worker.ask(task, patience)
        errand.seconds = time.perf_counter() - began
        if "died" in answer:  # it gets another chance in the next run
            answer = {"error": "Hang" if answer["late"] else "Crash", "message": answer["died"]}
        else:
            write_text(errand.file, json.dumps([answer, errand.seconds]) + "\n")
    errand.outcome = outcome_of(answer)
