"""A process of one method: it prepares itself, and runs when it is asked to. Lines of JSON in, lines of JSON out.

Started by :mod:`gran_bench.benchmark.turns`, not by people. One method a process, so that the memory is its own.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from gran_bench.benchmark.jobs import Outcome, Run, prepare
from gran_bench.files import write_atomically

WARM_UP = 2  # frames: they compile, or load what was compiled before


def main() -> None:
    """Serve until the parent closes the pipe or is gone."""
    # Whatever a library prints must not get between the lines of JSON.
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    run, frames = None, 0
    try:
        for line in sys.stdin:
            request = json.loads(line)
            try:
                if run is None:
                    frames = request["frames"]
                    run = prepare(request["job"])
                    run(min(WARM_UP, frames), request["nudge_seed"])
                    answer: dict[str, Any] = {"ready": True}
                else:
                    answer = _timed(run, frames, request["nudge_seed"], request["keep"])
            except Exception as error:  # whatever a method dies of is its failure, not the benchmark's
                answer = {"died": f"{type(error).__name__}: {error}"}
            channel.write(json.dumps(answer) + "\n")
    except BrokenPipeError:
        os._exit(1)  # the parent is gone; closing the channel would fail once more


def _timed(run: Run, frames: int, nudge_seed: int, keep: str | None) -> dict[str, Any]:
    forget_peak_memory()
    before = resident_memory("VmRSS")
    wall, cpu = time.perf_counter(), time.process_time()
    outcome = run(frames, nudge_seed)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = resident_memory("VmHWM")
    if keep and outcome.trajectory is not None and not outcome.failure:
        keep_trajectory(Path(keep), outcome)
    memory = {"peak_bytes": peak, "own_bytes": max(0, peak - before)}
    if outcome.failure:
        return {"failure": outcome.failure, "wall_seconds": wall, "reached": outcome.reached}
    return {"wall_seconds": wall, "cpu_seconds": cpu, **memory}


def keep_trajectory(path: Path, outcome: Outcome) -> None:
    """Write the frames of a run in single precision, as data sets hold them, whole or not at all."""
    frames = outcome.trajectory
    arrays = {"position": frames.position, "velocity": frames.velocity}
    if frames.angular_velocity is not None:
        arrays["angular_velocity"] = frames.angular_velocity
    single = {name: np.asarray(array, np.float32) for name, array in arrays.items()}
    facts = {"time": frames.time, "radius": frames.radius, "velocity_kind": frames.velocity_kind}
    write_atomically(path, lambda file: np.savez(file, **facts, **single))


def forget_peak_memory() -> None:
    """Let the peak start anew, where the system can: what compiling took is not the method's."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def resident_memory(field: str) -> int:
    """``VmRSS``, the resident memory of this process, or ``VmHWM``, its peak; bytes.

    ``ru_maxrss`` would count the parent's memory at the moment of the start; it stands in where /proc is missing.
    """
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith(f"{field}:"):
                return 1024 * int(line.split()[1])
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


if __name__ == "__main__":
    main()
