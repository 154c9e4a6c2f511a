"""The stress run: which cases, two at a time where they may, each kept as it ends, a verdict for every one."""

from __future__ import annotations

import functools
import hashlib
import json
import queue
import shutil
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from tqdm import tqdm

from gran_bench.files import write_text
from gran_bench.provenance.source_digest import source_digest
from gran_bench.stress.case_list import StressCase
from gran_bench.stress.expectation import Failure, Outcome, verdict
from gran_bench.stress.perform import EXPERIMENTS, model_words, outcome_of, perform, to_document
from gran_bench.surrogate.checkpoint import file_digest
from gran_bench.workers import Worker

KEPT, SHARED = "kept", "beds"


@dataclass(frozen=True)
class Result:
    """A case that was carried out.

    Attributes:
        case: which.
        model: label of the model; empty for the DEM.
        outcome: what it showed.
        seconds: wall time, s.
        kept: whether it is from an earlier, interrupted run.
    """

    case: StressCase
    model: str
    outcome: Outcome
    seconds: float
    kept: bool = False

    @property
    def name(self) -> str:
        """Of the case, and of its model where it has one."""
        return f"{self.case.name}, {self.model}" if self.model else self.case.name

    @property
    def verdict(self) -> tuple[str, str]:
        """How it ended, in a word, and what was found."""
        return verdict(self.case.expectation, self.outcome)


@dataclass(frozen=True)
class Errand:
    """A case, its model, and where its outcome is kept."""

    case: StressCase
    checkpoint: str
    model: str
    file: Path


def errands(cases: Sequence[StressCase], checkpoints: Sequence[Path], folder: Path) -> list[Errand]:
    """Every case once, or once for each model that it is for.

    Args:
        cases: in order.
        checkpoints: model files.
        folder: of the run.

    Raises:
        CheckpointError, ConfigError: a file that is no model, or one of other spheres.
    """
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
    for place in (files("gran_bench.conf"), files("gran_bench.stress") / "lists"):
        for name, content in sorted(_yaml_files(place, "")):
            digest.update(f"{name}\n{len(content)}\n".encode() + content)
    return digest.hexdigest()


def _yaml_files(folder: Traversable, path: str) -> Iterator[tuple[str, bytes]]:
    for entry in folder.iterdir():
        name = f"{path}/{entry.name}"
        if entry.is_dir():
            yield from _yaml_files(entry, name)
        elif entry.name.endswith(".yaml"):
            yield name, entry.read_bytes()


def carry_out(todo: Sequence[Errand], folder: Path, workers: int, patience: float) -> list[Result]:
    """Carry all out; what an interrupted run has finished is taken from there.

    Args:
        todo: in order.
        folder: of the run.
        workers: cases at a time; 1 does all in this process, where nothing ends a case that hangs.
        patience: s that a case may take in a process of its own.

    Returns:
        The results, in the order of ``todo``.
    """
    results: dict[int, Result] = {}
    lock, shared = threading.Lock(), str((folder / SHARED).resolve())
    alone = [number for number, errand in enumerate(todo) if EXPERIMENTS[errand.case.kind].alone]
    beside = [number for number in range(len(todo)) if number not in alone]
    # Threads of the DEM are a case's own choice: some compare them.
    crew = (
        [Worker("gran_bench.stress.perform", {"OMP_NUM_THREADS": "1"}) for _ in range(workers)] if workers > 1 else []
    )
    idle: queue.SimpleQueue[Worker | None] = queue.SimpleQueue()
    for worker in crew or [None]:
        idle.put(worker)
    # None: silent where stderr is no terminal.
    with tqdm(total=len(todo), unit=" cases", leave=False, disable=None) as bar:

        def one(number: int) -> None:
            worker, errand = idle.get(), todo[number]
            result = _kept(errand) or _carried_out(errand, shared, worker, patience)
            idle.put(worker)
            with lock:
                results[number] = result
                bar.update()
                bar.set_postfix_str(errand.case.name[:40], refresh=False)

        if not crew:
            for number in (*beside, *alone):
                one(number)
        lanes = ThreadPoolExecutor(workers)
        try:
            for numbers in [beside, *([number] for number in alone)] if crew else []:
                list(lanes.map(one, numbers))
        finally:
            lanes.shutdown(wait=False, cancel_futures=True)  # nobody waits for what an interruption ends
            for worker in crew:
                worker.end()
            lanes.shutdown()
    return [results[number] for number in range(len(todo))]


def forget(folder: Path) -> None:
    """Remove what a finished run has kept, so that the next one does everything anew."""
    for name in (KEPT, SHARED):
        shutil.rmtree(folder / name, ignore_errors=True)


def _carried_out(errand: Errand, shared: str, worker: Worker | None, patience: float) -> Result:
    case, began = errand.case, time.perf_counter()
    task = {"kind": case.kind, "parameters": case.parameters, "checkpoint": errand.checkpoint, "shared": shared}
    answer = to_document(perform(**task)) if worker is None else worker.ask(task, patience)
    seconds = time.perf_counter() - began
    if "died" in answer:  # it gets another chance in the next run
        return Result(case, errand.model, Failure("Hang" if answer["late"] else "Crash", answer["died"]), seconds)
    write_text(errand.file, json.dumps(answer | {"seconds": seconds}) + "\n")
    return Result(case, errand.model, outcome_of(answer), seconds)


def _kept(errand: Errand) -> Result | None:
    try:
        document: dict[str, Any] = json.loads(errand.file.read_text("utf-8"))
    except OSError:
        return None
    return Result(errand.case, errand.model, outcome_of(document), float(document["seconds"]), kept=True)
