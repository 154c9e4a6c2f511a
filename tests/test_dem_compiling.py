"""The first compilation of the fast engine is shared by two processes, and whatever fails there costs time alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from types import SimpleNamespace

import numba
import numpy as np
import pytest

from gran_bench.dem.fast import compiling
from gran_bench.dem.fast import engine as engine_numba
from gran_bench.dem.fast.stretch import march

FIRST_USE = """
import json
from dataclasses import replace
import numpy as np
from gran_bench.config import ContainerConfig, DemConfig, FillingConfig, SceneConfig
from gran_bench.dem.fast import engine as engine_numba
from gran_bench.dem.fast.compiling import LISTS, PIECES
from gran_bench.dem.fast.wall_list import list_near
from gran_bench.neighbors.cells import sort_into_cells
from gran_bench.dem.integrate import Physics
from gran_bench.dem.walls import wall_poses
from gran_bench.scene import build_scene

scene = build_scene(SceneConfig(container=ContainerConfig(diameter=0.3, length=0.2), filling=FillingConfig(count=20)))
physics = replace(Physics.of(scene, scene.filling.radius), single_precision=SINGLE)
for steps in (0, 3):
    engine_numba.advance(scene.fresh_filling(0), physics, 1e-4, wall_poses(scene, 0.0, 1e-4, steps))
entries = engine_numba.march, sort_into_cells, list_near, *PIECES, *LISTS
print(json.dumps([[len(entry.overloads), sum(entry.stats.cache_hits.values())] for entry in entries]))
"""


def python(*arguments: str, **settings: str) -> list[str]:
    """A process of its own, with settings in its environment."""
    run = subprocess.run(
        [sys.executable, *arguments], env=os.environ | settings, capture_output=True, text=True, check=True, timeout=300
    )
    return run.stdout.splitlines()


@pytest.mark.parametrize("single", [False, True])
def test_the_process_beside_compiles_just_what_the_engine_asks_for(tmp_path, single):
    cache = {"NUMBA_CACHE_DIR": str(tmp_path), "NUMBA_NUM_THREADS": "2"}
    loop, cells, walls, *found = json.loads(python("-c", FIRST_USE.replace("SINGLE", str(single)), **cache)[-1])
    assert loop == [1, 0], "one version, compiled by the caller"
    assert [cells[0], walls[0]] == [1, 1], "one version, for the loop's needs and the search's"
    lists = found[len(compiling.PIECES) :]
    assert lists == [[1, 1]] * len(compiling.LISTS), "one version of each, found on disk"
    # Pieces of the loop are looked for on disk as it is compiled; whoever of the two is first compiles them.
    assert [versions for versions, _ in found[: len(compiling.PIECES)]] == [1] * len(compiling.PIECES)


@pytest.fixture
def nothing_on_disk(monkeypatch):
    monkeypatch.setattr(compiling, "on_disk", lambda entry: False)
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 2)


def beside(monkeypatch, code: str) -> list[subprocess.Popen]:
    """Lets a process that runs ``code`` stand in for the one that compiles; returns where it will be found."""
    started = []

    def start(precision):
        started.append(subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE))
        return started[-1]

    monkeypatch.setattr(compiling, "_started", start)
    return started


def test_a_process_that_hangs_is_ended(monkeypatch, nothing_on_disk):
    started = beside(monkeypatch, "import time; time.sleep(600)")
    with compiling.compiled_beside(np.float64):
        pass
    assert started[0].returncode not in (None, 0)


def test_a_process_that_fails_is_nobodys_trouble(monkeypatch, nothing_on_disk):
    started = beside(monkeypatch, "raise SystemExit(3)")
    with compiling.compiled_beside(np.float64):
        started[0].wait()
    assert started[0].returncode == 3


def test_none_is_left_when_the_caller_is_interrupted(monkeypatch, nothing_on_disk):
    started = beside(monkeypatch, "import time; time.sleep(600)")
    with pytest.raises(KeyboardInterrupt), compiling.compiled_beside(np.float64):
        raise KeyboardInterrupt
    assert started[0].returncode not in (None, 0)


def test_no_process_starts_on_one_core(monkeypatch, nothing_on_disk):
    started = beside(monkeypatch, "")
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 1)
    with compiling.compiled_beside(np.float64):
        assert started == []


def test_no_process_starts_where_anything_is_compiled(monkeypatch, nothing_on_disk):
    started = beside(monkeypatch, "")
    monkeypatch.setattr(compiling, "on_disk", lambda entry: entry is march)
    with compiling.compiled_beside(np.float64):
        assert started == []


def test_without_an_interpreter_to_start_the_caller_compiles_all(monkeypatch, nothing_on_disk):
    monkeypatch.setattr(sys, "executable", "/no/such/python")
    with compiling.compiled_beside(np.float64):
        pass


def test_what_is_compiled_is_found_on_disk(tmp_path):
    entry = SimpleNamespace(stats=SimpleNamespace(cache_path=str(tmp_path)), py_func=march.py_func)
    assert not compiling.on_disk(entry)
    (tmp_path / f"stretch.{march.py_func.__qualname__}-30.py311.nbi").touch()
    assert compiling.on_disk(entry)
    entry.stats.cache_path = None
    assert not compiling.on_disk(entry)


def test_the_process_beside_ends_with_its_caller(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "gran_bench.dem.fast.compile_beside"],
        stdin=subprocess.PIPE,
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
    )
    process.stdin.close()
    assert process.wait(60) == 1


@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_scratch_begins_with_a_cache_line(dtype):
    for count in (1, 7, 1000, 100_000):
        array = engine_numba._zeros(count, 4, dtype=dtype)
        assert array.shape == (count, 4)
        assert array.ctypes.data % 64 == 0
        assert not array.any()
