"""The vector moves of the fast engine do what the loops in their place would do."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from gran_bench.dem.fast import rows
from gran_bench.dem.fast.rows import BLOCK

FIRST_BODY, SECOND_BODY = np.array([1, 2, 2, 9], np.uint32), np.array([0, 3, 4, 5], np.uint32)
FIRST, PLACE = 4, 8  # columns 4 … 7, lanes 8 … 11


@pytest.fixture
def body() -> np.ndarray:
    """Ten rows of four."""
    return np.random.default_rng(0).normal(size=(10, 4))


@pytest.fixture(params=[np.float64, np.float32])
def buffer(request) -> np.ndarray:
    """Twelve columns of noise."""
    return np.random.default_rng(1).normal(size=12 * BLOCK).astype(request.param)


def lanes(buffer: np.ndarray) -> np.ndarray:
    """Columns 4 … 7 at lanes 8 … 11, as one row a lane."""
    return buffer.reshape(-1, BLOCK)[FIRST : FIRST + 4, PLACE : PLACE + 4].T


def outside(buffer: np.ndarray) -> np.ndarray:
    """Everything else."""
    rest = buffer.copy().reshape(-1, BLOCK)
    rest[FIRST : FIRST + 4, PLACE : PLACE + 4] = 0.0
    return rest


gather_difference = njit(lambda b, a, i, j: rows.gather_difference(b, 4, 8, a, i, j))
gather_sum = njit(lambda b, a, i, j: rows.gather_sum(b, 4, 8, a, i, j))
gather_rows = njit(lambda b, a, i, j: rows.gather_rows(b, 4, 8, a, i))
scatter_opposite = njit(lambda b, a, i, j: rows.scatter_opposite(a, i, j, b, 4, 8))
scatter_both = njit(lambda b, a, i, j: rows.scatter_both(a, i, j, b, 4, 4, 8))
scatter_sum = njit(lambda b, a, i, j: rows.scatter_sum(a, i, b, 4, 8))
scatter_rows = njit(lambda b, a, i, j: rows.scatter_rows(a, j, b, 4, 8))


@pytest.mark.parametrize(
    ("gather", "expected"),
    [
        (gather_difference, lambda body: body[FIRST_BODY] - body[SECOND_BODY]),
        (gather_sum, lambda body: body[FIRST_BODY] + body[SECOND_BODY]),
        (gather_rows, lambda body: body[FIRST_BODY]),
    ],
    ids=["difference", "sum", "rows"],
)
def test_rows_become_columns(gather, expected, body, buffer):
    rest = outside(buffer)
    gather(buffer, body, tuple(FIRST_BODY), tuple(SECOND_BODY))
    assert np.array_equal(lanes(buffer), expected(body).astype(buffer.dtype))
    assert np.array_equal(outside(buffer), rest)


@pytest.mark.parametrize(
    ("scatter", "second"),
    [(scatter_opposite, -1.0), (scatter_both, 1.0), (scatter_sum, 0.0)],
    ids=["opposite", "both", "sum"],
)
def test_columns_are_added_to_rows_contact_after_contact(scatter, second, body, buffer):
    expected = body.copy()
    for lane, (i, j) in enumerate(zip(FIRST_BODY, SECOND_BODY, strict=True)):  # row 2 is met twice
        expected[i] += lanes(buffer)[lane]
        expected[j] += second * lanes(buffer)[lane]
    scatter(buffer, body, tuple(FIRST_BODY), tuple(SECOND_BODY))
    assert np.array_equal(body, expected)


def test_columns_become_rows(body, buffer):
    expected = body.copy()
    expected[SECOND_BODY] = lanes(buffer)
    scatter_rows(buffer, body, tuple(FIRST_BODY), tuple(SECOND_BODY))
    assert np.array_equal(body, expected)


def test_a_squared_gap_is_negative_where_spheres_overlap(body):
    gap = njit(lambda sphere, i, j: rows.squared_gap(sphere, i, j))
    sphere = np.abs(body)
    for i, j in zip(FIRST_BODY, SECOND_BODY, strict=True):
        distance = np.linalg.norm(sphere[i, :3] - sphere[j, :3])
        expected = distance**2 - (sphere[i, 3] + sphere[j, 3]) ** 2
        assert gap(sphere, i, j) == pytest.approx(expected, rel=1e-12, abs=1e-12)


def test_a_contact_remembers_its_last_evaluation_alone():
    @njit
    def remembered(memory, places, touched, end):
        return rows.four_remembered(memory, rows.four_from(places, 0), touched, end)

    memory = np.array([0, 3, 1, 2, 4, 5], np.uint32)  # row in which each place last touched, 0 for never
    touched = np.array([0, 2, 4, 1, 4, 5], np.uint32)  # place of each row
    # Place 1 is still in its row; place 3 lost it to another; rows 4 and 5 are of an older evaluation.
    assert remembered(memory, np.array([1, 3, 4, 5], np.uint32), touched, 4) == (3, 0, 0, 0)
    assert remembered(memory, np.array([0, 2, 1, 5], np.uint32), touched, 6) == (0, 1, 3, 5)


def test_a_kick_closes_a_step_and_opens_the_next_as_two_kicks_would(body):
    kick = njit(lambda body, load, i, c, ahead, o: rows.kick_row(body, load, i, 1.0, 2.0, 3.0, c, ahead, o))
    load, ahead, before = np.ones((10, 4)), np.zeros((10, 4)), body.copy()
    load[:, 3] = 0.0
    kick(body, load, 3, 0.5, ahead, 0.25)
    acceleration = before[3, 3] * np.array([1.0, 1.0, 1.0]) + [1.0, 2.0, 3.0]
    whole = before[3, :3] + 0.5 * acceleration
    assert np.array_equal(body[3, :3], whole + 0.25 * acceleration)
    assert np.array_equal(ahead[3, :3], 0.25 * acceleration)
    assert body[3, 3] == before[3, 3]
    assert not load[3].any()
    assert np.array_equal(np.delete(body, 3, axis=0), np.delete(before, 3, axis=0))
    # NumPy rounds as the kick does, so that half of one can be taken apart from the other.
    two, load = before.copy(), np.ones((10, 4))
    load[:, 3] = 0.0
    kick(two, load, 3, 0.5, ahead, 0.0)
    assert np.array_equal(two[3, :3], whole)


def test_a_drift_moves_a_centre_and_keeps_the_radius(body):
    drift = njit(lambda sphere, velocity, i, dt: rows.drift_row(sphere, velocity, i, dt))
    before, velocity = body.copy(), np.arange(40.0).reshape(10, 4)
    drift(body, velocity, 3, 0.3)
    assert np.array_equal(body[3, :3], before[3, :3] + 0.3 * velocity[3, :3])
    assert body[3, 3] == before[3, 3]
    assert np.array_equal(np.delete(body, 3, axis=0), np.delete(before, 3, axis=0))
