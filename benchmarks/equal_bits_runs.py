"""Runs through all parts of the engines, and a hash of every bit that each goes through (equal_bits.py).

Written for the interfaces that an older version has too: `advance` of both engines, `simulate`, `cell_pairs`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

STEP = 2.0e-4  # s
HISTORY = ("first", "second", "force", "overlap", "rolling_moment")


def digests() -> dict[str, str]:
    """Hash of everything that each run goes through, by name, in this process's version."""
    found = {}
    for name, states in _runs():
        digest, contacts = hashlib.sha256(), 0
        for arrays in states:
            contacts = len(arrays[-1])
            for array in arrays:
                digest.update(np.ascontiguousarray(array + 0).tobytes())  # −0 is 0
        found[f"{name} ({contacts})"] = digest.hexdigest()
    return found


def _runs() -> Iterator[tuple[str, Iterator[tuple]]]:
    """Name and frames of each run; what is counted in a frame comes last in it."""
    for name, scene in _scenes().items():
        yield name, _frames(scene)
        yield f"{name}, full radius", _frames(scene, full_radius=True)
        if name == "drum":
            yield "drum, float32", _frames(scene, single_precision=True)
            yield "drum, two threads", _frames(scene, threads=2)
            yield "drum, narrow skin", _frames(scene, skin=0.004)
            yield "drum, wide skin on two threads", _frames(scene, skin=0.05, threads=2)
        if name.startswith(("all", "lognormal")):
            yield f"{name}, by the reference", _by_the_reference(scene)
        if name.startswith("all"):
            yield f"{name}, skin of a step", _frames(scene, skin=1e-4)
            yield f"{name}, sixteen chunks on two threads", _frames(scene, chunks=(2, 4, 8, 16), threads=2)
            yield f"{name}, vibrating walls", _frames(_shaken(scene))
    for seed in range(100):
        yield f"a bounce out of reach, {seed}", _bounce(seed)
    yield "a bed that settles and turns", _simulated("drum_small")
    yield "a hopper that opens", _simulated("hopper")
    for period in (0.0, 0.5):
        yield f"neighbours, period {period:g} m", _neighbors(period)


def _scenes() -> dict[str, object]:
    """Scenes of a few hundred spheres, and `drum`, by name."""
    from gran_bench.config import ContainerConfig, FillingConfig, MaterialConfig, SceneConfig, SizesConfig
    from gran_bench.scene import build_scene
    from gran_bench.shipped import shipped_scene

    made: dict[str, object] = {name: shipped_scene(name) for name in ("drum", "hopper", "packing", "free_flight")}
    kinds = {
        "one size": {},
        "frictionless": {"friction": 0.0},
        "rolling": {"rolling_friction": 0.1},
        "sizes": {"sizes": "uniform"},
        "sizes and materials": {"sizes": "uniform", "materials": True},
        "lognormal sizes": {"sizes": "lognormal", "friction": 0.2, "restitution": 0.8},
        "all": {"sizes": "uniform", "materials": True, "rolling_friction": 0.1},
    }
    for kind, choice in kinds.items():
        sizes, materials = choice.pop("sizes", ""), choice.pop("materials", False)
        for periodic in (False, True):
            scene = SceneConfig(
                name="case",
                container=ContainerConfig(diameter=0.6 if sizes else 1.0, length=0.25, periodic_axis=periodic),
                filling=FillingConfig(
                    count=90 if sizes else 300,
                    sizes=SizesConfig(kind=sizes, spread=0.3 if sizes == "uniform" else 0.15)
                    if sizes
                    else SizesConfig(),
                    second_fraction=0.4 if materials else 0.0,
                ),
                material=MaterialConfig(**choice),
                second_material=MaterialConfig(3e6, 0.29, 4000.0, 0.5, 0.1, choice.get("rolling_friction", 0.0))
                if materials
                else None,
            )
            made[f"{kind}, {'periodic' if periodic else 'end caps'}"] = build_scene(scene).at_speed(30.0)
    made["drum"] = made["drum"].at_speed(30.0)
    return made


def _frames(scene: object, chunks: tuple = (), **changes: object) -> Iterator[tuple]:
    """Eight frames of a filling that flies about, from frame to frame with its contacts."""
    from gran_bench.dem import engine_numba
    from gran_bench.dem.integrate import Physics
    from gran_bench.dem.walls import wall_poses

    usual, physics = engine_numba.CHUNK_SIZES, replace(Physics.of(scene, scene.filling.radius), **changes)
    state = _flying(scene)
    for _ in range(8):
        engine_numba.CHUNK_SIZES = chunks or usual
        state = engine_numba.advance(state, physics, STEP, wall_poses(scene, state.time, STEP, 100))
        engine_numba.CHUNK_SIZES = usual
        yield _arrays(state)


def _by_the_reference(scene: object) -> Iterator[tuple]:
    """Two frames of such a filling by the engine that is there to be read."""
    from gran_bench.dem import engine_numpy
    from gran_bench.dem.integrate import Physics
    from gran_bench.dem.walls import wall_poses

    physics, state = Physics.of(scene, scene.filling.radius), _flying(scene)
    for _ in range(2):
        state = engine_numpy.advance(state, physics, STEP, wall_poses(scene, state.time, STEP, 100))
        yield _arrays(state)


def _flying(scene: object) -> object:
    """A filling with velocities and spins at random."""
    rng, state = np.random.default_rng(1), scene.fresh_filling(0)
    shape = (state.count, 3)
    return replace(state, velocity=rng.normal(0, 1, shape), angular_velocity=rng.normal(0, 20, shape))


def _shaken(scene: object) -> object:
    from gran_bench.scene import Vibration

    walls = tuple(
        replace(wall, motion=Vibration(0.004 + 0.001 * k, 20.0 + 3.0 * k, (0.6, 0.0, 0.8), start=0.0))
        for k, wall in enumerate(scene.walls)
    )
    return replace(scene, walls=walls)


def _bounce(seed: int) -> Iterator[tuple]:
    """A small sphere between an end cap and a large one, faster in a step than its lists reach; two others touch."""
    from gran_bench.config import ContainerConfig, FillingConfig, SceneConfig
    from gran_bench.dem import engine_numba
    from gran_bench.dem.integrate import Physics
    from gran_bench.dem.walls import wall_poses
    from gran_bench.scene import build_scene
    from gran_bench.state import ContactHistory, ParticleState

    scene = build_scene(SceneConfig(container=ContainerConfig(length=0.4), filling=FillingConfig(count=10)))
    scene, large, small, step = replace(scene, gravity=(0.0, 0.0, 0.0)), 0.05, 0.01, 3.362e-4
    rng = np.random.default_rng(seed)
    speed = rng.uniform(0.5, 0.2 * small / step)
    margin = speed * step / rng.uniform(0.25, 0.9)
    y = -0.2 + small + rng.uniform(0.1, 1.0) * margin
    approach = speed / 60
    order = rng.permutation(4)
    state = ParticleState(
        np.array(
            [
                *([0.0, y + large + small - rng.uniform(0.0, 0.3) * speed * step, 0.0], [0.0, y, 0.0]),
                *([0.25, 0.0, 0.0], [0.25, 0.0, 2 * large + rng.uniform(0.0, 16.0) * approach * step]),
            ]
        )[order],
        np.array([[0.0, 0.0, 0.0], [0.0, -speed, 0.0], [0.0, 0.0, approach], [0.0, 0.0, -approach]])[order],
        np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 0.0], [50.0, 10.0, 0.0], [50.0, 0.0, 5.0]])[order],
        np.array([large, small, large, large])[order],
        0.0,
        ContactHistory.empty(),
    )
    physics = Physics.of(scene, large, 2.0 * margin)
    for steps in (10, 30):
        yield _arrays(engine_numba.advance(state, physics, step, wall_poses(scene, 0.0, step, steps)))


def _simulated(name: str) -> Iterator[tuple]:
    """A scene from its filling on: settled and moving for 0.2 s, or past the opening of its orifice."""
    from gran_bench.dem.simulate import settle, simulate
    from gran_bench.shipped import shipped_scene

    if name == "hopper":
        scene = shipped_scene(name, {"filling.count": 600})
        start = replace(scene.fresh_filling(0), time=scene.start_time - 0.3)
        trajectory = simulate(scene, start, scene.start_time + 0.5)
    else:
        scene = shipped_scene(name)
        trajectory = simulate(scene, settle(scene, 0), scene.start_time + 0.2)
    yield _arrays(trajectory.final)


def _neighbors(period: float) -> Iterator[tuple]:
    from gran_bench.neighbors import cell_neighbors, cell_pairs, tree_neighbors, tree_pairs

    rng = np.random.default_rng(2)
    place, other = rng.uniform(-0.25, 0.25, (500, 3)), rng.uniform(-0.25, 0.25, (300, 3))
    query, source = cell_neighbors(place, other, 0.09, period)
    yield tree_pairs(place, 0.07, period), *tree_neighbors(place, other, 0.09, period)
    yield cell_pairs(place, 0.07, period), query, source


def _arrays(state: object) -> tuple:
    """What a state is, its contacts in the order of their names."""
    history = state.history
    order = np.lexsort((history.second, history.first))
    return (
        *(state.position, state.velocity, state.angular_velocity),
        *(getattr(history, part)[order] for part in HISTORY),
    )
