"""What each skip of the DEM saves: the step of `drum` at 30 rpm with and without it, interleaved, one thread.

    python benchmarks/dem_skips.py

Each row runs the same bed twice: once as the scene needs it, once with the skipped work done all the same (that the
result is the same is a test, tests/test_dem_skips.py). Times are processor time; the rows alternate.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

from gran_bench.config import SceneConfig
from gran_bench.dem import engine_numba
from gran_bench.dem.integrate import Physics
from gran_bench.dem.simulate import settle, simulate
from gran_bench.dem.walls import wall_poses
from gran_bench.scene import Plane, Scene, build_scene
from gran_bench.state import ContactHistory, ParticleState

STEPS, STEP = 50, 2e-4  # a frame of 10 ms


Case = tuple[Physics, np.ndarray]  # what an engine takes beside the state


def seconds_a_step(state: ParticleState, case: Case, frames: int) -> float:
    """Processor time of a step, over a few frames from the same bed."""
    (physics, walls), started = case, time.process_time()
    for _ in range(frames):
        state = engine_numba.advance(state, physics, STEP, walls)
    return (time.process_time() - started) / (frames * STEPS)


def case_of(scene: Scene, **changes: object) -> Case:
    """A scene as an engine takes it, or what ``changes`` make of its physics."""
    walls = wall_poses(scene, scene.start_time, STEP, STEPS)
    return replace(Physics.of(scene, scene.filling.radius), **changes), walls


def rows(scene: Scene) -> dict[str, tuple[Case, Case]]:
    """Name of each skip → a case with it, and one without it."""
    smooth_material = replace(scene.material, friction=0.0)
    smooth = replace(scene, material=smooth_material, wall_material=smooth_material)
    # Out of every particle's reach, so that they cost their search and change nothing.
    caps = (Plane((0.0, -5.0, 0.0), (0.0, 1.0, 0.0)), Plane((0.0, 5.0, 0.0), (0.0, -1.0, 0.0)))
    open_ended = replace(scene, walls=scene.walls[:1], periodic_axis=True)
    capped = replace(open_ended, walls=open_ended.walls + caps)
    bare, far = replace(scene, walls=()), replace(scene, walls=caps)
    creeping = replace(scene, rotation=replace(scene.rotation, speeds_rpm=(1e-290,)))
    usual, table = case_of(scene)
    return {
        "no tangential law where μ = 0": (case_of(smooth), case_of(smooth, tangential=True)),
        "no rolling model where μ_r = 0": ((usual, table), case_of(scene, rolling=True)),
        "no wall velocity where walls rest": (case_of(scene.at_rest()), case_of(creeping)),
        "no end caps where the axis is periodic": (case_of(open_ended), case_of(capped)),
        "no walls where there are none": (case_of(bare), case_of(far)),
        "no pair looked at beyond a fitting skin": ((usual, table), case_of(scene, skin=0.1)),
        "no search before the skin is crossed": ((usual, table), case_of(scene, skin=1e-3)),
    }


def main(rounds: int) -> None:
    """Prints the table."""
    scene = build_scene(SceneConfig(name="drum")).at_speed(30.0)
    bed = simulate(scene, settle(scene, 0), 3.5).final
    without_memory = replace(bed, history=ContactHistory.empty())
    cases = rows(scene)
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in cases}
    for turn in range(rounds + 1):
        for name, both in cases.items():
            pair = tuple(seconds_a_step(without_memory, case, 4) for case in both)
            if turn:  # the first turn warms up
                times[name].append(pair)
    print(f"{'skip':42s} µs a step with   without   saved")
    for name, pairs in times.items():
        with_skip, without_skip = 1e6 * np.median(pairs, axis=0)
        print(f"{name:42s} {with_skip:14.0f} {without_skip:9.0f} {1 - with_skip / without_skip:7.0%}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    main(parser.parse_args().rounds)
