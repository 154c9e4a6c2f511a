"""What a user waits for once after an installation: the compilation of the DEM's kernels, and what it is later.

    python benchmarks/first_use.py [--rounds 3] [--output results/dem_speed]

Each round has a folder of its own for Numba's cache, empty at first, and two processes that start one after the other,
as a user's commands do. Timed is the first call of the engine in each: it compiles in the first and loads in the
second. For a measure of the machine, each process also adds up ten million numbers in Python.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np


def first_call() -> float:
    """Seconds of this process's first step of the engine, in `drum_small`."""
    from gran_bench.dem.simulate import simulate
    from gran_bench.shipped import shipped_scene

    scene = shipped_scene("drum_small")
    state = scene.fresh_filling(0)
    began = time.perf_counter()
    simulate(scene, state, state.time + scene.frame_interval)
    return time.perf_counter() - began


def yardstick() -> float:
    """Seconds that Python takes for ten million additions."""
    began, total = time.perf_counter(), 0
    for number in range(10_000_000):
        total += number
    return time.perf_counter() - began


def main(rounds: int, output: Path | None) -> None:
    """Starts the processes and prints what they took."""
    from dem_page import keep

    taken = []
    for number in range(rounds):
        with tempfile.TemporaryDirectory() as cache:
            environment = os.environ | {"NUMBA_CACHE_DIR": cache}
            words = [sys.executable, __file__, "--once"]
            pair = [subprocess.run(words, env=environment, check=True, capture_output=True, text=True) for _ in "12"]
        taken.append([list(map(float, process.stdout.split())) for process in pair])
        print(f"{number + 1:5d} {taken[-1][0][0]:13.2f} {taken[-1][1][0]:11.2f}  {pair[0].stderr.strip()}")
    (low, _), (middle, yard), (high, _) = np.quantile(np.array(taken), (0.0, 0.5, 1.0), axis=0)[:, 0]
    loading = np.median(np.array(taken)[:, 1, 0])
    lines = [
        f"compiling: {middle:.2f} s (median of {rounds}, {low:.2f} to {high:.2f}); loading later: {loading:.2f} s",
        f"ten million additions in Python: {yard:.2f} s",
    ]
    keep("first_use", "\n".join(lines), output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--output", type=Path, help="folder whose page gets the table")
    parser.add_argument("--once", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.once:
        print(first_call(), yardstick())
    else:
        main(given.rounds, given.output)
