"""A process that does one small job and may be killed at any moment: ``python -m gran_bench.stress.victim``.

Started by the experiments on killed and competing processes, not by people. It says ``begins`` when the job does.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from gran_bench.files import write_text
from gran_bench.processes import ONE_THREAD, start_module
from gran_bench.tracking.address import SERVER


def start(job: str, **values: Any) -> subprocess.Popen[str]:
    """A process that does ``job``; returns when the job begins.

    Args:
        job: ``data``, ``training`` or ``tracking``.
        values: arguments of the function of that name.

    Raises:
        RuntimeError: it ended before it began.
    """
    process = launch(job, **values)
    assert process.stdout is not None
    if process.stdout.readline() != "begins\n":
        _, errors = process.communicate()
        raise RuntimeError(f"the process for {job} did not begin: {errors.strip().splitlines()[-1:]}")
    return process


def launch(job: str, **values: Any) -> subprocess.Popen[str]:
    """As :func:`start`, without waiting for the job to begin."""
    return start_module(
        "gran_bench.stress.victim",
        job,
        json.dumps(values),
        environment=ONE_THREAD | {SERVER: ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def data(root: str, workers: int, seconds: float) -> None:
    """Make the tiny data set."""
    from gran_bench.dataset import ensure_cases
    from gran_bench.stress.tiny import tiny_specs

    specs = tiny_specs(seconds=seconds)
    print("begins", flush=True)
    ensure_cases(specs, root, workers=workers, progress=False)


def training(root: str, folder: str) -> None:
    """Train on the tiny data set, or go on, and leave the final weights."""
    import torch

    from gran_bench.files import write_atomically
    from gran_bench.stress.tiny import tiny_trainer

    trainer = tiny_trainer(Path(root), Path(folder))
    print("begins", flush=True)
    trainer.run(progress=False)
    write_atomically(Path(folder) / "final.pt", lambda file: torch.save(trainer.final_weights(), file))


def tracking(root: str, number: int, steps: int, gate: str) -> None:
    """Wait until all are there, then record a run of so many steps."""
    import time

    from gran_bench.config import TrackingConfig
    from gran_bench.tracking import open_run

    print("begins", flush=True)
    while not Path(gate).exists():
        time.sleep(0.01)
    config = TrackingConfig(experiment="stress", root=root)
    with open_run(config, f"job {number}", f"key-{number}", {"number": number}) as run:
        for step in range(steps):
            run.log_metrics({"loss": 1.0 / (1 + step), "number": float(number)}, step)
            run.flush()
        report = Path(root) / f"report-{number}.txt"
        write_text(report, f"{number}\n")
        run.log_artifact(report)


JOBS = {"data": data, "training": training, "tracking": tracking}


if __name__ == "__main__":
    JOBS[sys.argv[1]](**json.loads(sys.argv[2]))
