"""The stress run: which cases, two at a time where they may, each kept as it ends, a verdict for every one."""

from __future__ import annotations

import functools
import hashlib
import json
import queue
import shutil
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path

from gran_bench.files import write_text
from gran_bench.progress import Progress
from gran_bench.provenance.source_digest import source_digest
from gran_bench.stress.case_list import StressCase
from gran_bench.stress.expectation import Outcome, verdict
from gran_bench.stress.perform import EXPERIMENTS, model_words, outcome_of, perform
from gran_bench.surrogate.checkpoint import file_digest
from gran_bench.workers import Worker

KEPT, SHARED = "kept", "beds"


@dataclass
class Errand:
    """A case for the DEM or for one model, and what came of it once it is carried out."""

    case: StressCase
    checkpoint: str  # model file; empty for the DEM
    model: str  # its label
    file: Path  # where the outcome is kept until the whole run ends
    outcome: Outcome | None = None
    seconds: float = 0.0  # wall time
    kept: bool = False  # whether it is from an earlier, interrupted run

    @property
    def name(self) -> str:
        """Of the case, and of its model where it has one."""
        return f"{self.case.name}, {self.model}" if self.model else self.case.name

    @property
    def verdict(self) -> tuple[str, str]:
        """How it ended, in a word, and what was found."""
        return verdict(self.case.expectation, self.outcome)


def errands(cases: Sequence[StressCase], checkpoints: Sequence[Path], folder: Path) -> list[Errand]:
    """Every case once, or once for each model file that it is for.

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
    for folder in (files("gran_bench.conf"), files("gran_bench.stress") / "lists"):
        for path in sorted(Path(str(folder)).rglob("*.yaml")):
            content = path.read_bytes()
            digest.update(f"{path.relative_to(str(folder))}\n{len(content)}\n".encode() + content)
    return digest.hexdigest()


def carry_out(todo: Sequence[Errand], folder: Path, workers: int, patience: float) -> None:
    """Give each errand its outcome; what an interrupted run in the folder has finished is taken from there.

    Args:
        workers: cases at a time; 1 does all in this process, where nothing ends a case that hangs.
        patience: s that a case may take in a process of its own.
    """
    shared, idle = str((folder / SHARED).resolve()), queue.SimpleQueue()
    # Threads of the DEM are a case's own choice: some compare them.
    crew = [Worker("gran_bench.stress.perform", {"OMP_NUM_THREADS": "1"}) for _ in range(workers * (workers > 1))]
    for worker in crew or [None]:
        idle.put(worker)
    alone = [errand for errand in todo if EXPERIMENTS[errand.case.kind].alone]
    beside = [errand for errand in todo if errand not in alone]
    with Progress(total=len(todo), desc="stress", unit="case", leave=False) as bar:

        def one(errand: Errand) -> None:
            worker = idle.get()
            _carry_out(errand, shared, worker, patience)
            idle.put(worker)
            bar.set_postfix_str(errand.case.name[:40], refresh=False)
            bar.update()

        lanes = ThreadPoolExecutor(workers)
        try:
            for some in (beside, *([errand] for errand in alone)):
                list((lanes.map if crew else map)(one, some))
        finally:
            lanes.shutdown(wait=False, cancel_futures=True)  # nobody waits for what an interruption ends
            for worker in crew:
                worker.end()
            lanes.shutdown()


def forget(folder: Path) -> None:
    """Remove what a finished run has kept, so that the next one does everything anew."""
    for name in (KEPT, SHARED):
        shutil.rmtree(folder / name, ignore_errors=True)


def _carry_out(errand: Errand, shared: str, worker: Worker | None, patience: float) -> None:
    case, began = errand.case, time.perf_counter()
    if errand.file.exists():
        (answer, errand.seconds), errand.kept = json.loads(errand.file.read_text("utf-8")), True
    else:
        task = {"kind": case.kind, "parameters": case.parameters, "checkpoint": errand.checkpoint, "shared": shared}
        answer = asdict(perform(**task)) if worker is None else worker.ask(task, patience)
        errand.seconds = time.perf_counter() - began
        if "died" in answer:  # it gets another chance in the next run
            answer = {"error": "Hang" if answer["late"] else "Crash", "message": answer["died"]}
        else:
            write_text(errand.file, json.dumps([answer, errand.seconds]) + "\n")
    errand.outcome = outcome_of(answer)
