"""What a step costs from 300 to 100 000 spheres, on one thread and on two; with float32 contact forces beside it.

    python benchmarks/dem_scaling.py [--grow length | size] [--output results/dem_speed]

Each bed is `drum` made longer or shorter, so that all carry the same flow. With ``--grow size`` diameter and length
grow with the cube root of the number at one Froude number; then spheres also move faster, and are searched for more
often. Threads and precision take turns on the same bed; medians of the time on the clock.
The exponent is of the whole step's time against the number of spheres, by least squares of the logarithms. Some three
minutes on two cores that are otherwise idle.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from dem_page import keep

from gran_bench.config import ContainerConfig, FillingConfig, SceneConfig
from gran_bench.dem.fast import engine as engine_numba
from gran_bench.dem.fast.tuning import Tuner
from gran_bench.dem.integrate import Physics
from gran_bench.dem.simulate import simulate
from gran_bench.dem.walls import wall_poses
from gran_bench.plots.style import drawing
from gran_bench.scene import Scene, build_scene
from gran_bench.state import ParticleState

COUNTS = (300, 1000, 3000, 10_000, 24_000, 50_000, 100_000)
STEP, FRAME = 1e-4, 100  # s, steps
KINDS = {"1 thread": (1, False), "2 threads": (2, False), "1 thread, float32": (1, True)}


def turning_bed(count: int, grow: str) -> tuple[Scene, ParticleState]:
    """So many spheres that have fallen and turn: loose beds cost less, so all have moved for the same while."""
    scale = (count / 3000) ** (1 / 3) if grow == "size" else 1.0
    length = scale if grow == "size" else count / 3000 + 0.05  # m: the caps keep a sphere away
    scene = build_scene(
        SceneConfig(
            name=f"drum_{count}",
            container=ContainerConfig(diameter=scale, length=length),
            filling=FillingConfig(count=count),
            start_time=round(0.3 + 0.25 * float(np.sqrt(scale)), 2),  # when it turns: not at rest, only fallen
            end_time=30.0,
        )
    ).at_speed(30.0 / float(np.sqrt(scale)))
    return scene, simulate(scene, scene.fresh_filling(0), scene.start_time + 0.3).final


def times_of(scene: Scene, bed: ParticleState, frames: int) -> dict[str, tuple[float, float]]:
    """Median time of a step for each kind, and the skin that it found, m."""
    walls = wall_poses(scene, bed.time, STEP, FRAME)
    usual, tuners = Physics.of(scene, scene.filling.radius), {}
    for kind, (threads, single) in KINDS.items():
        tuners[kind] = Tuner(replace(usual, single_precision=single), bed.count, False, threads)

    def frame(physics: Physics) -> float:
        started = time.perf_counter()
        engine_numba.advance(bed, physics, STEP, walls)
        return time.perf_counter() - started

    for physics in (usual, replace(usual, single_precision=True)):
        frame(physics)  # compiles
    for _ in range(15):
        for tuner in tuners.values():
            tuner.took(frame(tuner.physics))
    times: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for _ in range(frames):
        for kind, tuner in tuners.items():
            times[kind].append(frame(tuner.chosen) / FRAME)
    return {kind: (float(np.median(times[kind])), tuners[kind].chosen.skin) for kind in KINDS}


def main(counts: list[int], grow: str, output: Path | None) -> None:
    """Prints the table and draws the figure."""
    found = {}
    for count in counts:
        scene, bed = turning_bed(count, grow)
        found[count] = times_of(scene, bed, 7)
        print(f"{count} spheres: " + ", ".join(f"{k} {1e6 * t:.0f} µs" for k, (t, _) in found[count].items()))
    lines = [f"{'spheres':>8s} {'skin, mm':>9s} " + "".join(f"{kind + ', µs a step':>30s}" for kind in KINDS)
             + f"{'ns a sphere':>13s}{'2 threads':>11s}"]  # fmt: skip
    for count, times in found.items():
        one, two = times["1 thread"][0], times["2 threads"][0]
        row = f"{count:8d} {1e3 * times['1 thread'][1]:9.3g} " + "".join(f"{1e6 * t:30.0f}" for t, _ in times.values())
        lines.append(row + f"{1e9 * one / count:13.1f}{one / two:10.2f}×")
    size = np.log(list(found))
    for kind in KINDS:
        exponent = np.polyfit(size, np.log([times[kind][0] for times in found.values()]), 1)[0]
        lines.append(f"exponent of the step's time, {kind}: {exponent:.3f}")
    name = "scaling" if grow == "length" else f"scaling_{grow}"
    keep(name, "\n".join(lines), output)
    if output is not None:
        draw(output / f"{name}.png", found, grow)


def draw(path: Path, found: dict[int, dict[str, tuple[float, float]]], grow: str) -> None:
    """Time a sphere and step against the number of spheres."""
    with drawing(path, 6.5, 4.0) as figure:
        axes = figure.add_subplot()
        counts = np.array(list(found))
        for kind, style in zip(KINDS, ("o-", "s-", "^--"), strict=True):
            axes.plot(counts, [1e9 * found[n][kind][0] / n for n in counts], style, label=kind)
        axes.set_xscale("log")
        axes.set_ylim(bottom=0)
        axes.set_xlabel("spheres")
        axes.set_ylabel("time of a step and sphere, ns")
        axes.set_title(f"drum at 30 rpm, growing in {grow}; neighbour searches included")
        axes.legend()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--counts", type=int, nargs="+", default=list(COUNTS))
    parser.add_argument("--grow", choices=("length", "size"), default="length", help="what grows with the number")
    parser.add_argument("--output", type=Path, help="folder whose page gets the table")
    given = parser.parse_args()
    main(given.counts, given.grow, given.output)
