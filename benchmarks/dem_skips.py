"""What each skip of the DEM saves: µs a step with and without it, interleaved, one thread, in four scenes.

    python benchmarks/dem_skips.py [--output results/dem_speed]

Each row runs the same bed twice: once as the scene needs it, once with the skipped work done all the same (that the
result is the same is a test, tests/test_dem_skips.py). Times are processor time; the rows alternate. A skip of a few
per cent or less is within the noise of a shared machine.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from dem_page import keep

from gran_bench.dem.fast import engine as engine_numba
from gran_bench.dem.integrate import Physics
from gran_bench.dem.outlet import part_of, taking_part
from gran_bench.dem.simulate import choose_time_step, settle, simulate
from gran_bench.dem.walls import SURFACE, wall_poses
from gran_bench.scene import Plane, Scene
from gran_bench.shipped import shipped_scene
from gran_bench.state import ContactHistory, ParticleState

STEPS = 50  # of a stretch
# How long each scene runs before it is measured, s.
RUNS_FOR = {"drum": 2.0, "packing": 1.0, "hopper": 0.2, "free_flight": 0.1}


class Case:
    """A scene as an engine takes it, and a state to start from."""

    def __init__(self, scene: Scene, state: ParticleState, **changes: object) -> None:
        largest = float(state.radius.max())
        self.step = choose_time_step(scene, radius=float(state.radius.min()))[0]
        self.walls = wall_poses(scene, state.time, self.step, STEPS)
        self.physics, self.state = replace(Physics.of(scene, largest), **changes), state

    def seconds_a_step(self, frames: int) -> float:
        """Processor time of a step, over a few stretches."""
        state, started = self.state, time.process_time()
        for _ in range(frames):
            state = engine_numba.advance(state, self.physics, self.step, self.walls)
        return (time.process_time() - started) / (frames * STEPS)


def rows(scene: Scene, bed: ParticleState) -> dict[str, tuple[Case, Case]]:
    """Name of each skip → a case with it, and one without it."""
    usual, diameter = Case(scene, bed), 2.0 * float(bed.radius.max())
    smooth_material = replace(scene.material, friction=0.0)
    smooth = replace(scene, material=smooth_material, wall_material=smooth_material)
    fresh = replace(bed, history=ContactHistory.empty())
    odd = bed.radius.copy()
    odd[0] *= 1.0 - 1e-9  # one sphere of another size, to the ninth digit
    twice = {
        "pair_laws": np.tile(usual.physics.pair_laws, (2, 2, 1)),
        "wall_laws": np.tile(usual.physics.wall_laws, (2, 1, 1)),
        "density": np.tile(usual.physics.density, 2),
    }
    found = {
        "no tangential law where μ = 0": (Case(smooth, fresh), Case(smooth, fresh, tangential=True)),
        "no rolling model where μ_r = 0": (usual, Case(scene, bed, rolling=True)),
        "no sizes of each contact where all are equal": (usual, Case(scene, replace(bed, radius=odd))),
        "no law of each contact where materials are one": (usual, Case(scene, bed, **twice)),
        "no pair looked at beyond a fitting skin": (usual, Case(scene, bed, skin=2.0 * diameter)),
        "no search before the skin is crossed": (usual, Case(scene, bed, skin=0.02 * diameter)),
    }
    # Out of every particle's reach, so that they cost their search and change nothing.
    far = tuple(Plane((0.0, -50.0 * side, 0.0), (0.0, side, 0.0), turns=False) for side in (1.0, -1.0))
    bare = replace(scene, walls=())
    found["no walls where there are none"] = Case(bare, fresh), Case(replace(bare, walls=far), fresh)
    if scene.needs.wall_motion:
        creeping = replace(scene, rotation=replace(scene.rotation, speeds_rpm=(1e-290,)))
        found["no wall velocity where walls rest"] = Case(scene.at_rest(), bed), Case(creeping, bed)
    if not scene.needs.wall_seams and scene.walls:
        asking = Case(scene, bed)
        asking.walls = np.array(asking.walls)
        asking.walls[..., SURFACE] = 1.0  # each wall asks whether another answers in its place
        found["no seams where walls share no edge"] = usual, asking
    if scene.needs.end_caps and scene.drum_radius is not None:
        ends = replace(scene, walls=scene.walls[:1], periodic_axis=True)
        capped = replace(ends, walls=ends.walls + far)
        found["no end caps where the axis is periodic"] = Case(ends, fresh), Case(capped, fresh)
    return found


def main(rounds: int, output: Path | None) -> None:
    """Prints the table."""
    saved: dict[str, dict[str, str]] = {}
    for name, duration in RUNS_FOR.items():
        scene = shipped_scene(name)
        bed = simulate(scene, settle(scene, 0), scene.start_time + duration).final
        bed = part_of(bed, taking_part(scene, bed.position))  # without the spheres that have left
        cases, times = rows(scene, bed), {}
        for turn in range(rounds + 1):
            for row, both in cases.items():
                pair = tuple(case.seconds_a_step(4) for case in both)
                if turn:  # the first turn warms up
                    times.setdefault(row, []).append(pair)
        for row, pairs in times.items():
            with_skip, without_skip = 1e6 * np.median(pairs, axis=0)
            saved.setdefault(row, {})[name] = f"{with_skip:.0f} ({1 - with_skip / without_skip:.0%})"
    lines = [f"{'µs a step (saved)':48s}" + "".join(f"{name:>14s}" for name in RUNS_FOR)]
    lines += [f"{row:48s}" + "".join(f"{of.get(name, '–'):>14s}" for name in RUNS_FOR) for row, of in saved.items()]
    keep("skips", "\n".join(lines), output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--output", type=Path, help="folder whose page gets the table")
    given = parser.parse_args()
    main(given.rounds, given.output)
