"""A picture of each shipped scene, cut open, some time after its start.

python benchmarks/draw_scenes.py FOLDER [SCENE …]
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import gran_bench.conf
from gran_bench.dem.simulate import settle, simulate
from gran_bench.plots.scene_state import scene_state
from gran_bench.shipped import shipped_scene

# Seconds after the start at which a scene shows most; the others after one.
SHOWN = {"collision": 0.09, "packing": 0.3, "packing_binary": 0.3, "free_flight": 0.5, "drum_ramp": 2.4, "hopper": 0.6}


def main(folder: Path, names: list[str]) -> None:
    """Settles, runs and draws."""
    folder.mkdir(parents=True, exist_ok=True)
    shipped = sorted(path.stem for path in (Path(gran_bench.conf.__path__[0]) / "scene").glob("*.yaml"))
    for name in names or shipped:
        scene = shipped_scene(name)
        start = settle(scene, 0)
        frames = round(SHOWN.get(name, 1.0) / scene.frame_interval)
        result = simulate(scene, start, start.time + frames * scene.frame_interval)
        scene_state(folder / f"{name}.png", scene, replace(result.final, time=float(np.round(result.final.time, 9))))
        print(f"{name}: {scene.needs}; steps of {1e6 * result.time_step:.0f} µs, {result.wall_seconds:.1f} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("scenes", nargs="*")
    given = parser.parse_args()
    main(given.folder, given.scenes)
