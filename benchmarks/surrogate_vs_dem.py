"""Time of a frame, DEM beside the shipped surrogate: ``python benchmarks/surrogate_vs_dem.py [--repeats 7]``.

`drum` at 30 rpm from a settled bed, in turns in one run, one thread each, after a warm-up; medians of wall time.
"""

from __future__ import annotations

import argparse
import time
from statistics import median

import torch

from gran_bench.config import DemConfig
from gran_bench.dem.simulate import settle, simulate
from gran_bench.provenance import commit, hardware
from gran_bench.shipped import shipped_model, shipped_scene
from gran_bench.surrogate.checkpoint import load_model
from gran_bench.surrogate.rollout import rollout

FRAMES = 100


def main() -> None:
    """Run the contenders in turns and print milliseconds a frame of 10 ms."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    repeats = parser.parse_args().repeats
    torch.set_num_threads(1)
    scene = shipped_scene("drum").at_speed(30.0)
    # A moving bed: the first frames of a bed at rest are not typical of either.
    start = simulate(scene, settle(scene, seed=1), scene.start_time + 1.0).final
    end = start.time + FRAMES * scene.frame_interval
    model, _ = load_model(shipped_model())
    contenders = {
        "DEM, steps of 0.2 ms": lambda: simulate(scene, start, end, dem=DemConfig(time_step=2e-4)),
        "DEM, steps of 0.4 ms": lambda: simulate(scene, start, end, dem=DemConfig(time_step=4e-4)),
        "surrogate (shipped)": lambda: rollout(model, scene, start, FRAMES + 1),
    }
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for repeat in range(repeats + 1):
        for name, run in contenders.items():
            began = time.perf_counter()
            run()
            if repeat:  # the first round compiles and warms up
                seconds[name].append(time.perf_counter() - began)
    print(f"{hardware()}, commit {commit()}, {repeats} rounds of {FRAMES} frames")
    for name, found in seconds.items():
        low, middle, high = (1e3 * value / FRAMES for value in (min(found), median(found), max(found)))
        print(f"{name:<24}{middle:6.2f} ms a frame (from {low:.2f} to {high:.2f})")


if __name__ == "__main__":
    main()
