"""The fast engine compiles in the process that uses it, once, and finds everything on disk from then on."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from gran_bench.dem.fast.bodies import zeros

USE = """
import json, subprocess
import numpy as np
from gran_bench.config import ContainerConfig, FillingConfig, SceneConfig
from gran_bench.dem.fast import engine, lists, wall_list
from gran_bench.dem.integrate import Physics
from gran_bench.dem.walls import wall_poses
from gran_bench.neighbors import cells
from gran_bench.scene import build_scene
from gran_bench.state import Held

def no_process(*arguments, **options):
    raise AssertionError(f"a process was started: {arguments}")

subprocess.Popen.__init__ = no_process
scene = build_scene(SceneConfig(container=ContainerConfig(diameter=0.3, length=0.2), filling=FillingConfig(count=20)))
physics, bed = Physics.of(scene, scene.filling.radius), scene.fresh_filling(0)
engine.Stretch(bed, physics, 1e-4, wall_poses(scene, 0.0, 1e-4, 3), HELD)
entries = (
    engine.march, wall_list.list_wall_contacts, lists.sort_pairs, lists.set_margins,
    cells.sort_into_cells, cells.find_pairs,
)
began = [len(entry.overloads) for entry in entries]
engine.advance(bed, physics, 1e-4, wall_poses(scene, 0.0, 1e-4, 3))
print(json.dumps([began, [[len(e.overloads), sum(e.stats.cache_hits.values())] for e in entries]]))
"""
HELD = "Held(bed.position, np.zeros((20, 3)), np.zeros((20, 3)), np.arange(20))"


def used(folder, held: str = "None") -> list:
    """What a process of its own has compiled when its engine begins, and in the end: versions, those found on disk."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder)}
    words = [sys.executable, "-c", USE.replace("HELD", held)]
    run = subprocess.run(words, env=environment, capture_output=True, text=True, check=True, timeout=600)
    return json.loads(run.stdout.splitlines()[-1])


@pytest.mark.slow
def test_a_use_compiles_all_before_its_first_step_and_later_ones_find_it(tmp_path):
    began, first = used(tmp_path)
    assert began == [1] * 6, "nothing is left to compile in a step that is timed"
    assert first == [[1, 0]] * 6, "one version of each"
    began, later = used(tmp_path, HELD)
    assert began == [1] * 6, "neither where a stretch goes on from held forces"
    assert later == [[1, 1]] * 6


@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_scratch_begins_with_a_cache_line(dtype):
    for count in (1, 7, 1000, 100_000):
        array = zeros(count, 4, dtype=dtype)
        assert array.shape == (count, 4)
        assert array.ctypes.data % 64 == 0
        assert not array.any()
