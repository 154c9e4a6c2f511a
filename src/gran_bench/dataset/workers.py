"""Jobs in processes of their own, which die with the process that started them.

A worker is ``python -m gran_bench.dataset.worker``: it reads jobs and writes progress as lines of JSON. That
works from any script or notebook (nothing of the caller is imported anew).
"""

from __future__ import annotations

import json
import queue
import subprocess
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from typing import Any

from gran_bench.config import DemConfig
from gran_bench.dataset.case_spec import CaseSpec
from gran_bench.dataset.generation import Job
from gran_bench.dataset.progress import SimulatedTimeBar
from gran_bench.dataset.scene_document import from_document, to_document
from gran_bench.processes import ONE_THREAD, start_module


def spec_to_document(spec: CaseSpec) -> dict[str, Any]:
    """A case specification as plain data."""
    return asdict(spec) | {"scene": to_document(spec.scene)}


def spec_from_document(document: dict[str, Any]) -> CaseSpec:
    """The case specification that plain data describe."""
    settling = document["settling_dem"]
    return CaseSpec(
        **document
        | {
            "scene": from_document(document["scene"]),
            "dem": DemConfig(**document["dem"]),
            "settling_dem": DemConfig(**settling) if settling else None,
        }
    )


def run_in_workers(jobs: list[Job], workers: int, bar: SimulatedTimeBar) -> list[tuple[Job, str]]:
    """Run jobs, ``workers`` at a time.

    Returns:
        The jobs that failed, each with what went wrong.
    """
    waiting: queue.SimpleQueue[Job] = queue.SimpleQueue()
    for job in jobs:
        waiting.put(job)
    failures: list[tuple[Job, str]] = []
    crew = _Crew()

    def lane() -> None:
        with tempfile.TemporaryFile() as complaints:
            worker = None
            while True:
                try:
                    job = waiting.get_nowait()
                except queue.Empty:
                    break
                if worker is None:
                    worker = crew.hire(complaints)
                trouble = _converse(worker, job, bar)
                if trouble is None and worker.poll() is None:
                    bar.finished(job)
                else:
                    failures.append((job, trouble or _last_words(worker, complaints)))
                if worker.poll() is not None:
                    worker = None
            if worker is not None:
                crew.dismiss(worker)

    try:
        with ThreadPoolExecutor(workers) as lanes:
            try:
                for future in [lanes.submit(lane) for _ in range(workers)]:
                    future.result()
            except BaseException:
                # The lanes end once their workers are gone and nothing waits.
                while not waiting.empty():
                    waiting.get()
                crew.kill()
                raise
    finally:
        crew.kill()
    return failures


class _Crew:
    """The processes that were started and have not ended."""

    def __init__(self) -> None:
        self._lock, self._workers, self._closed = threading.Lock(), [], False

    def hire(self, complaints: Any) -> subprocess.Popen:
        with self._lock:
            if self._closed:
                raise RuntimeError("the data generation was stopped")
            worker = start_module(
                "gran_bench.dataset.worker",
                environment=ONE_THREAD,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=complaints,
                text=True,
            )
            self._workers.append(worker)
        return worker

    def dismiss(self, worker: subprocess.Popen) -> None:
        """Let a worker without work end."""
        worker.stdin.close()
        worker.wait()
        worker.stdout.close()

    def kill(self) -> None:
        """End all that still run; finished files stay, unfinished ones never had their name."""
        with self._lock:
            self._closed = True
            for worker in self._workers:
                if worker.poll() is None:
                    worker.kill()
                    worker.wait()


def _converse(worker: subprocess.Popen, job: Job, bar: SimulatedTimeBar) -> str | None:
    """Give a job to a worker and follow it to its end; what went wrong, or None."""
    request = {"spec": spec_to_document(job.spec), "root": str(job.root), "settles": job.settles, "path": str(job.path)}
    try:
        worker.stdin.write(json.dumps(request) + "\n")
        worker.stdin.flush()
    except BrokenPipeError:
        worker.wait()
        return None
    for line in worker.stdout:
        message = json.loads(line)
        if "reached" in message:
            bar.reached(job, message["reached"])
        elif "waits" in message:
            bar.waits(job)
        elif "failed" in message:
            return message["failed"]
        elif "done" in message:
            return None
    worker.wait()
    return None


def _last_words(worker: subprocess.Popen, complaints: Any) -> str:
    """Why a worker ended in the middle of a job, from its exit status and the end of what it wrote."""
    complaints.seek(0)
    text = complaints.read().decode(errors="replace").strip().splitlines()
    if worker.returncode is not None and worker.returncode < 0:
        why = f"its process was ended by signal {-worker.returncode} (9: often a lack of memory; try dataset.workers=1)"
    else:
        why = text[-1] if text else f"its process ended with status {worker.returncode}"
    return f"{why}; run the same command again, finished files are kept"
