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
from gran_bench.dem.walls import wall_table
from gran_bench.scene import Plane, Scene, Wall, build_scene
from gran_bench.state import ContactHistory, ParticleState

STEPS, STEP = 50, 2e-4  # a frame of 10 ms


def seconds_a_step(state: ParticleState, physics: Physics, speed: float, frames: int) -> float:
    """Processor time of a step, over a few frames from the same bed."""
    speeds, started = np.full(STEPS + 1, speed), time.process_time()
    for _ in range(frames):
        state = engine_numba.advance(state, physics, STEP, speeds)
    return (time.process_time() - started) / (frames * STEPS)


def walled(physics: Physics, walls: tuple[Wall, ...]) -> Physics:
    """The same physics with these walls beside those that it has."""
    shapes = physics.shapes + walls
    return replace(physics, shapes=shapes, walls=wall_table(shapes))


def rows(scene: Scene) -> dict[str, tuple[Physics, Physics, float]]:
    """Name of each skip → physics with it, physics without it, speed of the walls in rad/s."""
    radius, turning = scene.filling.radius, scene.rotation.largest_angular_speed
    usual = Physics.of(scene, radius)
    smooth_material = replace(scene.material, friction=0.0)
    smooth = Physics.of(replace(scene, material=smooth_material, wall_material=smooth_material), radius)
    open_ended = Physics.of(replace(scene, walls=scene.walls[:1], periodic_axis=True), radius)
    bare = replace(usual, shapes=(), walls=np.zeros((0, 9)))
    # Out of every particle's reach, so that they cost their search and change nothing.
    far_caps = (Plane((0.0, -5.0, 0.0), (0.0, 1.0, 0.0)), Plane((0.0, 5.0, 0.0), (0.0, -1.0, 0.0)))
    resting = walled(replace(usual, shapes=()), tuple(replace(wall, turns=False) for wall in scene.walls))
    return {
        "no tangential law where μ = 0": (smooth, replace(smooth, tangential=True), turning),
        "no rolling model where μ_r = 0": (usual, replace(usual, rolling=True), turning),
        "no wall velocity where walls rest": (resting, usual, 1e-300),
        "no end caps where the axis is periodic": (open_ended, walled(open_ended, far_caps), turning),
        "no walls where there are none": (bare, walled(bare, far_caps), turning),
        "no pair looked at beyond a fitting skin": (usual, replace(usual, skin=0.1), turning),
        "no search before the skin is crossed": (usual, replace(usual, skin=1e-3), turning),
    }


def main(rounds: int) -> None:
    """Prints the table."""
    scene = build_scene(SceneConfig(name="drum")).at_speed(30.0)
    bed = simulate(scene, settle(scene, 0), 3.5).final
    without_memory = replace(bed, history=ContactHistory.empty())
    cases = rows(scene)
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in cases}
    for turn in range(rounds + 1):
        for name, (with_skip, without_skip, speed) in cases.items():
            pair = tuple(seconds_a_step(without_memory, physics, speed, 4) for physics in (with_skip, without_skip))
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
