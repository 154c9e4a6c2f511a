"""The tree and the cell list find the same pairs: all of them, each once, whatever the geometry."""

from __future__ import annotations

import numpy as np
import pytest
from beds import every_neighbor

from gran_bench.neighbors import cell_neighbors, cells, list_pairs, tree_pairs


def cell_pairs(position, reach, period=0.0):
    """What the fast list finds, as the tree would say it."""
    first, second = list_pairs(np.column_stack((position, np.zeros(len(position)))), reach, period)
    return np.array(sorted(zip(first.tolist(), second.tolist(), strict=True)), np.int64).reshape(-1, 2)


def brute_force(position, reach, period):
    """All pairs by looking at all of them."""
    found = []
    for i in range(len(position)):
        for j in range(i + 1, len(position)):
            offset = position[j] - position[i]
            if period:
                offset[1] -= period * np.round(offset[1] / period)
            if offset @ offset < reach**2:
                found.append((i, j))
    return np.array(found, np.int64).reshape(-1, 2)


@pytest.mark.parametrize("search", [tree_pairs, cell_pairs])
@pytest.mark.parametrize("period", [0.0, 1.0])
@pytest.mark.parametrize("reach", [0.05, 0.2, 0.34, 0.49])
def test_pairs_are_those_of_brute_force(search, period, reach):
    position = np.random.default_rng(0).uniform(-0.5, 0.5, (120, 3))
    assert np.array_equal(search(position, reach, period), brute_force(position, reach, period))


@pytest.mark.parametrize("search", [tree_pairs, cell_pairs])
def test_a_pair_through_the_periodic_face_is_found_wherever_y_is_wrapped(search):
    position = np.array([[0.0, -0.49, 0.0], [0.0, 0.49, 0.0], [0.0, 1.51, 0.5]])
    assert search(position, 0.1).tolist() == []
    assert search(position, 0.1, 1.0).tolist() == [[0, 1]]


@pytest.mark.parametrize("search", [tree_pairs, cell_pairs])
@pytest.mark.parametrize("count", [0, 1])
def test_too_few_points_have_no_pairs(search, count):
    assert search(np.zeros((count, 3)), 0.1).shape == (0, 2)


@pytest.mark.parametrize("search", [tree_pairs, cell_pairs])
def test_a_distance_of_exactly_the_reach_is_no_pair(search):
    position = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    assert len(search(position, 0.5)) == 0
    assert len(search(position, np.nextafter(0.5, 1.0))) == 1


@pytest.mark.parametrize("search", [tree_pairs, lambda x, reach, period: cell_neighbors(x, x, reach, period)])
def test_a_period_in_which_images_are_ambiguous_is_refused(search):
    with pytest.raises(ValueError, match="shorter than twice the reach"):
        search(np.zeros((2, 3)), 0.3, 0.5)


def test_a_particle_far_away_does_not_cost_a_grid_of_empty_cells():
    position = np.vstack((np.random.default_rng(1).uniform(0, 1, (50, 3)), [[1e6, -1e6, 1e6]]))
    assert np.array_equal(cell_pairs(position, 0.2), brute_force(position, 0.2, 0.0))


def test_all_points_in_one_place_are_all_pairs():
    # More pairs than the first guess of the list's room.
    position = np.full((60, 3), 0.25)
    assert len(cell_pairs(position, 0.1)) == 60 * 59 // 2


@pytest.mark.parametrize("period", [0.0, 1.0])
def test_a_list_that_starts_with_too_little_room_grows(monkeypatch, period):
    rng = np.random.default_rng(4)
    position, query = rng.uniform(-0.5, 0.5, (300, 3)), rng.uniform(-0.5, 0.5, (60, 3))
    expected = cell_pairs(position, 0.2, period), *cell_neighbors(query, position, 0.2, period)
    filled, calls = cells._filled, []

    def from_one_place(dtype, room, fill):
        return filled(dtype, 1, lambda *lists: calls.append(0) or fill(*lists))

    monkeypatch.setattr(cells, "_filled", from_one_place)
    found = cell_pairs(position, 0.2, period), *cell_neighbors(query, position, 0.2, period)
    assert len(calls) > 6
    for wanted, got in zip(expected, found, strict=True):
        assert np.array_equal(wanted, got)


@pytest.mark.parametrize("place", [np.nan, np.inf, 1e308])
def test_positions_without_a_finite_span_are_refused(place):
    position = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, place], [-place, 0.0, 0.0]])
    with pytest.raises(ValueError, match="must be finite"):
        cell_pairs(position, 0.1)


def test_the_half_list_counts_distances_between_surfaces():
    sphere = np.array([[0, 0, 0, 0.1], [0.35, 0, 0, 0.2], [0, 0.25, 0, 0.1]], float)
    first, second = list_pairs(sphere, 0.06, 0.0)
    assert sorted(zip(first.tolist(), second.tolist(), strict=True)) == [(0, 1), (0, 2)]


@pytest.mark.parametrize("period", [0.0, 1.0])
def test_every_source_of_every_query_is_listed(period):
    rng = np.random.default_rng(2)
    query, source = rng.uniform(-0.5, 0.5, (40, 3)), rng.uniform(-0.5, 0.5, (90, 3))
    found = sorted(zip(*map(list, cell_neighbors(query, source, 0.3, period)), strict=True))
    assert found == list(zip(*every_neighbor(query, source, 0.3, period), strict=True))


def test_neighbors_have_no_cap_and_count_a_point_as_its_own():
    cloud = np.random.default_rng(3).uniform(0, 0.01, (300, 3))
    query, source = cell_neighbors(cloud, cloud, 0.1)
    assert len(query) == 300 * 300
    assert np.count_nonzero(query == source) == 300


def test_neighbors_of_nothing_are_none():
    for query, source in ((0, 3), (3, 0)):
        assert [len(part) for part in cell_neighbors(np.zeros((query, 3)), np.zeros((source, 3)), 1.0)] == [0, 0]
