"""Rounds are judged in processes of their own, several at a time, while nothing is timed; as a module, such a process.

Each process reads the replicas' summaries once, as they were made.
"""

import os
import pickle
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from gran_bench.benchmark.contest import Method
from gran_bench.benchmark.errors import Reference, errors_file, score_run
from gran_bench.files import write_atomically
from gran_bench.workers import Worker, crew, serve

JUDGED_AT_A_TIME = 2
PATIENCE = 3600.0  # s that the judgement of a round may take: minutes at most

Judge = Callable[[Iterable[tuple[Method, Path]], int], None]  # of methods and their folders, and of a round


class JudgingError(RuntimeError):
    """A judgement that could not be made; the message names the method and what went wrong."""


@contextmanager
def judges(reference: Reference) -> Iterator[Judge]:
    """Yield what judges a round of methods and keeps what is found (`errors.score_run`), in processes that end here."""
    workers = [Worker("gran_bench.benchmark.judges") for _ in range(min(JUDGED_AT_A_TIME, os.cpu_count() or 1))]
    free: SimpleQueue[Worker] = SimpleQueue()
    for worker in workers:
        free.put(worker)
    with tempfile.TemporaryDirectory() as place, crew(workers, len(workers)) as threads:
        kept = Path(place) / "reference.pickle"

        def judge(method: Method, folder: Path, index: int) -> None:
            worker = free.get()
            request = {"reference": str(kept), "method": asdict(method), "folder": str(folder), "index": index}
            answer = worker.ask(request, PATIENCE)
            free.put(worker)
            if "died" in answer:
                raise JudgingError(f"round {index} of {method.name} was not judged: {answer['died']}")

        def judge_all(methods: Iterable[tuple[Method, Path]], index: int) -> None:
            left = [one for one in methods if not errors_file(one[1], reference.digest, index).exists()]
            if left and not kept.exists():
                write_atomically(kept, lambda file: pickle.dump(reference, file, pickle.HIGHEST_PROTOCOL))
            for done in [threads.submit(judge, *one, index) for one in left]:
                done.result()

        yield judge_all


def _server() -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Reads the replicas at the first request, and judges a round at each."""
    known: dict[str, Reference] = {}

    def answer(request: dict[str, Any]) -> dict[str, Any]:
        try:
            if (path := request["reference"]) not in known:
                known[path] = pickle.loads(Path(path).read_bytes())
            score_run(Method(**request["method"]), Path(request["folder"]), known[path], request["index"])
            return {"judged": True}
        except Exception as error:  # told by the parent, which ends with it
            return {"died": f"{type(error).__name__}: {error}"}

    return answer


if __name__ == "__main__":
    serve(_server())
