"""A process of one method: it prepares itself, and runs when it is asked to. Lines of JSON in, lines of JSON out.

Started by :mod:`gran_bench.comparison.turns`, not by people. One method a process, so that the memory is its own.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from gran_bench.atomic import write_atomically
from gran_bench.comparison.jobs import Outcome, prepare

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
                    run(min(WARM_UP, frames))
                    answer: dict[str, Any] = {"ready": True}
                else:
                    answer = _timed(run, frames, request["keep"])
            except Exception as error:  # whatever a method dies of is its failure, not the benchmark's
                answer = {"died": f"{type(error).__name__}: {error}"}
            channel.write(json.dumps(answer) + "\n")
    except BrokenPipeError:
        os._exit(1)  # the parent is gone; closing the channel would fail once more


def _timed(run: Any, frames: int, keep: str | None) -> dict[str, Any]:
    wall, cpu = time.perf_counter(), time.process_time()
    outcome: Outcome = run(frames)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = peak_memory()
    if keep and outcome.trajectory is not None and not outcome.failure:
        keep_trajectory(Path(keep), outcome)
    return {"wall_seconds": wall, "cpu_seconds": cpu, "peak_bytes": peak, "failure": outcome.failure}


def keep_trajectory(path: Path, outcome: Outcome) -> None:
    """Write the frames of a run in single precision, as data sets hold them, whole or not at all."""
    frames = outcome.trajectory
    arrays = {"position": frames.position, "velocity": frames.velocity}
    if frames.angular_velocity is not None:
        arrays["angular_velocity"] = frames.angular_velocity
    single = {name: np.asarray(array, np.float32) for name, array in arrays.items()}
    facts = {"time": frames.time, "radius": frames.radius, "velocity_kind": frames.velocity_kind}
    write_atomically(path, lambda file: np.savez(file, **facts, **single))


def peak_memory() -> int:
    """Largest resident memory of this process so far, bytes.

    ``ru_maxrss`` alone would count the parent's memory at the moment of the start.
    """
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


if __name__ == "__main__":
    main()
