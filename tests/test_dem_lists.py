"""Lists of what may touch: complete within their margins, in one order, and with the history that belongs to each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gran_bench.config import ContainerConfig, FillingConfig, SceneConfig
from gran_bench.dem.fast.lists import LEAST_MARGIN, set_margins, sort_pairs
from gran_bench.dem.fast.wall_list import list_wall_contacts
from gran_bench.dem.integrate import LEAST_SKIN_DIAMETERS, SKIN_DIAMETERS, Physics
from gran_bench.dem.walls import COLUMNS, wall_contact, wall_poses
from gran_bench.scene import Vibration, build_scene


def bodies(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of spheres and velocities in a cube, and two spare ones."""
    rng = np.random.default_rng(0)
    sphere, velocity = np.zeros((count + 2, 4)), np.zeros((count + 2, 4))
    sphere[:, :3], sphere[:, 3] = rng.uniform(-0.2, 0.2, (count + 2, 3)), 0.01
    velocity[:, :3] = rng.normal(0.0, 1.0, (count + 2, 3))
    return sphere, velocity


def margins(sphere: np.ndarray, velocity: np.ndarray, skin: float) -> tuple[np.ndarray, ...]:
    found = np.empty(40), np.empty(40), np.empty((40, 4)), np.empty((40, 4))
    set_margins(sphere, velocity, skin, *found)
    return found


def test_the_fastest_has_half_the_skin_and_what_rests_a_fifth_of_that():
    sphere, velocity = bodies(40)
    velocity[3] = 0.0
    velocity[-2:] = 1e6  # spare ones do not count
    margin, inverse_square, at, reaching = margins(sphere, velocity, 0.03)
    speed = np.linalg.norm(velocity[:-2, :3], axis=1)
    assert margin == pytest.approx(0.015 * (LEAST_MARGIN + (1.0 - LEAST_MARGIN) * speed / speed.max()), rel=1e-14)
    assert margin[3] == 0.015 * LEAST_MARGIN
    assert inverse_square == pytest.approx(margin**-2, rel=1e-14)
    assert np.array_equal(at, sphere[:-2])
    assert np.array_equal(reaching[:, :3], sphere[:-2, :3])
    assert np.array_equal(reaching[:, 3], sphere[:-2, 3] + margin)
    margin, *_ = margins(sphere, np.zeros_like(velocity), 0.03)
    assert margin.tolist() == [0.015] * 40


@pytest.mark.parametrize(("begin", "end"), [(0, 30), (0, 12), (12, 30), (5, 5)])
def test_pairs_come_in_order_with_the_rows_of_those_that_touched(begin, end):
    rng = np.random.default_rng(1)
    every = np.array([(i, j) for i in range(30) for j in range(i + 1, 30)])
    pairs = rng.permutation(every[rng.random(len(every)) < 0.2]).astype(np.uint32)
    pairs = pairs[(begin <= pairs[:, 0]) & (pairs[:, 0] < end)]
    known = np.array([*pairs[::3].astype(np.int64), (0, 1), (13, 14)])  # the last may be no pair of this list
    room, start = np.full((3, len(pairs)), 99, np.uint32), np.full(end - begin + 2, 99, np.uint32)
    first, second, memory = room
    by_second = np.empty(len(pairs), np.uint32)
    sort_pairs(*pairs.T.copy(), by_second, begin, 30, *known.T.copy(), first, second, start, memory)
    expected = sorted(map(tuple, pairs.tolist()))
    assert list(zip(first.tolist(), second.tolist(), strict=True)) == expected
    rows = {tuple(pair): row for row, pair in enumerate(known.tolist(), 1)}
    assert memory.tolist() == [rows.get(pair, 0) for pair in expected]
    for i in range(begin, end):
        assert first[start[i - begin] : start[i - begin + 1]].tolist() == [p[0] for p in expected if p[0] == i]


@pytest.mark.parametrize(("chunk", "stop"), [(0, 2), (0, 1), (1, 2)])
def test_walls_in_reach_come_chunk_by_chunk_and_remember_what_touched(chunk, stop):
    scene = build_scene(
        SceneConfig(container=ContainerConfig(diameter=0.5, length=0.45), filling=FillingConfig(count=5))
    )
    scene = replace(scene, walls=tuple(replace(w, motion=Vibration(1e-3, 20.0, (0.0, 0.6, 0.8))) for w in scene.walls))
    walls = np.array(wall_poses(scene, 0.0, 1e-4, 50))
    (sphere, _), bounds, margin = bodies(200), np.array([0, 90, 200]), np.linspace(0.0, 0.02, 200)
    contacts = [(7, 1), (150, 0), (150, 2), (20, 9)]  # of the last wall nobody knows any more
    path = walls[11:, :, 20].sum(axis=0)
    wall_i, wall_w, memory = np.full((3, 200 * 3 + 2), 99, np.uint32)
    start, touched = np.full((stop - chunk) * 3 + 1, 99), np.full(5, 99, np.uint32)
    found = list_wall_contacts(
        sphere, bounds, chunk, stop, walls[10], path, margin, *np.array(contacts).T.copy(),
        wall_i, wall_w, memory, start, touched,
    )  # fmt: skip
    assert (path > 0.0).all()
    expected = [
        (i, w)
        for c in range(chunk, stop)
        for w in range(len(scene.walls))
        for i in range(bounds[c], bounds[c + 1])
        if wall_contact(walls[10, w], sphere[i : i + 1, :3])[0][0] - sphere[i, 3] < margin[i] + path[w]
    ]
    assert list(zip(wall_i[1:found].tolist(), wall_w[1:found].tolist(), strict=True)) == expected
    assert [wall_i[0], wall_w[0], memory[0]] == [200, 0, 0]
    rows = {contact: row for row, contact in enumerate(contacts, 1)}
    assert memory[1:found].tolist() == [rows.get(contact, 0) for contact in expected]
    assert all(touched[row] == place for place, row in enumerate(memory[1:found].tolist(), 1) if row)
    assert start[0] == 1
    assert start[-1] == found
    assert len(start) == (stop - chunk) * len(scene.walls) + 1


def test_without_walls_only_the_spare_place_is_there():
    (sphere, _), nothing = bodies(9), np.zeros(0, np.int64)
    wall_i, wall_w, memory = np.full((3, 2), 99, np.uint32)
    start = np.zeros(1, np.int64)
    found = list_wall_contacts(
        sphere, np.array([0, 9]), 0, 1, np.zeros((0, COLUMNS)), np.zeros(0), np.ones(9), nothing, nothing,
        wall_i, wall_w, memory, start, np.zeros(1, np.uint32),
    )  # fmt: skip
    assert (found, wall_i[0], memory[0], start.tolist()) == (1, 9, 0, [1])


def test_a_period_too_short_for_the_usual_skin_gets_a_narrower_one_and_is_refused_below_a_least():
    def skin(length: float) -> float:
        container = ContainerConfig(length=length, periodic_axis=True)
        return Physics.of(build_scene(SceneConfig(container=container, filling=FillingConfig(count=5))), 0.025).skin

    diameter = 0.05
    assert skin(1.0) == pytest.approx(SKIN_DIAMETERS * diameter)
    assert skin(0.14) == pytest.approx(0.02)  # half the period is the reach of a pair: a diameter and the skin
    assert skin(0.106) == pytest.approx(0.003)
    assert skin(0.106) > LEAST_SKIN_DIAMETERS * diameter
    with pytest.raises(ValueError, match="shorter than twice the reach"):
        skin(0.104)
