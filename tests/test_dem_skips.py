"""What a scene does not need is skipped; the result is the same as without the skip."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gran_bench.config import ContainerConfig, FillingConfig, MaterialConfig, RotationConfig, SceneConfig
from gran_bench.dem import engine_numba, engine_numpy
from gran_bench.dem.integrate import Physics
from gran_bench.dem.simulate import simulate
from gran_bench.dem.walls import wall_table
from gran_bench.scene import Plane, Scene, build_scene
from gran_bench.state import ParticleState

STEP, STEPS = 2e-4, 150
ENGINES = pytest.mark.parametrize("advance", [engine_numba.advance, engine_numpy.advance], ids=["numba", "numpy"])


def scene_of(**material: float) -> Scene:
    """200 spheres in a short drum at 30 rpm."""
    return build_scene(
        SceneConfig(
            name="small",
            container=ContainerConfig(length=0.2),
            filling=FillingConfig(count=200),
            material=MaterialConfig(**material),
            rotation=RotationConfig(times=[0.0], speeds_rpm=[30.0]),
        )
    )


def falling(scene: Scene) -> ParticleState:
    """The filling with random velocities and spins, so that it touches everything soon."""
    rng, state = np.random.default_rng(0), scene.fresh_filling(0)
    return replace(
        state, velocity=rng.normal(0, 1, (state.count, 3)), angular_velocity=rng.normal(0, 20, (state.count, 3))
    )


def run(advance, state: ParticleState, physics: Physics, speed: float = 3.0) -> ParticleState:
    """A stretch with many impacts."""
    final = advance(state, physics, STEP, np.full(STEPS + 1, speed))
    assert len(final.history) > 20
    return final


def same(one: ParticleState, other: ParticleState) -> bool:
    """Whether two states are bit for bit the same."""
    return all(np.array_equal(getattr(one, n), getattr(other, n)) for n in ("position", "velocity", "angular_velocity"))


@ENGINES
def test_without_friction_no_tangential_law_is_bit_identical(advance):
    scene = scene_of(friction=0.0)
    physics = Physics.of(scene, 0.025)
    assert not physics.tangential
    full = run(advance, falling(scene), replace(physics, tangential=True))
    assert same(run(advance, falling(scene), physics), full)


@ENGINES
def test_without_rolling_friction_no_rolling_model_is_bit_identical(advance):
    scene = scene_of()
    physics = Physics.of(scene, 0.025)
    assert not physics.rolling
    assert same(run(advance, falling(scene), physics), run(advance, falling(scene), replace(physics, rolling=True)))


@ENGINES
def test_walls_at_rest_without_wall_velocity_are_bit_identical(advance):
    scene = scene_of()
    physics = Physics.of(scene, 0.025)
    shapes = tuple(replace(wall, turns=False) for wall in scene.walls)
    still = replace(physics, shapes=shapes, walls=wall_table(shapes))
    assert same(run(advance, falling(scene), physics, 0.0), run(advance, falling(scene), still, 3.0))


@ENGINES
def test_no_walls_are_bit_identical_to_walls_out_of_reach(advance):
    scene = scene_of()
    bare = Physics.of(replace(scene, walls=()), 0.025)
    far = (Plane((0.0, 0.0, -50.0), (0.0, 0.0, 1.0)),)
    # Squeezed, so that pairs touch without a container.
    state = falling(scene)
    state = replace(state, position=0.95 * state.position)
    walled = replace(bare, shapes=far, walls=wall_table(far))
    assert same(run(advance, state, bare), run(advance, state, walled))


def test_wall_distances_of_particles_within_reach_alone_change_only_rounding():
    scene = scene_of()
    near, all_of_them = Physics.of(scene, 0.025), Physics.of(scene, 0.025, skin=2.0)
    one, other = (run(engine_numba.advance, falling(scene), physics) for physics in (near, all_of_them))
    assert np.abs(one.position - other.position).max() < 1e-12


@pytest.mark.parametrize("skin", [1e-4, 2e-3, 0.03])
def test_no_search_before_half_the_skin_is_crossed_changes_only_rounding(skin):
    # A skin of 0.1 mm is crossed in every step, so there every step searches.
    scene = scene_of()
    usual, other = (run(engine_numba.advance, falling(scene), Physics.of(scene, 0.025, skin=s)) for s in (None, skin))
    assert np.abs(usual.position - other.position).max() < 1e-12


def test_no_end_caps_where_the_axis_is_periodic():
    scene = build_scene(SceneConfig(name="slice", container=ContainerConfig(length=0.2, periodic_axis=True)))
    assert len(Physics.of(scene, 0.025).walls) == 1
    assert not scene.needs.end_caps


def test_without_rotation_the_schedule_is_not_read():
    scene = scene_of()
    still, zero = scene.at_rest(), replace(scene, rotation=replace(scene.rotation, speeds_rpm=(0.0,)))
    assert not still.needs.wall_motion
    state = falling(scene)
    assert same(simulate(still, state, 0.03).final, simulate(zero, state, 0.03).final)
