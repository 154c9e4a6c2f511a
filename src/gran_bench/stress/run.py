"""The stress run: which cases, two at a time where they may, each kept as it ends, a verdict for every one."""

from __future__ import annotations

import functools
import hashlib
import json
import queue
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path

from tqdm import tqdm

from gran_bench.files import write_text
from gran_bench.provenance.source_digest import source_digest
from gran_bench.stress.case_list import StressCase
from gran_bench.stress.crew import Worker, outcome_of
from gran_bench.stress.expectation import Failure, Observation, Outcome, Verdict, verdict
from gran_bench.stress.perform import Task, model_words, perform
from gran_bench.stress.registry import EXPERIMENTS
from gran_bench.surrogate.checkpoint import file_digest

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
    def verdict(self) -> Verdict:
        """How it ended."""
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
        of_model = EXPERIMENTS[case.kind].of_model
        fitting = [m for m in models if not case.models or m[1] in case.models]
        for path, _, label, digest in fitting if of_model else [("", "", "", "")]:
            words = json.dumps([case.kind, case.parameters, digest, code], sort_keys=True)
            name = hashlib.sha256(words.encode()).hexdigest()[:16]
            found.append(Errand(case, str(path), label, folder / KEPT / f"{name}.json"))
    return found


@functools.cache
def package_digest() -> str:
    """SHA-256 (64 hex digits) of what a case may depend on: all code, configs and lists of the package.

    Any case may go through any of it, so nothing is left out.
    """
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


def carry_out(
    todo: Sequence[Errand], folder: Path, workers: int, patience: float, tell: Callable[[Result], None]
) -> list[Result]:
    """Carry all out; what an interrupted run has finished is taken from there.

    Args:
        todo: in order.
        folder: of the run.
        workers: cases at a time; 1 does all in this process, where nothing ends a case that hangs.
        patience: s that a case may take in a process of its own.
        tell: gets each result as it comes.

    Returns:
        The results, in the order of ``todo``.
    """
    results: dict[int, Result] = {}
    lock = threading.Lock()
    # None: silent where stderr is no terminal.
    with tqdm(total=len(todo), unit=" cases", leave=False, disable=None) as bar:

        def one(number: int, act: Callable[[Task], Outcome]) -> None:
            result = _kept(todo[number]) or _carried_out(todo[number], folder, act)
            with lock:
                results[number] = result
                bar.update()
                bar.set_postfix_str(todo[number].case.name[:40], refresh=False)
                tell(result)

        alone = [n for n, errand in enumerate(todo) if EXPERIMENTS[errand.case.kind].alone]
        beside = [n for n in range(len(todo)) if n not in alone]
        if workers == 1:
            for number in (*beside, *alone):
                one(number, perform)
        else:
            _in_processes(beside, workers, patience, one)
            _in_processes(alone, 1, patience, one)
    return [results[number] for number in range(len(todo))]


def forget(folder: Path) -> None:
    """Remove what a finished run has kept, so that the next one does everything anew."""
    for name in (KEPT, SHARED):
        shutil.rmtree(folder / name, ignore_errors=True)


def _in_processes(
    numbers: Sequence[int], workers: int, patience: float, one: Callable[[int, Callable[[Task], Outcome]], None]
) -> None:
    waiting: queue.SimpleQueue[int] = queue.SimpleQueue()
    for number in numbers:
        waiting.put(number)
    crew = [Worker(patience) for _ in range(min(workers, len(numbers)))]

    def lane(worker: Worker) -> None:
        while True:
            try:
                number = waiting.get_nowait()
            except queue.Empty:
                return
            one(number, worker.perform)

    try:
        with ThreadPoolExecutor(max(len(crew), 1)) as lanes:
            try:
                for future in [lanes.submit(lane, worker) for worker in crew]:
                    future.result()
            except BaseException:
                while not waiting.empty():
                    waiting.get()
                for worker in crew:
                    worker.dismiss()
                raise
    finally:
        for worker in crew:
            worker.dismiss()


def _carried_out(errand: Errand, folder: Path, act: Callable[[Task], Outcome]) -> Result:
    case, began = errand.case, time.perf_counter()
    task = Task(case.kind, dict(case.parameters), errand.checkpoint, str((folder / SHARED).resolve()))
    outcome = act(task)
    result = Result(case, errand.model, outcome, time.perf_counter() - began)
    if not isinstance(outcome, Failure) or outcome.error not in ("Crash", "Hang"):
        form = "observation" if isinstance(outcome, Observation) else "failure"
        write_text(errand.file, json.dumps({form: asdict(outcome), "seconds": result.seconds}) + "\n")
    return result


def _kept(errand: Errand) -> Result | None:
    try:
        document = json.loads(errand.file.read_text("utf-8"))
    except OSError:
        return None
    return Result(errand.case, errand.model, outcome_of(document), float(document["seconds"]), kept=True)
