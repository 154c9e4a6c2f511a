"""The contact network's vectors of sixteen lanes against NumPy."""

import numpy as np
import pytest
from numba import njit

from gran_bench.surrogate.contact.kernels.lanes import LANES, WIDTH, gathering, layer, outer, scattering

FIRST, SECOND, ROWS = [0.5, -1.0, 2.0], [-0.5, 1.0, 3.0], [4, 1, 7]
gather_pairs, gather_walls = gathering(ROWS, FIRST, SECOND), gathering(ROWS, FIRST, None)
scatter_pairs, scatter_walls = scattering(ROWS, FIRST, SECOND), scattering(ROWS, FIRST, None)
hidden, output = layer(0, 5, 8, 9, (5, 1), "rectified"), layer(0, 5, 8, 9, (5, 1), "biased")
back, masked = layer(0, 5, 8, 9, (1, 9), "masked"), layer(0, 5, 8, 9, (1, 9), "masked")
products = outer(0, 16, 9)


@njit
def all_of_them(b, body, gained, contacts, begin, last, spare, weight, bias, results, sums, totals):
    """Each intrinsic once, on lanes from 16 on."""
    place = WIDTH
    for k in range(len(results)):
        results[k, :] = b
    gather_pairs(results[0], place, body, contacts, begin, last)
    gather_walls(results[1], place, body, contacts, begin, last)
    scatter_pairs(gained[0], contacts, begin, last, spare, b, place)
    scatter_walls(gained[1], contacts, begin, last, spare, b, place)
    hidden(results[2], place, weight, bias)
    output(results[3], place, weight, bias)
    back(results[4], place, weight, None)
    masked(results[5], place, weight, 20)
    products(b, place, sums, totals)


@pytest.fixture(scope="module")
def found():
    """What goes in and what comes out."""
    rng = np.random.default_rng(0)
    normal = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    b, body, contacts = normal(32, LANES), normal(40, WIDTH), rng.integers(0, 39, (60, 2))
    gained, results, sums = np.zeros((2, 40, WIDTH), np.float32), np.zeros((6, b.size), np.float32), normal(10, WIDTH)
    weight, bias, before = normal(45), normal(9), sums.copy()
    all_of_them(b.ravel(), body, gained, contacts, 20, 46, 39, weight, bias, results, sums[:9].ravel(), sums[9])
    return b, body, contacts, gained, results.reshape(6, 32, LANES), weight, bias, before, sums


def test_rows_of_two_particles_are_gathered_into_columns_and_more_repeat_the_last(found):
    b, body, contacts, _, results, *_ = found
    i, j = contacts[np.minimum(np.arange(36, 52), 45)].T
    of_first, of_second = (body[:, :3] * np.float32(factors) for factors in (FIRST, SECOND))
    expected = of_first[i] + of_second[j], of_first[i]
    for result, columns in zip(results, expected, strict=False):
        assert np.allclose(result[ROWS, WIDTH:].T, columns, rtol=1e-6, atol=1e-7)
        assert np.array_equal(result[ROWS, :WIDTH], b[ROWS, :WIDTH])
        others = np.setdiff1d(np.arange(32), ROWS)
        assert np.array_equal(result[others], b[others])


def test_columns_are_scattered_to_two_particles_and_spare_lanes_beyond_all(found):
    b, _, contacts, gained, *_ = found
    values = b[ROWS, WIDTH : WIDTH + 10].T  # of the contacts 36 … 45
    for ends, gain in zip((2, 1), gained, strict=True):
        expected = np.zeros((40, WIDTH))
        for particles, factors in zip(contacts[36:46].T[:ends], (FIRST, SECOND), strict=False):
            np.add.at(expected[:, :3], particles, values * factors)
        assert np.allclose(gain[:39], expected[:39], rtol=1e-5, atol=1e-6)
        assert gain[39, :3].any()


def test_layers_are_matrix_products(found):
    b, _, _, _, results, weight, bias, *_ = found
    rows = b[:5, WIDTH:]
    forward, backward = weight.reshape(9, 5) @ rows + bias[:, None], weight.reshape(5, 9).T @ rows
    expected = np.maximum(forward, 0.0), forward, backward, np.where(b[20:29, WIDTH:] > 0.0, backward, 0.0)
    for result, sums in zip(results[2:], expected, strict=True):
        assert np.allclose(result[8:17, WIDTH:], sums, rtol=1e-5, atol=1e-5)


def test_products_are_summed_over_lanes(found):
    b, *_, before, sums = found
    assert np.allclose(sums[:-1] - before[:-1], b[16:25, WIDTH:] @ b[:16, WIDTH:].T, rtol=1e-5, atol=1e-5)
    assert np.allclose(sums[-1] - before[-1], b[:16, WIDTH:].sum(1), rtol=1e-5, atol=1e-5)
