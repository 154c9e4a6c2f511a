"""kill -9 at random moments: the same command again ends with the same bits as one that nobody disturbed."""

from __future__ import annotations

import importlib.util
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from gran_bench.dataset import read_case, read_settled
from gran_bench.processes import start_module
from gran_bench.stress import victim
from gran_bench.stress.expectation import NotThereYet, Observation
from gran_bench.stress.experiment import Bench, Experiment
from gran_bench.stress.tiny import tiny_specs
from gran_bench.trainer import CHECKPOINT

PATIENCE = 500.0  # s, for a process that should have ended long ago
GRACE = 10.0  # s, for one that was asked to end
SWEEP = "gran_bench.stress.sweep_kill"


def killed_data(bench: Bench, kills: int, workers: int = 2, seconds: float = 2.0, seed: int = 0) -> Observation:
    """Data generation that is killed again and again.

    Args:
        kills: how often.
        workers: processes that make cases.
        seconds: of rotation of each case.
        seed: of the moments.
    """
    specs, calm, wild = tiny_specs(seconds=seconds), bench.folder / "calm", bench.folder / "wild"
    undisturbed = _finish(lambda: victim.start("data", root=str(calm), workers=1, seconds=seconds))
    hits, partial, moments = 0, 0, np.random.default_rng(seed).uniform(0.02, 0.9, kills)
    for moment in moments:
        process = victim.start("data", root=str(wild), workers=workers, seconds=seconds)
        hits += _kill_after(process, moment * max(undisturbed / workers, 0.2))
        partial += sum(not _whole(path) for path in wild.rglob("*.h5") if not path.name.startswith("."))
    _finish(lambda: victim.start("data", root=str(wild), workers=workers, seconds=seconds))
    differing = sum(read_case(spec.path(wild)).digest != read_case(spec.path(calm)).digest for spec in specs)
    left = len(list(wild.rglob("*.tmp")))
    return Observation(
        {"differing": float(differing), "partial": float(partial), "left_behind": float(left), "kills": float(hits)}
    )


def killed_training(bench: Bench, kills: int, seed: int = 0) -> Observation:
    """Training that is killed again and again.

    Args:
        kills: how often.
        seed: of the moments.
    """
    root, calm, wild = bench.folder / "data", bench.folder / "calm", bench.folder / "wild"
    values = {"root": str(root), "folder": str(calm)}
    undisturbed = _finish(lambda: victim.start("training", **values))
    values["folder"] = str(wild)
    hits, resumed = 0, 0
    for moment in np.random.default_rng(seed).uniform(0.1, 0.7, kills):
        process = victim.start("training", **values)
        hits += _kill_after(process, moment * undisturbed)
        resumed += (wild / CHECKPOINT).exists()
    _finish(lambda: victim.start("training", **values))
    mine, theirs = (torch.load(folder / "final.pt", weights_only=True) for folder in (wild, calm))
    differing = sum(int((mine[name] != theirs[name]).sum()) for name in theirs)
    left = len(list(wild.glob(".*.tmp")))
    return Observation(
        {"differing": float(differing), "partial": 0.0, "left_behind": float(left), "kills": float(hits)},
        (),
        {"resumed": [float(resumed)]},
    )


def killed_sweep(bench: Bench, jobs: int = 12, kills: int = 10, longest: float = 850.0) -> Observation:
    """A sweep that is killed again and again, by the module that knows sweeps; its exit code says how it ended.

    Args:
        jobs: of the sweep.
        kills: how often.
        longest: s that it may take.

    Raises:
        NotThereYet: this version has no such module.
    """
    if importlib.util.find_spec(SWEEP) is None:
        raise NotThereYet(f"{SWEEP} is not part of this version")
    process = start_module(
        SWEEP, "--jobs", str(jobs), "--kills", str(kills),
        cwd=bench.folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        said, errors = process.communicate(timeout=longest)
    except BaseException:
        _end(process)
        raise
    told = [line.strip() for line in (said + errors).splitlines() if line.strip()]
    return Observation({"exit_code": float(process.returncode)}, tuple(told[-5:]) if process.returncode else ())


def _end(process: subprocess.Popen[str]) -> None:
    """Ask a process to end, so that it ends what it has started and leaves no files; kill it where it doesn't."""
    process.terminate()
    try:
        process.communicate(timeout=GRACE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()


def _finish(begin: Callable[[], subprocess.Popen[str]]) -> float:
    """Let a process end; seconds from its beginning on.

    Raises:
        RuntimeError: it failed.
    """
    process, began = begin(), time.perf_counter()
    _, errors = process.communicate(timeout=PATIENCE)
    if process.returncode:
        raise RuntimeError(f"the process ended with {process.returncode}: {errors.strip().splitlines()[-1:]}")
    return time.perf_counter() - began


def _kill_after(process: subprocess.Popen[str], seconds: float) -> bool:
    """Kill a process after a while; whether it was still at work."""
    time.sleep(seconds)
    working = process.poll() is None
    process.kill()
    process.communicate()
    return working


def _whole(path: Path) -> bool:
    try:
        (read_settled if path.parent.name == "settled" else read_case)(path)
    except Exception:
        return False
    return True


KILLS = {
    "killed_data": Experiment(
        killed_data,
        {"differing": "cases", "partial": "files", "left_behind": "files", "kills": "kills"},
        alone=True,
    ),
    "killed_training": Experiment(
        killed_training,
        {"differing": "weights", "partial": "files", "left_behind": "files", "kills": "kills"},
        alone=True,
    ),
    # Its kills wait for runs that are finished, not for times, so others may run beside it.
    "killed_sweep": Experiment(killed_sweep, {"exit_code": "-"}, first=True),
}
