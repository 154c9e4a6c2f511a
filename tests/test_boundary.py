"""Walls as a convolutional surrogate sees them: spheres on the surface, and analytic closest points."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gran_bench.config import SceneConfig
from gran_bench.neighbors import tree_neighbors
from gran_bench.scene import Cylinder, Plane, Rotation, build_scene
from gran_bench.surrogate.boundary import closest_point, see_contacts, see_spheres, wall_spheres, wall_velocity

REACH, SPACING = 0.1125, 0.025


def drum(periodic=False, length=1.0, rpm=30.0):
    config = SceneConfig(name="test")
    config.container.periodic_axis, config.container.length = periodic, length
    return build_scene(config).at_speed(rpm)


def inside_drum(count, seed, length=1.0):
    """Centres anywhere in the drum, a radius away from the walls."""
    rng = np.random.default_rng(seed)
    radius, angle = 0.475 * np.sqrt(rng.random(count)), rng.uniform(0, 2 * math.pi, count)
    y = rng.uniform(-0.5, 0.5, count) * (length - 0.05)
    return torch.from_numpy(np.stack((radius * np.cos(angle), y, radius * np.sin(angle)), axis=1))


def test_wall_spheres_lie_on_the_walls_with_normals_into_the_drum():
    scene = drum()
    cover = wall_spheres(scene, SPACING)
    for index, wall in enumerate(scene.walls):
        mine = torch.from_numpy(cover.position[cover.wall == index])
        distance, normal = closest_point(wall, mine)
        assert distance.abs().max() < 1e-12
        assert torch.allclose(normal, torch.from_numpy(cover.normal[cover.wall == index]))
        assert mine.norm(dim=1).max() <= math.hypot(0.5, 0.5)
        assert mine[:, 1].abs().max() <= 0.5 + 1e-12
    assert 7000 < len(cover.position) < 8000  # about area / spacing²


@pytest.mark.parametrize("periodic", [False, True])
def test_wall_spheres_are_about_a_spacing_apart_across_the_seam_too(periodic):
    scene = drum(periodic, length=0.2)
    cover = wall_spheres(scene, SPACING, beyond=REACH)
    barrel = cover.position[cover.wall == 0]
    middle = barrel[np.abs(barrel[:, 1]) <= 0.1]
    query, _ = tree_neighbors(middle, barrel, 0.9 * SPACING)
    assert len(query) == len(middle)  # nobody but itself
    _, near = tree_neighbors(middle, barrel, 1.6 * SPACING)
    assert len(near) > 5 * len(middle)  # and no hole beside it
    beyond = barrel[barrel[:, 1] > 0.1]
    _, image = tree_neighbors(beyond - (0.0, 0.2, 0.0), middle, 1e-9)
    assert len(image) == len(beyond)  # the cover goes on as the next period begins
    assert bool(len(beyond)) is periodic


def test_wall_spheres_need_walls_with_an_end_and_a_spacing():
    endless = replace(drum(), drum_radius=None)
    with pytest.raises(ValueError, match=r"boundary\.kind=analytic"):
        wall_spheres(endless, SPACING)
    with pytest.raises(ValueError, match=r"boundary\.spacing"):
        wall_spheres(drum(), 0.0)
    assert len(wall_spheres(replace(drum(), walls=()), SPACING).position) == 0


def test_closest_points_of_cylinder_and_plane():
    point = torch.tensor([[0.3, 0.2, -0.4], [0.0, 0.0, 0.0], [0.6, 0.0, 0.0]], dtype=torch.float64)
    distance, normal = closest_point(Cylinder((0, 0, 0), (0, 1, 0), 0.5), point)
    assert torch.allclose(distance, torch.tensor([0.0, 0.5, -0.1], dtype=torch.float64))
    assert torch.allclose(normal, torch.tensor([[-0.6, 0, 0.8], [0, 0, 0], [-1, 0, 0]], dtype=torch.float64))
    distance, normal = closest_point(Plane((0, -0.5, 0), (0, 1, 0)), point)
    assert torch.allclose(distance, torch.tensor([0.7, 0.5, 0.5], dtype=torch.float64))
    assert torch.equal(normal[0], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))


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
    assert torch.equal(pairs.source.unique(), torch.arange(pairs.source_count))
    cover = wall_spheres(scene, SPACING, beyond=REACH)
    query, sphere = tree_neighbors(position.numpy(), cover.position, REACH)
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
