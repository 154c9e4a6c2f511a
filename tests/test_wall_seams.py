"""Pieces of one surface answer a sphere once: over a seam it is held, thrown back and carried as by one piece."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gran_bench.dem import engine_numpy
from gran_bench.dem.contact import sphere_mass
from gran_bench.dem.fast import engine as engine_numba
from gran_bench.dem.integrate import Physics
from gran_bench.dem.walls import SURFACE, wall_poses
from gran_bench.scene import (
    Cone,
    Cylinder,
    Disc,
    Filling,
    Material,
    Plane,
    Scene,
    Spin,
    Translation,
    Wall,
    box,
)
from gran_bench.shipped import shipped_scene
from gran_bench.state import ParticleState
from gran_bench.surrogate.contact.geometry import find_contacts
from gran_bench.surrogate.contact.memory import follow_memory
from gran_bench.surrogate.convolution.boundary import see_contacts

UP, X, Y = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
R = 0.025
STEP = 2e-5
ENGINES = pytest.mark.parametrize("advance", [engine_numba.advance, engine_numpy.advance], ids=["numba", "numpy"])
S = math.sqrt(0.5)

RING, FILL = Disc((0, 0, 0), UP, 0.3, hole=0.1), Disc((0, 0, 0), UP, 0.1)
LEFT, RIGHT = Cylinder((-0.2, 0, 0), X, 0.3, length=0.4), Cylinder((0.2, 0, 0), X, 0.3, length=0.4)
BELT, BED = Translation((0.0,), ((0.3, 0.0, 0.0),)), Plane((0, 0, 0), UP)
# Walls, and a place on their surface with the unit vector from it to the side where a sphere is.
SEAMS = {
    "ring and its filling": ((RING, FILL), (0.1, 0, 0), UP),
    "filling and its ring, from below": ((FILL, RING), (0, 0.1, 0), (0, 0, -1.0)),
    "two tubes in line": ((LEFT, RIGHT), (0, 0, -0.3), UP),
    "two tubes in line, from outside": ((LEFT, RIGHT), (0, 0, 0.3), UP),
    "a cone on a cone": ((Cone((0, 0, 0), UP, 0.0, 0.2, 0.2), Cone((0, 0, 0.2), UP, 0.2, 0.4, 0.2)), (0.2, 0, 0.2),
                         (-S, 0, S)),
    "the edge of a cone on a tube": ((Cone((0, 0, 0), UP, 0.3, 0.0, 0.3), Cylinder((0, 0, -0.1), UP, 0.3, length=0.2)),
                                     (0.3, 0, 0), (math.cos(0.4), 0, math.sin(0.4))),
    "the edge of a lid on a tube": ((Disc((0, 0, 0), UP, 0.3), Cylinder((0, 0, -0.1), UP, 0.3, length=0.2)),
                                    (0, 0.3, 0), (0, S, S)),
    "a tube on the other side of a disc": ((Disc((0, 0, 0), UP, 0.3), Cylinder((0, 0, -0.1), UP, 0.2, length=0.2)),
                                           (0.2, 0, 0), UP),
    "two planes in one place": ((BED, BED), (0.1, 0.2, 0), UP),
    "a disc in a plane": ((Disc((0, 0, 0), UP, 0.1), BED), (0.05, 0, 0), UP),
    "two discs side by side": ((Disc((-0.1, 0, 0), UP, 0.1), Disc((0.1, 0, 0), UP, 0.1)), (0, 0, 0), UP),
    "three pieces": ((Disc((0, 0, 0), UP, 0.3), Cylinder((0, 0, -0.1), UP, 0.3, length=0.2), RING), (0.3, 0, 0),
                     (S, 0, S)),
}  # fmt: skip
ALL_SEAMS = pytest.mark.parametrize("name", SEAMS)


def scene_with(*walls: Wall, friction: float = 0.0, restitution: float = 0.5, **changes: object) -> Scene:
    """50 mm spheres without gravity, unless told."""
    material = Material(1e7, 0.29, 2500.0, restitution, friction, changes.pop("rolling_friction", 0.0))
    settings = {"gravity": (0.0, 0.0, 0.0), "start_time": 0.0, "end_time": 1.0} | changes
    return Scene("seams", walls, Filling(1, 2 * R), material, material, **settings)


def one_sphere(position, velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.0, 0.0)) -> ParticleState:
    rows = [np.array([row], float) for row in (position, velocity, spin)]
    return ParticleState(*rows, np.full(1, R))


def after(advance, scene: Scene, state: ParticleState, steps: int, step: float = STEP) -> ParticleState:
    return advance(state, Physics.of(scene, R), step, wall_poses(scene, state.time, step, steps))


def force_on(advance, scene: Scene, state: ParticleState) -> np.ndarray:
    """Of the walls, from what one step from rest does to the velocity, N."""
    mass = float(sphere_mass(scene.material.density, R))
    return after(advance, scene, state, 1, 1e-9).velocity[0] * mass / 1e-9


@ENGINES
@ALL_SEAMS
def test_over_a_seam_the_force_is_hertz(advance, name):
    walls, place, outward = SEAMS[name]
    overlap = 1e-3 * R
    scene = scene_with(*walls)
    state = one_sphere(np.array(place) + (R - overlap) * np.array(outward))
    modulus = 1e7 / (2.0 * (1.0 - 0.29**2))
    hertz = 4.0 / 3.0 * modulus * math.sqrt(R) * overlap**1.5
    assert force_on(advance, scene, state) == pytest.approx(hertz * np.array(outward), rel=1e-4, abs=1e-4 * hertz)
    assert len(after(advance, scene, state, 1).history) == 1


@ENGINES
def test_a_sphere_at_rest_over_a_seam_sinks_in_as_on_one_piece(advance):
    scene = scene_with(RING, FILL, gravity=(0.0, 0.0, -9.81), friction=0.3)
    modulus, weight = 1e7 / (2.0 * (1.0 - 0.29**2)), 9.81 * float(sphere_mass(2500.0, R))
    hertz = (3.0 * weight / (4.0 * modulus * math.sqrt(R))) ** (2.0 / 3.0)
    final = after(advance, scene, one_sphere((0.1, 0, R - 0.5 * hertz)), 1500, 2e-4)
    assert R - final.position[0, 2] == pytest.approx(hertz, rel=1e-3)


@ENGINES
@ALL_SEAMS
def test_an_impact_on_a_seam_comes_back_with_the_materials_restitution(advance, name):
    walls, place, outward = SEAMS[name]
    outward = np.array(outward)
    state = one_sphere(np.array(place) + (R + 1e-3) * outward, -outward)
    final = after(advance, scene_with(*walls), state, 1000)
    assert final.velocity[0] == pytest.approx(0.5 * outward, abs=2e-3)


@ENGINES
@pytest.mark.parametrize("speed", [1.0, 50.0])
def test_a_sphere_that_rolls_over_a_seam_feels_nothing_of_it(advance, speed):
    """Position, spin, and the elastic force that the contact remembers are those of a floor of one piece."""
    step, steps = 1e-4, round(0.1 / speed / 1e-4) if speed < 50.0 else 15  # of a fifth of a radius
    finals = []
    for walls in ((RING, FILL), (Disc((0, 0, 0), UP, 0.3),)):
        scene = scene_with(*walls, friction=0.3, rolling_friction=0.01, gravity=(0.0, 0.0, -9.81))
        state = one_sphere((0.15, 0.02, R - 2e-5), (-speed, 0, 0), (0, -0.9 * speed / R, 3.0))
        finals.append(after(advance, scene, state, steps, step))
    over, plain = finals
    assert over.position[0, 0] < 0.1 - 0.02
    assert len(over.history) == len(plain.history) == 1
    for field in ("position", "velocity", "angular_velocity"):
        assert getattr(over, field) == pytest.approx(getattr(plain, field), abs=1e-8 * max(1.0, speed)), field
    assert over.history.force == pytest.approx(plain.history.force, abs=1e-6)
    assert over.history.rolling_moment == pytest.approx(plain.history.rolling_moment, abs=1e-8)
    assert np.abs(plain.history.rolling_moment).max() > 1e-9


@ENGINES
def test_what_a_sphere_touches_is_the_piece_under_it(advance):
    """A ring that turns about a resting floor: each drives the sphere over it, and only that one."""
    scene = scene_with(replace(RING, motion=Spin((0.0,), (30.0,), UP)), FILL, friction=0.5)
    on_ring, on_floor = (
        after(advance, scene, one_sphere((x, 0, R - 1e-4)), 20).velocity[0, 1] for x in (0.1 + 0.02 * R, 0.1 - 0.02 * R)
    )
    assert on_ring > 1e-4
    assert on_floor == 0.0


@ENGINES
def test_of_two_planes_in_one_place_the_first_answers(advance):
    moving, resting = Plane((0, 0, 0), UP, motion=BELT), Plane((0, 0, 0), UP, turns=False)
    driven = [
        after(advance, scene_with(*walls, friction=0.5), one_sphere((0, 0, R - 1e-4)), 20).velocity[0, 0]
        for walls in ((moving,), (moving, resting), (resting, moving))
    ]
    assert driven[1] == driven[0] > 1e-4
    assert driven[2] == 0.0


CORNERS = {
    "tube and lid": ((Cylinder((0, 0, 0.2), UP, 0.3, length=0.4), Disc((0, 0, 0), UP, 0.3)),
                     (0.3 - R + 1e-4, 0, R - 1e-4)),
    "tube on a plane, from outside": ((Cylinder((0, 0, 0.2), UP, 0.3, length=0.4), BED), (0.3 + R - 1e-4, 0, R - 1e-4)),
    "floor and side of a box": (box((0, 0, 0), (1, 1, 1)), (R - 1e-4, 0.5, R - 1e-4)),
    "tube and cone of a hopper": ((Cylinder((0, 0, 0.2), UP, 0.3, length=0.4), Cone((0, 0, -0.2), UP, 0.1, 0.3, 0.2)),
                                  (0.3 - R + 1e-4, 0, (R - 1e-4) * math.tan(math.pi / 8))),
}  # fmt: skip


@ENGINES
@pytest.mark.parametrize("name", CORNERS)
def test_a_sphere_in_a_corner_has_two_contacts_as_ever(advance, name):
    walls, place = CORNERS[name]
    scene = scene_with(*walls, friction=0.3)
    state = one_sphere(place, (0.02, 0.1, -0.05), (3.0, -4.0, 5.0))
    poses = wall_poses(scene, 0.0, STEP, 60)
    apart = np.array(poses)
    apart[..., SURFACE] = 0.0  # nobody asks whether they are pieces of one surface
    final, untouched = (advance(state, Physics.of(scene, R), STEP, table) for table in (poses, apart))
    assert len(final.history) == 2
    for field in ("position", "velocity", "angular_velocity"):
        assert np.array_equal(getattr(final, field), getattr(untouched, field)), field


@ENGINES
def test_beside_a_blunt_corner_the_rim_of_the_other_piece_does_not_answer(advance):
    """On a floor, nearer to the foot of a cone than its radius, but not in the cone's way."""
    shallow = math.radians(10.0)
    hill = Cone((0, 0, 0), UP, 0.3, 0.3 - 0.2, 0.2 * math.tan(shallow))
    overlap, step_back = 1e-3, 6e-3  # the hill's own closest point is its foot
    state = one_sphere((0.3 + step_back, 0, R - overlap))
    forces = [force_on(advance, scene_with(*walls), state) for walls in ((BED, hill), (BED,))]
    assert math.hypot(step_back, R - overlap) < R, "its foot is in reach"
    assert forces[0] == pytest.approx(forces[1], abs=1e-9 * forces[1][2])


@ENGINES
def test_pieces_that_move_apart_are_two_surfaces(advance):
    """A lid that leaves its ring: at first one contact, then the ring's edge alone, whatever the lid was."""
    lid = replace(FILL, motion=Translation((0.0,), ((0.0, 0.0, -1.0),)))
    scene = scene_with(RING, lid)
    state = one_sphere((0.1 + 1e-4, 0, R - 1e-4))
    assert len(after(advance, scene, state, 1, 1e-9).history) == 1
    gone = wall_poses(scene, 0.1, 1e-9, 1)
    alone = scene_with(RING)
    final, expected = (
        advance(state, Physics.of(s, R), 1e-9, poses)
        for s, poses in ((scene, gone), (alone, wall_poses(alone, 0.0, 1e-9, 1)))
    )
    assert np.array_equal(final.velocity, expected.velocity)
    # Half a radius above, the same lid and its ring both answer a sphere in the step between them.
    stair = scene_with(Disc((0, 0, 0), UP, 0.3), replace(FILL, point=(0, 0, 0.5 * R)))
    corner = one_sphere((0.1 + math.sqrt(0.75) * R - 1e-4, 0, R - 1e-4))
    assert len(after(advance, stair, corner, 1).history) == 2


@ENGINES
def test_a_lid_that_opens_leaves_the_ring_its_edge(advance):
    scene = scene_with(FILL, RING, gravity=(0.0, 0.0, -9.81))
    opening = replace(scene, walls=(replace(FILL, opens=0.05), RING))
    state = one_sphere((0.1 - 1e-3, 0, R - 1e-5))
    held, falls = (after(advance, s, state, 2000, 2e-4) for s in (scene, opening))
    assert held.position[0, 2] == pytest.approx(R, abs=2e-4)
    assert falls.position[0, 2] < -0.05


def test_both_engines_agree_on_a_crowd_that_runs_over_seams():
    rng = np.random.default_rng(0)
    tile = Disc((0, 0, 0), UP, 0.1)
    walls = (
        Cylinder((0, 0, 0.2), UP, 0.3, length=0.4), RING, tile,
        Cone((0, 0, 0.4), UP, 0.3, 0.5, 0.05), Cylinder((0, 0, 0), UP, 0.1, length=0.04),
    )  # fmt: skip
    scene = scene_with(*walls, friction=0.4, rolling_friction=0.02, gravity=(0.0, 0.0, -9.81))
    grid = np.stack(np.meshgrid(*[np.arange(-4, 5) * 0.054] * 2, [0.05, 0.104, 0.158], indexing="ij"), -1)
    position = grid.reshape(-1, 3)
    position = position[np.hypot(position[:, 0], position[:, 1]) < 0.25]
    count = len(position)
    state = ParticleState(position, rng.normal(0, 1.5, (count, 3)), rng.normal(0, 30, (count, 3)), np.full(count, R))
    fast, reference = (
        after(advance, scene, state, 400, 1e-4) for advance in (engine_numba.advance, engine_numpy.advance)
    )
    assert np.count_nonzero(reference.history.second < 0) > 10
    pairs = [sorted(zip(h.first.tolist(), h.second.tolist(), strict=True)) for h in (fast.history, reference.history)]
    walls_only = [[p for p in contacts if p[1] < 0] for contacts in pairs]
    assert walls_only[0] == walls_only[1]
    for field in ("position", "velocity", "angular_velocity"):
        assert np.abs(getattr(fast, field) - getattr(reference, field)).max() < 1e-8, field


def test_threads_and_skin_change_no_bit_over_seams():
    rings = [Disc((0, 0, 0), UP, 0.1 * (k + 1), hole=0.1 * k) for k in range(15)]
    scene = scene_with(*rings, friction=0.4, rolling_friction=0.02, gravity=(0.0, 0.0, -9.81))
    rng, line = np.random.default_rng(0), np.arange(-20, 20) * 0.055
    position = np.stack(np.meshgrid(line, line, [R - 1e-4], indexing="ij"), -1).reshape(-1, 3)
    count = len(position)
    assert len(engine_numba.chunk_bounds(count)) == 3
    velocity = rng.normal(0, 0.3, (count, 3)) * (1, 1, 0)
    state = ParticleState(position, velocity, rng.normal(0, 9, (count, 3)), np.full(count, R))
    physics, step = Physics.of(scene, R), 2e-4
    whole = after(engine_numba.advance, scene, state, 200, step)
    crossed = np.floor(np.hypot(*position[:, :2].T) / 0.1) != np.floor(np.hypot(*whole.position[:, :2].T) / 0.1)
    assert np.count_nonzero(crossed) > 50
    poses = wall_poses(scene, 0.0, step, 200)
    others = [
        engine_numba.advance(state, replace(physics, threads=2), step, poses),
        engine_numba.advance(state, replace(physics, skin=2e-3), step, poses),
    ]
    for other in others:
        for field in ("position", "velocity", "angular_velocity"):
            assert np.array_equal(getattr(other, field), getattr(whole, field)), field


# ---- what a scene needs --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["drum", "drum_small", "packing", "free_flight", "collision"])
def test_scenes_whose_walls_meet_at_no_edge_skip_it(name):
    scene = shipped_scene(name)
    assert not scene.needs.wall_seams
    assert not wall_poses(scene, 0.0, STEP, 1)[..., SURFACE].any()


@ENGINES
def test_skipping_it_where_no_walls_meet_is_bit_identical(advance):
    """A box whose walls all claim to be pieces of one surface: each asks the others, and nothing changes."""
    scene = scene_with(*box((0, 0, 0), (0.4, 0.4, 0.4)), friction=0.3)
    rng = np.random.default_rng(1)
    line = np.arange(7) * 0.056 + 0.03
    position = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)
    count = len(position)
    state = ParticleState(position, rng.normal(0, 2, (count, 3)), rng.normal(0, 9, (count, 3)), np.full(count, R))
    poses = wall_poses(scene, 0.0, 1e-4, 60)
    asked = np.array(poses)
    asked[..., SURFACE] = 1.0
    plain, other = (advance(state, Physics.of(scene, R), 1e-4, table) for table in (poses, asked))
    assert np.count_nonzero(plain.history.second < 0) > 20
    for field in ("position", "velocity", "angular_velocity"):
        assert np.array_equal(getattr(plain, field), getattr(other, field)), field


@pytest.mark.parametrize(
    ("walls", "expected"),
    [
        ((RING, FILL), (1, 1)),
        ((LEFT, RIGHT, Plane((0, 0, -1.0), UP)), (1, 1, 0)),
        ((LEFT, replace(RIGHT, point=(0.21, 0, 0))), (0, 0)),
        (box((0, 0, 0), (1, 1, 1)), (0,) * 6),
        ((BED, BED, Plane((0, 0, 0), (0, 0, -1.0))), (1, 1, 0)),
        ((Cylinder((0, 0, 0), UP, 0.3), Cylinder((0, 0, 9.0), UP, 0.3), Cylinder((0, 0, 0), UP, 0.4)), (1, 1, 0)),
        ((RING, Plane((0, 0, -1.0), UP), FILL, Disc((0, 0, -1.0), UP, 0.1)), (1, 2, 1, 2)),
        # They travel relative to each other, so they may meet.
        ((LEFT, replace(RIGHT, point=(0.3, 0, 0), motion=BELT)), (1, 1)),
        ((replace(LEFT, motion=BELT), replace(RIGHT, point=(0.3, 0, 0), motion=BELT)), (0, 0)),
        ((Plane((0, 0, 0), UP, motion=BELT), Plane((0, 0, 0), X)), (0, 0)),
        # What turns about its own axis stays where it is.
        ((RING, replace(FILL, motion=Spin((0.0,), (30.0,), UP))), (1, 1)),
        ((RING, replace(FILL, point=(0, 0, 1.0), motion=Spin((0.0,), (30.0,), UP))), (0, 0)),
    ],
)
def test_which_walls_are_pieces_of_one_surface(walls, expected):
    scene = scene_with(*walls)
    assert scene.surfaces == expected
    assert scene.needs.wall_seams == any(expected)


def test_the_hopper_is_one_surface_of_tube_cone_and_lid():
    assert shipped_scene("hopper").surfaces == (1, 1, 1)


class TestSurrogates:
    """What the DEM merges, a surrogate sees once."""

    @ALL_SEAMS
    def test_a_sphere_over_a_seam_is_one_contact_and_one_source(self, name):
        walls, place, normal = SEAMS[name]
        scene = scene_with(*walls)
        position = np.add(place, 0.99 * R * np.array(normal))[None]
        contacts = find_contacts(scene, 0.0, position, 2 * R, 0.01)
        assert len(contacts.wall) == 1
        sources = see_contacts(torch.tensor(position), torch.zeros(1, 3, dtype=torch.float64), scene, 0.0, 1.2 * R)
        assert len(sources.normal) == 1
        assert sources.near.tolist() == [0]

    def test_the_corner_of_a_tube_and_its_lid_is_two(self):
        scene = scene_with(Cylinder((0, 0, 0), UP, 0.3, length=0.2), Disc((0, 0, -0.1), UP, 0.3))
        assert scene.needs.wall_seams
        position = np.array([[0.3 - 0.99 * R, 0.0, -0.1 + 0.99 * R]])
        contacts = find_contacts(scene, 0.0, position, 2 * R, 0.01)
        assert contacts.wall.tolist() == contacts.other_piece.tolist() == [0, 1]
        still = torch.zeros(1, 3, dtype=torch.float64)
        assert len(see_contacts(torch.tensor(position), still, scene, 0.0, 1.2 * R).normal) == 2

    @pytest.mark.parametrize("jump", [1e-3, 2e-2])  # within the contact patch, and far past it
    def test_a_spring_goes_over_a_seam_as_along_one_tube(self, jump):
        whole = scene_with(Cylinder((0, 0, 0), X, 0.3, length=0.8), friction=0.5)
        pieces = scene_with(LEFT, RIGHT, friction=0.5)
        positions = np.zeros((6, 1, 3))
        positions[:, 0, 0] = (np.arange(6) - 2.5) * jump
        positions[:, 0, 2] = -0.3 + 0.96 * R
        # It rolls but for a slip of 0.02 mm a frame.
        spins = np.zeros((6, 1, 3))
        spins[:, 0, 1] = (jump - 2e-5) / (R * whole.frame_interval)
        expected, found = (
            [memory.spring for memory in follow_memory(scene, 0.01 * np.arange(6), positions, spins)]
            for scene in (whole, pieces)
        )
        assert [len(spring) for spring in found] == [0, 1, 1, 1, 1, 1]
        assert np.linalg.norm(found[-1]) > 1.5 * np.linalg.norm(found[2])
        for one, two in zip(expected[2:], found[2:], strict=True):
            np.testing.assert_allclose(two, one, rtol=1e-3, atol=1e-5)

    def test_a_scene_without_seams_asks_nobody(self, monkeypatch):
        def refuse(*_):
            raise AssertionError("no wall of this scene is a piece")

        for module in ("contact.geometry", "convolution.boundary"):
            monkeypatch.setattr(f"gran_bench.surrogate.{module}.one_contact_each", refuse)
        scene = scene_with(*box((-0.2, -0.2, 0.0), (0.2, 0.2, 0.4)))
        assert not scene.needs.wall_seams
        position = np.array([[0.0, 0.0, 0.99 * R]])
        contacts = find_contacts(scene, 0.0, position, 2 * R, 0.01)
        assert (contacts.other_piece == contacts.wall).all()
        see_contacts(torch.tensor(position), torch.zeros(1, 3, dtype=torch.float64), scene, 0.0, R)
