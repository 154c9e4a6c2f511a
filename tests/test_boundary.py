"""Walls as a convolutional surrogate sees them: spheres on the surface, and analytic closest points."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from beds import every_neighbor
from contact_beds import furnished

from gran_bench.config import SceneConfig
from gran_bench.dem.walls import surface_velocity, wall_contact, wall_poses
from gran_bench.scene import Disc, Plane, Rotation, Translation, build_scene
from gran_bench.surrogate.convolution.boundary import see_contacts, see_spheres, wall_spheres
from gran_bench.surrogate.walls import closest_point, frame_walls, wall_velocity

REACH, SPACING = 0.1125, 0.025


def drum(periodic=False, length=1.0, rpm=30.0):
    config = SceneConfig(name="test")
    config.container.periodic_axis, config.container.length = periodic, length
    return build_scene(config).at_speed(rpm)


def covered(scene, spacing=SPACING, beyond=0.0):
    """The scene's walls under points, in a box of 2 m."""
    return wall_spheres(scene, frame_walls(scene, 1.49).after, spacing, -np.ones(3), np.ones(3), beyond)


def inside_drum(count, seed, length=1.0):
    """Centres anywhere in the drum, a radius away from the walls."""
    rng = np.random.default_rng(seed)
    radius, angle = 0.475 * np.sqrt(rng.random(count)), rng.uniform(0, 2 * math.pi, count)
    y = rng.uniform(-0.5, 0.5, count) * (length - 0.05)
    return torch.from_numpy(np.stack((radius * np.cos(angle), y, radius * np.sin(angle)), axis=1))


def test_wall_spheres_lie_on_the_walls_with_normals_into_the_drum():
    scene = drum()
    cover = covered(scene)
    for index, shape in enumerate(frame_walls(scene, 1.5).after):
        mine = torch.from_numpy(cover.position[cover.wall == index])
        distance, toward = closest_point(shape, mine)
        assert distance.abs().max() < 1e-12
        assert torch.allclose(-toward, torch.from_numpy(cover.normal[cover.wall == index]))
        assert mine.norm(dim=1).max() <= math.hypot(0.5, 0.5)
        assert mine[:, 1].abs().max() <= 0.5 + 1e-12
    assert 7000 < len(cover.position) < 8000  # about area / spacing²


@pytest.mark.parametrize("periodic", [False, True])
def test_wall_spheres_are_about_a_spacing_apart_across_the_seam_too(periodic):
    scene = drum(periodic, length=0.2)
    cover = covered(scene, beyond=REACH)
    barrel = cover.position[cover.wall == 0]
    middle = barrel[np.abs(barrel[:, 1]) <= 0.1]
    query, _ = every_neighbor(middle, barrel, 0.9 * SPACING)
    assert len(query) == len(middle)  # nobody but itself
    _, near = every_neighbor(middle, barrel, 1.6 * SPACING)
    assert len(near) > 5 * len(middle)  # and no hole beside it
    beyond = barrel[barrel[:, 1] > 0.1]
    _, image = every_neighbor(beyond - (0.0, 0.2, 0.0), middle, 1e-9)
    assert len(image) == len(beyond)  # the cover goes on as the next period begins
    assert bool(len(beyond)) is periodic


def test_wall_spheres_need_a_spacing():
    with pytest.raises(ValueError, match=r"boundary\.spacing"):
        covered(drum(), 0.0)
    assert len(covered(replace(drum(), walls=())).position) == 0


def test_closest_points_are_those_of_the_dem_on_every_wall():
    position = np.random.default_rng(0).uniform(-0.6, 0.6, (500, 3))
    position[:3] = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.3], [0.0, 0.0, 0.55]]  # on axes
    scene = furnished()
    for time in (1.0, 1.595):
        poses, walls = wall_poses(scene, time, scene.frame_interval, 1), frame_walls(scene, time)
        for pose, shape in zip((*poses[0], *poses[1]), (*walls.before, *walls.after), strict=True):
            expected = wall_contact(pose, position)
            found = closest_point(shape, torch.from_numpy(position))
            assert all(np.allclose(e, f.numpy(), atol=1e-12) for e, f in zip(expected, found, strict=True))


def test_closest_points_are_differentiable_on_every_wall():
    position = torch.from_numpy(np.random.default_rng(1).uniform(-0.6, 0.6, (30, 3))).requires_grad_()
    for shape in frame_walls(furnished(), 1.49).after:
        assert torch.autograd.gradcheck(lambda x, shape=shape: closest_point(shape, x), position, fast_mode=True)


def test_a_frame_moves_the_material_of_every_wall_exactly():
    scene, parts = furnished(), 20000
    fine = wall_poses(scene, 1.5, scene.frame_interval / parts, parts)
    walls = frame_walls(scene, 1.5)
    for index in range(len(scene.walls)):
        point = np.array([0.2, -0.1, 0.3])
        for pose in fine[1:, index]:  # a point of the wall, followed in small steps
            point = point + scene.frame_interval / parts * surface_velocity(pose, point[None])[0]
        moved = walls.turn[index] @ point + walls.shift[index]
        assert np.allclose(moved, point - (0.2, -0.1, 0.3), atol=1e-7)


def test_wall_spheres_cover_every_wall_on_both_of_its_sides():
    scene = furnished()
    shapes, cover = frame_walls(scene, 1.49).after, covered(scene)
    assert set(cover.wall) == set(range(len(scene.walls)))
    for index, shape in enumerate(shapes):
        mine = cover.wall == index
        points, normal = torch.from_numpy(cover.position[mine]), torch.from_numpy(cover.normal[mine])
        distance, _ = closest_point(shape, points)
        assert distance.abs().max() < 1e-12
        _, back = closest_point(shape, points + 1e-3 * normal)
        assert torch.allclose(back, -normal, atol=1e-6)
        # Nowhere in the box is the wall farther from its next point than a spacing.
        place = np.random.default_rng(2).uniform(-0.9, 0.9, (400, 3))
        distance, toward = (found.numpy() for found in closest_point(shape, torch.from_numpy(place)))
        touched = place + distance[:, None] * toward
        touched = touched[(np.abs(touched) < 0.9).all(axis=1)]
        query, _ = every_neighbor(touched, cover.position[mine], 1.05 * SPACING)
        assert len(np.unique(query)) == len(touched), index


def test_a_wall_with_two_sides_is_seen_from_the_particles_own():
    scene = replace(furnished(), walls=(Disc((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.3, turns=False),))
    position = torch.tensor([[0.1, 0.0, 0.03], [0.1, 0.0, -0.03]], dtype=torch.float64)
    for pairs in (
        see_spheres(position, scene, 1.5, REACH, SPACING),
        see_contacts(position, torch.zeros_like(position), scene, 1.5, REACH),
    ):
        side = pairs.normal[pairs.source][:, 2]
        assert side[pairs.query == 0].eq(1.0).all()
        assert side[pairs.query == 1].eq(-1.0).all()
        assert set(pairs.query.tolist()) == {0, 1}
        assert pairs.distance.tolist() == pytest.approx([0.03, 0.03])


def test_a_wall_is_seen_where_it_is_when_the_frame_ends_and_no_more_when_it_is_gone():
    lid = Disc((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.3, turns=False, opens=1.6)
    floor = Plane((0.0, 0.0, -0.05), (0.0, 0.0, 1.0), motion=Translation((1.0, 1.0), ((0, 0, 0), (0, 0, 0.5))))
    scene = replace(furnished(), walls=(lid, floor))
    position = torch.tensor([[0.0, 0.0, 0.05]], dtype=torch.float64)
    first = see_contacts(position, torch.zeros_like(position), scene, 1.0, REACH)
    assert first.relative.tolist() == [[0.0, 0.0, -0.05], [0.0, 0.0, pytest.approx(-0.095)]]
    assert first.velocity.tolist() == [[0.0, 0.0, 0.0], [0.0, 0.0, pytest.approx(0.5)]]
    assert len(see_contacts(position, torch.zeros_like(position), scene, 1.6, 1.0).query) == 1


def test_the_bottom_of_the_drum_moves_towards_minus_x_with_its_mean_speed_over_the_frame():
    scene = drum(rpm=30.0)
    bottom = torch.tensor([[0.0, 0.1, -0.5]], dtype=torch.float64)
    omega = math.pi
    assert torch.allclose(
        wall_velocity(scene.walls[0], bottom, scene, 1.5), torch.tensor([[-0.5 * omega, 0, 0]], dtype=torch.float64)
    )
    assert not wall_velocity(scene.walls[0], bottom, scene, 1.0).any()  # before it turns
    half = wall_velocity(scene.walls[0], bottom, scene, 1.495)  # turns for half of this frame
    assert float(half[0, 0]) == pytest.approx(-0.25 * omega)
    ramp = replace(scene, rotation=Rotation((1.5, 2.5), (0.0, 60.0)))
    assert float(wall_velocity(scene.walls[0], bottom, ramp, 2.0)[0, 0]) == pytest.approx(-0.5 * omega * 1.01)
    assert not wall_velocity(replace(scene.walls[0], turns=False), bottom, scene, 1.5).any()


@pytest.mark.parametrize("periodic", [False, True])
def test_spheres_seen_are_all_within_reach_and_no_others(periodic):
    length = 0.2 if periodic else 1.0
    scene = drum(periodic, length)
    position = inside_drum(300, seed=0, length=length + (0.05 if periodic else 0.0))
    pairs = see_spheres(position, scene, 1.5, REACH, SPACING)
    assert pairs.relative.norm(dim=1).max() < REACH
    assert torch.equal(pairs.source.unique(), torch.arange(len(pairs.normal)))
    cover = covered(scene, beyond=REACH)
    query, sphere = every_neighbor(position.numpy(), cover.position, REACH)
    seen = torch.stack((pairs.near[pairs.query].double(), *pairs.relative.T), dim=1)
    expected = np.column_stack((query, cover.position[sphere] - position.numpy()[query]))
    order, other = np.lexsort(np.round(seen.numpy(), 9).T), np.lexsort(np.round(expected, 9).T)
    assert np.allclose(seen.numpy()[order], expected[other], atol=1e-9)


def test_near_are_the_particles_closer_to_a_wall_than_the_reach():
    scene, position = drum(), inside_drum(500, seed=1)
    x, y, z = position.numpy().T
    expected = np.flatnonzero(np.minimum(0.5 - np.hypot(x, z), 0.5 - np.abs(y)) < REACH)
    assert see_spheres(position, scene, 1.5, REACH, SPACING).near.tolist() == expected.tolist()
    assert see_contacts(position, torch.zeros_like(position), scene, 1.5, REACH).near.tolist() == expected.tolist()


def test_a_particle_in_a_corner_has_one_contact_with_each_wall():
    scene = drum(rpm=30.0)
    position = torch.tensor([[0.0, 0.0, 0.0], [0.0, -0.46, -0.47]], dtype=torch.float64)
    velocity = torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]], dtype=torch.float64)
    pairs = see_contacts(position, velocity, scene, 1.5, REACH)
    assert pairs.near.tolist() == [1]
    assert pairs.query.tolist() == [0, 0]
    assert torch.allclose(pairs.relative, torch.tensor([[0, 0, -0.03], [0, -0.04, 0]], dtype=torch.float64))
    assert torch.allclose(pairs.normal, torch.tensor([[0, 0, 1.0], [0, 1.0, 0]], dtype=torch.float64))
    assert torch.allclose(pairs.gap, torch.tensor([0.005, 0.015], dtype=torch.float64) / 0.05)
    turning = torch.tensor([[-0.5 * math.pi, 0, 0], [-0.47 * math.pi, 0, 0]], dtype=torch.float64)
    assert torch.allclose(pairs.velocity, turning)
    assert torch.allclose(pairs.slip, turning - velocity[1])
