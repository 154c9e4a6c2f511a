"""A process that does one small job and may be killed at any moment; it says ``begins`` when the job does."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import gran_bench
from gran_bench.processes import ONE_THREAD

PATIENCE = 500.0  # s, for a process that should have ended long ago


def start(job: str, **values: Any) -> subprocess.Popen[str]:
    """A process that does a job; returns when the job begins.

    Args:
        job: ``data``, ``training`` or ``tracking``.
        values: arguments of the function of that name.
    """
    process = launch(job, **values)
    assert process.stdout is not None
    assert process.stdout.readline() == "begins\n", process.communicate()[1]
    return process


def launch(job: str, **values: Any) -> subprocess.Popen[str]:
    """As :func:`start`, without waiting for the job to begin."""
    sources = str(Path(gran_bench.__file__).parents[1])
    return subprocess.Popen(
        [sys.executable, __file__, job, json.dumps(values)],
        env=os.environ | ONE_THREAD | {"PYTHONPATH": sources},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def finish(process: subprocess.Popen[str]) -> str:
    """Let a process end well; what it said on stderr."""
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, errors
    return errors


def kill_after(process: subprocess.Popen[str], seconds: float) -> bool:
    """``kill -9`` of a process after a while; whether it was still at work."""
    time.sleep(seconds)
    working = process.poll() is None
    process.kill()
    process.communicate()
    return working


def data(root: str, workers: int, seconds: float = 2.0) -> None:
    """Make the tiny data set."""
    from tiny import tiny_specs

    from gran_bench.dataset import ensure_cases

    specs = tiny_specs(seconds)
    print("begins", flush=True)
    ensure_cases(specs, root, workers=workers, progress=False)


def training(root: str, folder: str) -> None:
    """Train on the tiny data set, or go on, and leave the final weights."""
    import torch
    from tiny import tiny_trainer

    from gran_bench.surrogate.contact.compiling import compile_kernels, kernels_missing

    if kernels_missing("contact"):  # as every command does: a process that compiles for itself trains other bits
        compile_kernels("contact")
    trainer = tiny_trainer(Path(root), Path(folder))
    print("begins", flush=True)
    trainer.run(progress=False)
    torch.save(trainer.final_weights(), Path(folder) / "final.pt")


def tracking(root: str, number: int, steps: int, gate: str) -> None:
    """Wait until all are there, then record a run of so many steps."""
    from gran_bench.config import TrackingConfig
    from gran_bench.tracking import open_run

    print("begins", flush=True)
    while not Path(gate).exists():
        time.sleep(0.01)
    config = TrackingConfig(experiment="shared", root=root)
    with open_run(config, f"job {number}", f"key-{number}", {"number": number}) as run:
        for step in range(steps):
            run.log_metrics({"loss": 1.0 / (1 + step), "number": float(number)}, step)
            run.flush()
        report = Path(root) / f"report-{number}.txt"
        report.write_text(f"{number}\n", "utf-8")
        run.log_artifact(report)


JOBS = {"data": data, "training": training, "tracking": tracking}

if __name__ == "__main__":
    JOBS[sys.argv[1]](**json.loads(sys.argv[2]))
