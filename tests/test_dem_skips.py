"""What a scene does not need is skipped; the result is the same as without the skip."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gran_bench.config import ContainerConfig, FillingConfig, MaterialConfig, RotationConfig, SceneConfig
from gran_bench.dem import engine_numpy
from gran_bench.dem.fast import engine as engine_numba
from gran_bench.dem.integrate import Physics
from gran_bench.dem.simulate import simulate
from gran_bench.dem.walls import COLUMNS, wall_poses
from gran_bench.scene import Disc, Plane, Scene, Sizes, build_scene
from gran_bench.state import ContactHistory, ParticleState

STEP, STEPS = 2e-4, 150
MOVING = ("position", "velocity", "angular_velocity")
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


def run(advance, scene: Scene, state: ParticleState, **changes: object) -> ParticleState:
    """A stretch with many impacts in a scene's physics, or what ``changes`` make of it."""
    skin = changes.pop("skin", None)
    walls = changes.pop("walls", wall_poses(scene, 0.0, STEP, STEPS))
    final = advance(state, replace(Physics.of(scene, 0.025, skin), **changes), STEP, walls)
    assert len(final.history) > 20
    return final


def same(one: ParticleState, other: ParticleState) -> bool:
    """Whether two states are bit for bit the same."""
    return all(np.array_equal(getattr(one, n), getattr(other, n)) for n in MOVING)


@ENGINES
def test_without_friction_no_tangential_law_is_bit_identical(advance):
    scene = scene_of(friction=0.0)
    assert not scene.needs.tangential
    assert not Physics.of(scene, 0.025).tangential
    assert same(run(advance, scene, falling(scene)), run(advance, scene, falling(scene), tangential=True))


@ENGINES
def test_without_rolling_friction_no_rolling_model_is_bit_identical(advance):
    scene = scene_of()
    assert not scene.needs.rolling
    assert same(run(advance, scene, falling(scene)), run(advance, scene, falling(scene), rolling=True))


@ENGINES
def test_walls_at_rest_without_wall_velocity_are_bit_identical(advance):
    scene = scene_of().at_rest()
    assert not scene.needs.wall_motion
    # A speed too small to change a digit goes through all of the arithmetic.
    creeping = replace(scene, rotation=replace(scene.rotation, speeds_rpm=(1e-290,)))
    assert creeping.needs.wall_motion
    assert same(run(advance, scene, falling(scene)), run(advance, creeping, falling(scene)))


@ENGINES
def test_walls_whose_shape_rests_need_no_pose_for_every_step(advance):
    scene = scene_of()
    assert not scene.needs.wall_geometry
    walls = wall_poses(scene, 0.0, STEP, STEPS)
    assert walls.strides[0] == 0  # one row, seen many times
    assert same(run(advance, scene, falling(scene)), run(advance, scene, falling(scene), walls=walls.copy()))


@ENGINES
def test_no_walls_are_bit_identical_to_walls_out_of_reach(advance):
    scene = scene_of()
    bare = replace(scene, walls=())
    far = replace(scene, walls=(Plane((0.0, 0.0, -50.0), (0.0, 0.0, 1.0), turns=False),))
    assert not bare.needs.walls
    # Squeezed, so that pairs touch without a container.
    state = falling(scene)
    state = replace(state, position=0.95 * state.position)
    assert same(run(advance, bare, state), run(advance, far, state))


def test_wall_distances_of_particles_within_reach_alone_are_bit_identical_to_all_of_them():
    scene = scene_of()
    assert same(*(run(engine_numba.advance, scene, falling(scene), skin=skin) for skin in (None, 2.0)))


@pytest.mark.parametrize("skin", [1e-4, 2e-3, 0.03])
def test_no_search_before_half_the_skin_is_crossed_is_bit_identical(skin):
    # A skin of 0.1 mm is crossed in every step, so there every step searches.
    scene = scene_of()
    assert same(*(run(engine_numba.advance, scene, falling(scene), skin=s) for s in (None, skin)))


@pytest.mark.parametrize("skin", [1e-4, 4e-3, 0.1])
def test_what_rests_has_little_room_and_is_still_found_when_it_is_hit(skin):
    # All but one are at rest when the first lists are made, and have the least margin.
    scene = replace(scene_of(), gravity=(0.0, 0.0, 0.0))
    state = scene.fresh_filling(0)
    velocity = np.zeros((state.count, 3))
    velocity[0] = (8.0, 3.0, 5.0)
    state = replace(state, velocity=velocity)
    walls = wall_poses(scene, 0.0, STEP, STEPS)
    one, other = (engine_numba.advance(state, Physics.of(scene, 0.025, s), STEP, walls) for s in (None, skin))
    assert same(one, other)
    moved = np.linalg.norm(one.position - state.position, axis=1)
    assert np.count_nonzero(moved > 1e-3) > 10, "several were hit"
    reference = engine_numpy.advance(state, Physics.of(scene, 0.025), STEP, walls)
    assert np.abs(reference.position - one.position).max() < 1e-10


@pytest.mark.parametrize(
    ("large_at", "small_at", "speed", "gap", "approach", "skin"),
    [
        (-0.12966, -0.18958, 2.978, 1.0e-4, 0.05, 0.0057),
        (-0.12998, -0.18989, 0.993, 6.0e-5, 0.017, 0.00179),
        (-0.12911, -0.18895, 5.015, 5.0e-5, 0.084, 0.01062),
    ],
)
def test_a_pair_that_parts_within_a_step_takes_nobodys_history(large_at, small_at, speed, gap, approach, skin):
    # A small sphere bounces between an end cap and a large one, so fast that in one step it leaves the reach of the
    # inner list, and comes back, while two large ones touch, spinning. The step is a sixth of the contact time.
    scene = build_scene(SceneConfig(name="cap", container=ContainerConfig(length=0.4), filling=FillingConfig(count=10)))
    scene, step, large, small = replace(scene, gravity=(0.0, 0.0, 0.0)), 3.362e-4, 0.05, 0.01
    state = ParticleState(
        np.array([[0.0, large_at, 0.0], [-0.25, 0.0, 2 * large + gap], [0.0, small_at, 0.0], [-0.25, 0.0, 0.0]]),
        np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -approach], [0.0, -speed, 0.0], [0.0, 0.0, approach]]),
        np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 5.0], [30.0, 0.0, 0.0], [50.0, 10.0, 0.0]]),
        np.array([large, large, small, large]),
        0.0,
        ContactHistory.empty(),
    )
    walls = wall_poses(scene, 0.0, step, 10)
    narrow, wide = (
        engine_numba.advance(state, Physics.of(scene, large, width), step, walls) for width in (skin, 1.6 * large)
    )
    assert np.array_equal(narrow.angular_velocity, wide.angular_velocity)


@pytest.mark.parametrize("skin", [2e-3, 0.02])
def test_a_periodic_axis_is_bit_identical_for_any_skin_too(skin):
    scene = build_scene(
        SceneConfig(
            name="slice",
            container=ContainerConfig(length=0.2, periodic_axis=True),
            filling=FillingConfig(count=200),
            rotation=RotationConfig(times=[0.0], speeds_rpm=[30.0]),
        )
    )
    state = falling(scene)
    state = replace(state, velocity=state.velocity + np.array([0.0, 2.0, 0.0]))  # over the seam
    assert same(*(run(engine_numba.advance, scene, state, skin=s) for s in (None, skin)))


def test_spheres_of_one_size_need_no_sizes_of_each_contact():
    # One of another size, out of everyone's reach, makes the engine compute what it skips.
    scene = replace(scene_of(), walls=())
    state = falling(scene)
    state = replace(state, position=0.95 * state.position)
    one = run(engine_numba.advance, scene, state)
    odd = [np.append(getattr(state, name), np.zeros((1, 3)), axis=0) for name in ("velocity", "angular_velocity")]
    # In a corner of the bed's box, which the round bed leaves empty: the others keep their order.
    low = state.position.min(axis=0)
    place = np.append(state.position, [[low[0], 0.0, low[2]]], axis=0)
    more = ParticleState(place, *odd, np.append(state.radius, 0.024))
    other = run(engine_numba.advance, scene, more)
    assert np.array_equal(other.position[:-1], one.position)
    assert np.array_equal(other.angular_velocity[:-1], one.angular_velocity)


def test_no_end_caps_where_the_axis_is_periodic():
    scene = build_scene(SceneConfig(name="slice", container=ContainerConfig(length=0.2, periodic_axis=True)))
    assert wall_poses(scene, 0.0, STEP, 1).shape == (2, 1, COLUMNS)
    assert not scene.needs.end_caps


def test_without_rotation_the_schedule_is_not_read():
    scene = scene_of()
    still, zero = scene.at_rest(), replace(scene, rotation=replace(scene.rotation, speeds_rpm=(0.0,)))
    assert not still.needs.wall_motion
    state = falling(scene)
    assert same(simulate(still, state, 0.03).final, simulate(zero, state, 0.03).final)


@ENGINES
def test_one_material_needs_no_law_for_each_pair_of_them(advance):
    scene = scene_of()
    assert not scene.needs.materials
    twice = replace(scene, more_materials=(scene.material,))
    assert twice.needs.materials
    state = falling(scene)
    mixed = replace(state, material=np.arange(state.count, dtype=np.uint8) % 2)
    assert same(run(advance, scene, state), run(advance, twice, mixed))


@ENGINES
def test_one_size_needs_no_distribution_and_is_what_a_distribution_of_one_size_gives(advance):
    scene = scene_of()
    assert not scene.needs.polydispersity
    listed = replace(scene, filling=replace(scene.filling, sizes=Sizes("listed", (1.0,), (1.0,))))
    assert same(run(advance, scene, falling(scene)), run(advance, listed, falling(listed)))


@ENGINES
def test_no_gravity_is_bit_identical_to_a_gravity_too_small_to_change_a_digit(advance):
    scene = replace(scene_of(), gravity=(0.0, 0.0, 0.0))
    assert not scene.needs.gravity
    weak = replace(scene, gravity=(0.0, 0.0, -1e-150))
    assert weak.needs.gravity
    assert same(run(advance, scene, falling(scene)), run(advance, weak, falling(scene)))


@ENGINES
def test_a_lid_that_never_opens_needs_no_pose_for_every_step(advance):
    lid = Disc((0.0, 0.0, -0.2), (0.0, 0.0, 1.0), 0.4, turns=False)
    kept, opening = (replace(scene_of(), walls=(*scene_of().walls, replace(lid, opens=time))) for time in (None, 1e9))
    assert not kept.needs.wall_geometry
    assert opening.needs.wall_geometry
    assert same(run(advance, kept, falling(kept)), run(advance, opening, falling(kept)))
