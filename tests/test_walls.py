"""Walls: how far, which way, how they move; the same in both engines, and complete lists while they travel."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numba import njit

from gran_bench.config import DemConfig
from gran_bench.dem import engine_numpy
from gran_bench.dem.fast import engine as engine_numba
from gran_bench.dem.fast.wall_list import shape_of, toward_wall
from gran_bench.dem.integrate import Physics
from gran_bench.dem.simulate import simulate
from gran_bench.dem.time_step import impact_speed
from gran_bench.dem.walls import (
    ABSENT,
    COLUMNS,
    KIND,
    PATH,
    POINT,
    SURFACE,
    VELOCITY,
    surface_velocity,
    wall_contact,
    wall_poses,
)
from gran_bench.scene import (
    Cone,
    Cylinder,
    Disc,
    Filling,
    Material,
    Plane,
    Rotation,
    Scene,
    SceneError,
    Spin,
    Translation,
    Vibration,
    Wall,
    box,
)
from gran_bench.state import ParticleState

UP, X = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
STEP = 2e-4
ENGINES = pytest.mark.parametrize("advance", [engine_numba.advance, engine_numpy.advance], ids=["numba", "numpy"])


@njit
def toward(walls, w, x, y, z):
    """The fast engine's answer, which only jitted code can ask for."""
    return toward_wall(shape_of(walls, w), x, y, z)


def scene_with(*walls: Wall, friction: float = 0.3, restitution: float = 0.5, **changes: object) -> Scene:
    """50 mm spheres without gravity, unless told."""
    material = Material(1e7, 0.3, 2500.0, restitution, friction)
    settings = {"gravity": (0.0, 0.0, 0.0), "start_time": 0.0, "end_time": 1.0} | changes
    return Scene("walls", walls, Filling(1, 0.05), material, material, **settings)


def one_sphere(position: tuple, velocity: tuple = (0.0, 0.0, 0.0), spin: tuple = (0.0, 0.0, 0.0)) -> ParticleState:
    rows = [np.array([row], float) for row in (position, velocity, spin)]
    return ParticleState(*rows, np.full(1, 0.025))


def pose_of(wall: Wall) -> np.ndarray:
    return wall_poses(scene_with(wall), 0.0, STEP, 0)[0, 0]


def closest(wall: Wall, point: tuple) -> tuple[float, list[float]]:
    distance, direction = wall_contact(pose_of(wall), np.array([point], float))
    return float(distance[0]), direction[0].tolist()


# ---- shapes --------------------------------------------------------------------------------------------------

S = math.sqrt(0.5)


@pytest.mark.parametrize(
    ("wall", "point", "distance", "direction"),
    [
        (Plane((0, 0, 1.0), UP), (3, 4, 1.5), 0.5, [0, 0, -1]),
        (Plane((0, 0, 1.0), UP), (3, 4, 0.5), -0.5, [0, 0, -1]),
        (Cylinder((0, 0, 0), UP, 1.0), (0.25, 0, 7), 0.75, [1, 0, 0]),
        (Cylinder((0, 0, 0), UP, 1.0), (0, 0, 7), 1.0, [0, 0, 0]),
        # A disc has two sides and a rim, and does not reach beyond it.
        (Disc((0, 0, 1.0), UP, 0.5), (0.2, 0.1, 1.3), 0.3, [0, 0, -1]),
        (Disc((0, 0, 1.0), UP, 0.5), (0.2, 0.1, 0.7), 0.3, [0, 0, 1]),
        (Disc((0, 0, 1.0), UP, 0.5), (0, 0, 1.3), 0.3, [0, 0, -1]),
        (Disc((0, 0, 0), UP, 0.5), (0.8, 0, 0.4), 0.5, [-0.6, 0, -0.8]),
        (Disc((0, 0, 0), UP, 0.5, hole=0.2), (0, 0.1, 0), 0.1, [0, 1, 0]),
        (Disc((0, 0, 0), UP, 0.5, hole=0.2), (0, 0.3, 0.1), 0.1, [0, 0, -1]),
        # A tube.
        (Cylinder((0, 0, 0), UP, 0.5, length=2.0), (0.4, 0, 0.9), 0.1, [1, 0, 0]),
        (Cylinder((0, 0, 0), UP, 0.5, length=2.0), (0.6, 0, 0.9), 0.1, [-1, 0, 0]),
        (Cylinder((0, 0, 0), UP, 0.5, length=2.0), (0.5, 0, 1.2), 0.2, [0, 0, -1]),
        (Cylinder((0, 0, 0), UP, 0.5, length=2.0), (0.9, 0, 1.3), 0.5, [-0.8, 0, -0.6]),
        # A cone of 45°, from inside, from outside, and at its lower rim.
        (Cone((0, 0, 0), UP, 0.2, 1.2, 1.0), (0.3, 0, 0.5), 0.4 * S, [S, 0, -S]),
        (Cone((0, 0, 0), UP, 0.2, 1.2, 1.0), (0, 1.1, 0.5), 0.4 * S, [0, -S, S]),
        (Cone((0, 0, 0), UP, 0.2, 1.2, 1.0), (0.1, 0, 0), 0.1, [1, 0, 0]),
        (Cone((0, 0, 0), UP, 0.0, 1.0, 1.0), (0, 0, -0.3), 0.3, [0, 0, 1]),
    ],
)
def test_the_closest_point_of_a_wall(wall, point, distance, direction):
    found, way = closest(wall, point)
    assert found == pytest.approx(distance, abs=1e-14)
    assert way == pytest.approx(direction, abs=1e-14)


def test_on_the_axis_of_a_ring_some_way_is_out_and_it_is_always_the_same():
    ring = Disc((0, 0, 0), UP, 0.5, hole=0.02)
    distance, way = closest(ring, (0, 0, 0.02))
    assert toward(pose_of(ring)[None], 0, 0.0, 0.0, 0.02) == pytest.approx((distance, *way), abs=1e-15)
    assert distance == pytest.approx(0.02 * math.sqrt(2))
    assert np.linalg.norm(way) == pytest.approx(1.0)
    assert way[2] == pytest.approx(-S)


@pytest.mark.parametrize("seed", range(3))
def test_both_engines_see_the_same_walls(seed):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis = tuple(axis / np.linalg.norm(axis))
    point = tuple(rng.normal(size=3))
    walls = [
        Plane(point, axis), Cylinder(point, axis, 0.7), Disc(point, axis, 0.7, 0.3), Cone(point, axis, 0.2, 0.9, 0.5),
        Cylinder(point, axis, 0.7, length=1.1), Disc(point, axis, 1.0, opens=0.0),
    ]  # fmt: skip
    poses = wall_poses(scene_with(*walls), 0.0, STEP, 0)[0]
    points = rng.normal(size=(50, 3))
    for w, pose in enumerate(poses):
        distance, way = wall_contact(pose, points)
        fast = np.array([toward(poses, w, *x) for x in points])
        assert fast[:, 0] == pytest.approx(distance, abs=1e-14)
        assert fast[:, 1:] == pytest.approx(way, abs=1e-13)


def test_a_box_is_six_planes_that_look_inwards():
    walls = box((0, 0, 0), (1, 2, 3))
    assert len(walls) == 6
    distances = [closest(wall, (0.1, 0.2, 0.3))[0] for wall in walls]
    assert distances == pytest.approx([0.1, 0.9, 0.2, 1.8, 0.3, 2.7])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Plane((0, 0, 0), (0, 0, 2.0)), "plane.normal=.* length 2; give a unit vector"),
        (lambda: Cylinder((0, 0, 0), UP, -1.0), "cylinder.radius=-1 is impossible; choose a value > 0 m"),
        (lambda: Cylinder((0, 0, 0), UP, 1.0, length=0.0), "cylinder.length=0 is impossible"),
        (lambda: Disc((0, 0, 0), UP, 1.0, hole=1.0), "disc.hole=1 is impossible"),
        (lambda: Cone((0, 0, 0), UP, -0.1, 1.0, 1.0), "cone.radius=-0.1"),
        (lambda: box((0, 0, 0), (1, 0, 1)), "has no room"),
        (lambda: Vibration(math.nan, 1.0, UP), "vibration.amplitude=nan is impossible; choose a finite value in m"),
        (lambda: Translation((0.0, 1.0), ((0, 0, 0),)), "does not match translation.times=.* one speed for each"),
        (lambda: Translation((1.0, 0.0), ((0, 0, 0), (0, 0, 1))), "goes back in time; sort it"),
    ],
)
def test_a_wall_that_cannot_be_is_refused(make, words):
    with pytest.raises(SceneError, match=words):
        make()


# ---- motion --------------------------------------------------------------------------------------------------


def test_a_pose_table_has_shapes_at_the_ends_of_steps_and_velocities_in_their_middles():
    lift = Translation((0.0, 1.0), ((0.0, 0.0, 0.0), (0.0, 0.0, 2.0)))  # z = t²
    scene = scene_with(Plane((0, 0, 0), UP, motion=lift), Plane((0, 0, -1.0), UP))
    poses = wall_poses(scene, 0.5, 0.1, 3)
    assert poses.shape == (4, 2, COLUMNS)
    assert poses[:, 0, 3] == pytest.approx([0.25, 0.36, 0.49, 0.64])
    assert poses[:, 0, 13] == pytest.approx([1.0, 1.1, 1.3, 1.5])
    assert (poses[1:, 0, PATH] >= np.diff(poses[:, 0, 3])).all()
    assert not poses[:, 1, 11:SURFACE].any()


def test_motion_is_a_function_of_the_clock_alone_so_that_a_restart_finds_the_walls():
    shake = Vibration(1e-3, 30.0, UP, phase=0.4, start=0.2)
    scene = scene_with(Plane((0, 0, 0), UP, motion=shake))
    whole, rest = wall_poses(scene, 0.3, 1e-3, 20), wall_poses(scene, 0.31, 1e-3, 10)
    assert rest[:, 0, POINT] == pytest.approx(whole[10:, 0, POINT], abs=1e-15)
    assert rest[1:, 0, VELOCITY] == pytest.approx(whole[11:, 0, VELOCITY], abs=1e-12)


def test_a_vibration_begins_where_the_wall_is_drawn_and_its_velocity_is_the_rate_of_its_place():
    shake = Vibration(2e-3, 25.0, UP, phase=1.0, start=0.1)
    time = np.linspace(0.0, 0.3, 3001)
    place, rate = shake.displacement(time)[:, 2], shake.velocity(time)[:, 2]
    assert not place[time <= 0.1].any()
    late = time > 0.1003
    assert np.gradient(place, time)[late][:-1] == pytest.approx(rate[late][:-1], abs=2e-3)
    assert np.abs(rate).max() == pytest.approx(2 * math.pi * 25 * 2e-3, rel=1e-3)


def test_a_schedule_with_a_jump_is_integrated_exactly():
    rotation = Rotation((1.0, 2.0, 2.0, 3.0), (60.0, 120.0, 30.0, 30.0))  # 1, 2 → ½ revolutions a second
    turns = rotation.angles(np.array([0.0, 1.0, 1.5, 2.0, 4.0])) / (2 * math.pi)
    assert turns == pytest.approx([0.0, 0.0, 0.625, 1.5, 2.5])
    assert rotation.angle(1.5, 4.0) / (2 * math.pi) == pytest.approx(1.875)
    assert rotation.angular_speed(2.0) == pytest.approx(math.pi)  # at a jump the later speed counts


def test_a_turning_disc_that_is_not_symmetric_carries_its_shape_along():
    blade = Disc((0.5, 0, 0), X, 0.2, motion=Spin((0.0,), (60.0,), UP))
    poses = wall_poses(scene_with(blade), 0.0, 0.05, 5)[:, 0]
    angle = 2 * math.pi * 0.05 * np.arange(6)
    assert poses[:, POINT] == pytest.approx(np.stack((0.5 * np.cos(angle), 0.5 * np.sin(angle), 0 * angle), 1))
    assert poses[:, 4:7] == pytest.approx(np.stack((np.cos(angle), np.sin(angle), 0 * angle), 1))
    # Its surface moves as its shape does.
    ahead = wall_poses(scene_with(blade), 0.0, 1e-6, 2)[:, 0]
    moved, middle = (ahead[2, POINT] - ahead[1, POINT]) / 1e-6, 0.5 * (ahead[2, POINT] + ahead[1, POINT])
    assert surface_velocity(ahead[2], middle[None])[0] == pytest.approx(moved, abs=1e-9)
    assert (poses[1:, PATH] >= 2 * math.pi * 0.05 * 0.7 - 1e-12).all()


@pytest.mark.parametrize(
    "wall",
    [
        Plane((0, 0, 0), X, motion=Spin((0.0,), (10.0,), UP)),
        Cylinder((0.1, 0, 0), UP, 1.0, motion=Spin((0.0,), (10.0,), UP)),
        Cylinder((0, 0, 0), X, 1.0, motion=Spin((0.0,), (10.0,), UP)),
    ],
)
def test_a_wall_without_an_end_that_does_not_turn_into_itself_is_refused(wall):
    with pytest.raises(ValueError, match=r"wall 0 turns about .* not symmetric .* give it an end"):
        Physics.of(scene_with(wall), 0.025)


def test_walls_that_slide_along_themselves_move_no_geometry():
    belt = Translation((0.0,), ((1.0, 0.0, 0.0),))
    scene = scene_with(Plane((0, 0, 0), UP, motion=belt), Cylinder((0, 0, 0), X, 1.0, motion=belt))
    poses = wall_poses(scene, 0.0, STEP, 50)
    assert not poses[..., PATH].any()
    assert (poses[..., 11] == 1.0).all()


# ---- what spheres do -----------------------------------------------------------------------------------------


@ENGINES
def test_a_travelling_wall_hits_as_a_resting_one_is_hit(advance):
    """Galilean invariance of a wall: what it does to a sphere depends on their relative velocity alone."""
    still = scene_with(Plane((0, 0, 0), UP))
    moving = scene_with(Plane((0, 0, 0), UP, motion=Translation((0.0,), ((0.2, 0.0, 1.0),))))
    finals = []
    for scene, velocity in ((still, (-0.2, 0.0, -1.0)), (moving, (0.0, 0.0, 0.0))):
        state, physics = one_sphere((0, 0, 0.0303), velocity), Physics.of(scene, 0.025)
        finals.append(advance(state, physics, 2e-5, wall_poses(scene, 0.0, 2e-5, 1000)))
    assert finals[0].velocity[0, 2] == pytest.approx(0.5, abs=2e-3)  # it has bounced, e = 0.5
    assert finals[1].velocity[0] == pytest.approx(finals[0].velocity[0] + [0.2, 0, 1.0], abs=1e-9)
    assert finals[1].angular_velocity == pytest.approx(finals[0].angular_velocity, abs=1e-9)
    assert finals[0].angular_velocity[0, 1] != 0.0


@ENGINES
def test_a_wall_that_comes_from_afar_within_a_stretch_is_not_overlooked(advance):
    # 20 m/s for 10 ms: 0.2 m, far beyond the list's reach of 12.5 mm, and nothing else moves to refresh it.
    ram = Plane((0, 0, -0.15), UP, motion=Translation((0.0,), ((0.0, 0.0, 20.0),)))
    scene = scene_with(ram)
    final = advance(one_sphere((0, 0, 0)), Physics.of(scene, 0.025), 1e-5, wall_poses(scene, 0.0, 1e-5, 1000))
    assert final.velocity[0, 2] == pytest.approx(30.0, rel=0.02)  # (1 + e) of the ram


@ENGINES
def test_a_spinning_floor_carries_a_sphere_along_and_a_disc_does_where_it_is(advance):
    floor = Plane((0, 0, 0), UP, motion=Spin((0.0,), (60.0,), UP))
    disc = Disc((0, 0, 0), UP, 0.5, motion=Spin((0.0,), (60.0,), UP))
    finals = []
    for wall in (floor, disc):
        scene = scene_with(wall, gravity=(0.0, 0.0, -9.81))
        poses = wall_poses(scene, 0.0, STEP, 50)
        finals.append(advance(one_sphere((0.3, 0, 0.0249)), Physics.of(scene, 0.025), STEP, poses))
    assert finals[0].velocity[0, 1] > 0.02  # counter-clockwise seen from above
    assert finals[1].position == pytest.approx(finals[0].position, abs=1e-12)
    assert finals[1].angular_velocity == pytest.approx(finals[0].angular_velocity, abs=1e-9)


@ENGINES
def test_a_lid_holds_until_it_opens_and_is_then_gone(advance):
    lid = Disc((0, 0, 0), UP, 0.1, opens=0.1)
    scene = scene_with(lid, gravity=(0.0, 0.0, -9.81))
    physics, state = Physics.of(scene, 0.025), one_sphere((0, 0, 0.0249))
    poses = wall_poses(scene, 0.0, STEP, 1000)
    assert (poses[:, 0, KIND] == ABSENT).sum() == 501  # from 0.1 s on, which is the end of step 500
    held = advance(state, physics, STEP, poses[:500])
    gone = advance(state, physics, STEP, poses)
    assert held.position[0, 2] == pytest.approx(0.0249, abs=2e-4)
    assert gone.position[0, 2] == pytest.approx(held.position[0, 2] - 0.5 * 9.81 * 0.1**2, rel=0.02)
    assert len(gone.history) == 0
    assert scene.at_rest().walls[0].opens is None  # while a bed settles, it is there


@ENGINES
def test_a_sphere_between_two_sides_of_a_disc_is_touched_from_the_side_it_is_on(advance):
    scene = scene_with(Disc((0, 0, 0), UP, 0.5), restitution=1.0, friction=0.0)
    for side in (1.0, -1.0):
        state = one_sphere((0.1, 0.1, 0.03 * side), (0, 0, -side))
        final = advance(state, Physics.of(scene, 0.025), 2e-5, wall_poses(scene, 0.0, 2e-5, 1000))
        assert final.velocity[0, 2] == pytest.approx(side, rel=1e-3)


@ENGINES
def test_a_sphere_rolls_down_a_cone_through_its_hole(advance):
    scene = scene_with(Cone((0, 0, 0), UP, 0.1, 0.6, 0.5), gravity=(0.0, 0.0, -9.81), friction=0.5)
    state = one_sphere((0.4 - 0.025 * S, 0, 0.3 + 0.025 * S))
    physics, lowest = Physics.of(scene, 0.025), []
    for k in range(60):
        state = advance(state, physics, STEP, wall_poses(scene, 0.01 * k, STEP, 50))
        lowest.append(state.position[0, 2])
    assert min(lowest) > -20.0
    assert lowest[-1] < -0.1
    through = next(z for z in lowest if z < 0.0)
    assert lowest.index(through) > 30  # it took its time on the slope


@pytest.mark.parametrize(
    "wall",
    [
        Plane((0, 0, 0), UP, motion=Vibration(2e-3, 40.0, UP, phase=0.3)),
        Plane((0, 0, 0), UP, motion=Translation((0.0, 0.1), ((0.3, 0.0, 0.0), (0.3, 0.2, 0.1)))),
        Disc((0, 0, 0), UP, 0.3, motion=Spin((0.0, 0.1), (0.0, 90.0), UP)),
        Disc((0, 0, -0.15), (0.0, 0.6, 0.8), 0.3, motion=Spin((0.0,), (20.0,), UP)),
        Cone((0, 0, -0.02), UP, 0.02, 0.3, 0.02, motion=Vibration(1e-3, 50.0, X)),
        Disc((0, 0, 0), UP, 0.3, opens=0.045),
    ],
    ids=["vibration", "translation", "spin", "blade", "shaken cone", "lid"],
)
def test_engines_agree_and_a_restart_is_bit_identical_on_moving_walls(wall):
    scene = scene_with(wall, gravity=(0.0, 0.0, -9.81))
    rng, grid = np.random.default_rng(0), np.arange(-2, 3) * 0.06
    x, y, z = np.meshgrid(grid, grid, [0.06, 0.12])
    position = np.stack((x, y, z), -1).reshape(-1, 3) + rng.uniform(-0.003, 0.003, (50, 3))
    state = ParticleState(
        position, rng.normal(0, 0.3, (50, 3)) - [0, 0, 1.0], rng.normal(0, 10, (50, 3)), np.full(50, 0.025)
    )
    runs = {
        name: simulate(scene, state, 0.1, dem=DemConfig(engine=name, time_step=STEP)) for name in ("numba", "numpy")
    }
    assert runs["numba"].trajectory.diagnostics["wall_contact_count"].max() > 2
    fast, reference = (run.trajectory.position for run in runs.values())
    assert np.abs(fast[:9] - reference[:9]).max() < 1e-10
    for name, whole in runs.items():
        dem = DemConfig(engine=name, time_step=STEP)
        half = simulate(scene, state, 0.07, dem=dem).final
        final = simulate(scene, half, 0.1, dem=dem).final
        for field in ("position", "velocity", "angular_velocity"):
            assert np.array_equal(getattr(final, field), getattr(whole.final, field)), (name, field)
        assert np.array_equal(final.history.force, whole.final.history.force)


def test_the_step_follows_the_speed_of_moving_walls():
    slow = scene_with(Plane((0, 0, 0), UP))
    shaken = replace(slow, walls=(Plane((0, 0, 0), UP, motion=Vibration(0.1, 100.0, UP)),))
    assert impact_speed(slow) == 0.0
    assert impact_speed(shaken) == pytest.approx(20 * math.pi)
