"""What a frame of the DEM costs at large and small steps, in ``drum``: both engines, one thread, interleaved.

    python benchmarks/dem_frames.py [--beside ../older/.venv/bin/python] [--output results/dem_speed]

A frame is 10 ms of the scene. Times are processor time of whole runs from one moving bed, searches, sorting and
diagnostics included; each engine has a process of its own, and the processes take turns. ``--beside`` is the Python of
another installation, of an older commit for example, which runs the same rows in the same turns.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from gran_bench.config import DemConfig
from gran_bench.dem.simulate import settle, simulate
from gran_bench.shipped import shipped_scene
from gran_bench.state import ContactHistory, ParticleState

SCENE, MOVES_FOR = "drum", 2.0  # s, until all flows as it will
# Engine, step in s, frames of the run, interval of its frames in frames.
ROWS = {
    "numba, 1 ms": ("numba", 1e-3, 100, 1),
    "numba, 0.2 ms": ("numba", 2e-4, 50, 1),
    "numba, 0.2 ms, every tenth frame kept": ("numba", 2e-4, 50, 10),
    "numba, 0.1 ms": ("numba", 1e-4, 30, 1),
    "numpy, 0.2 ms": ("numpy", 2e-4, 2, 1),
}
MOVING = ("position", "velocity", "angular_velocity", "radius")
HISTORY = ("first", "second", "force", "overlap", "rolling_moment")
REFERENCE, COMPARED = "numpy, 0.2 ms", "numba, 0.2 ms"


def keep_bed(path: Path) -> None:
    """Writes a moving bed that every installation starts from."""
    scene = shipped_scene(SCENE)
    state = simulate(scene, settle(scene, 0), scene.start_time + MOVES_FOR).final
    arrays = {name: getattr(state, name) for name in MOVING} | {name: getattr(state.history, name) for name in HISTORY}
    np.savez(path, time=state.time, **arrays)


def work(path: Path) -> None:
    """Answers each row that it reads with the processor time of its run, s."""
    with np.load(path) as kept:
        history = ContactHistory(*(kept[name] for name in HISTORY))
        bed = ParticleState(*(kept[name] for name in MOVING), float(kept["time"]), history)
    scene = replace(shipped_scene(SCENE), end_time=1e3)
    for line in sys.stdin:
        engine, step, frames, stride = json.loads(line)
        dem = DemConfig(engine=engine, time_step=step, allow_unsafe_step=True, threads=1)
        seen = replace(scene, frame_interval=stride * scene.frame_interval)
        began = time.process_time()
        simulate(seen, bed, bed.time + frames * scene.frame_interval, dem=dem)
        print(time.process_time() - began, flush=True)


def main(rounds: int, beside: Path | None, output: Path | None) -> None:
    """Prints the table."""
    from dem_page import keep

    pythons = {"here": sys.executable} | ({"beside": str(beside)} if beside else {})
    with tempfile.TemporaryDirectory() as folder:
        bed = Path(folder) / "bed.npz"
        keep_bed(bed)
        environment = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
        workers = {
            (name, place): subprocess.Popen(
                [python, __file__, "--work", str(bed)], env=environment, text=True,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            )
            for place, python in pythons.items() for name in ROWS
        }  # fmt: skip
        times = {key: [] for key in workers}
        for turn in range(rounds + 1):
            for key in list(workers)[:: 1 if turn % 2 else -1]:
                worker = workers[key]
                print(json.dumps(ROWS[key[0]]), file=worker.stdin, flush=True)
                took = float(worker.stdout.readline())
                if turn:  # the first turn compiles
                    times[key].append(took / ROWS[key[0]][2])
        for worker in workers.values():
            worker.stdin.close()
            worker.wait()
    scene = shipped_scene(SCENE)
    median = {key: float(np.median(of)) for key, of in times.items()}
    lines = [
        f"{SCENE}, {scene.filling.count} spheres      ms a frame  (lowest–highest)  µs a step"
        + "   beside" * bool(beside)
    ]
    for name, (_, step, _, _) in ROWS.items():
        of, steps = 1e3 * np.array(times[name, "here"]), round(scene.frame_interval / step)
        line = f"{name:40s}{np.median(of):9.2f}  ({of.min():.2f}–{of.max():.2f}) {1e3 * np.median(of) / steps:10.0f}"
        if beside:
            line += f"  {1e3 * median[name, 'beside']:8.2f} = {median[name, 'beside'] / median[name, 'here']:.2f} ×"
        lines.append(line)
    ratio = median[REFERENCE, "here"] / median[COMPARED, "here"]
    lines.append(f"{REFERENCE}: {ratio:.1f} times {COMPARED}")
    lines.append(f"{rounds} turns; medians, one thread, processor time")
    keep("frames", "\n".join(lines), output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--beside", type=Path, help="Python of another installation")
    parser.add_argument("--output", type=Path, help="folder whose page gets the table")
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.work:
        work(given.work)
    else:
        main(given.rounds, given.beside, given.output)
