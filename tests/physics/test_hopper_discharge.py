"""The flow out of a hopper: the fit of Beverloo's law, and a small hopper that obeys it roughly."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from hopper_discharge import bulk_density, discharge, hopper, power_law


def test_the_exponent_of_an_exact_law_is_found_without_error():
    opening = np.array([0.05, 0.07, 0.1, 0.13])
    exponent, error = power_law(opening, 3.0 * opening**2.5, np.zeros(4))
    assert exponent == pytest.approx(2.5, abs=1e-12)
    assert error == pytest.approx(0.0, abs=1e-10)


def test_the_error_of_the_exponent_is_at_least_what_the_flows_errors_make_of_it():
    opening, rng = np.array([0.05, 0.07, 0.1, 0.13]), np.random.default_rng(0)
    flow = opening**2.5
    _, stated = power_law(opening, flow, 0.02 * flow)
    found = [power_law(opening, flow * (1 + 0.02 * rng.normal(size=4)), 0 * flow)[0] for _ in range(2000)]
    assert stated == pytest.approx(np.std(found), rel=0.05)


def test_the_bulk_density_of_a_lattice_is_its_own():
    scene = hopper(8.0, diameter=0.02, tube=200.0)
    line = (np.arange(-150, 151)) * 0.022
    low = scene.room.lower[2]
    x, y, z = np.meshgrid(line, line, low - 0.2 + np.arange(60) * 0.022, indexing="ij")
    position = np.stack((x, y, z), -1).reshape(-1, 3)
    position = position[np.hypot(position[:, 0], position[:, 1]) < scene.room.radius]
    expected = 2500.0 * np.pi / 6 * (0.02 / 0.022) ** 3
    assert bulk_density(scene, position) == pytest.approx(expected, rel=0.03)


def test_a_narrow_hopper_empties_faster_through_a_wider_orifice():
    # A few hundred spheres: too few for the exponent, which the whole verification measures.
    result = discharge((6.0, 8.0), count=700, tube=14.0)
    assert result.flow[1] > 1.4 * result.flow[0]
    assert 0.3 < result.factor < 0.9
    assert 1200 < result.bulk_density < 1700
