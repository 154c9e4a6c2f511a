"""What a stretch makes of a state and gives back: rows in order, constants of contacts, places in a period."""

from __future__ import annotations

import numpy as np
import pytest

from gran_bench.dem.fast import contact_blocks as blocks
from gran_bench.dem.fast.bodies import Bodies, as_given, bodies_in_order
from gran_bench.dem.integrate import into_period


def back_from(bodies: Bodies, half: float = 0.0, gravity: float = 0.0) -> tuple[np.ndarray, ...]:
    """The bodies in the order in which they were given, in two chunks that pull and twist."""
    count = len(bodies.order)
    bounds, loads = np.array([0, count // 2, count]), np.zeros((2, 2, count + 2, 4))
    loads[:, 0, : count // 2, :3], loads[:, 1, count // 2 : count, :3] = 1.0, 2.0
    found = np.empty((3, count, 3))
    as_given(bodies.order, bounds, *bodies[2:5], *loads, np.array([0.0, 0.0, -gravity]), half, *found)
    return tuple(found)


@pytest.mark.parametrize("count", [1, 2, 57])
@pytest.mark.parametrize("period", [0.0, 0.3])
def test_particles_come_back_as_they_were_given(count, period):
    rng = np.random.default_rng(0)
    given = position, velocity, spin = rng.uniform(-0.1, 0.1, (3, count, 3))
    radius, material = rng.uniform(0.01, 0.02, count), rng.integers(0, 2, count).astype(np.uint8)
    bodies = bodies_in_order(position, velocity, spin, radius, material, np.array([2500.0, 1000.0]), period)
    for back, wanted in zip(back_from(bodies), given, strict=True):
        assert np.array_equal(back, wanted)
        assert back.flags.c_contiguous
    assert np.array_equal(bodies.order[bodies.row], np.arange(count))
    assert np.array_equal(bodies.sphere[:-2, 3], radius[bodies.order])
    assert np.array_equal(bodies.material[:-2], material[bodies.order])


def test_velocities_get_what_is_left_of_their_step():
    rng = np.random.default_rng(0)
    position, velocity, spin = rng.uniform(-0.1, 0.1, (3, 9, 3))
    radius = rng.uniform(0.01, 0.02, 9)
    bodies = bodies_in_order(position, velocity, spin, radius, np.zeros(9, np.uint8), np.array([2500.0]), 0.0)
    _, rates, spins = back_from(bodies, half=1e-3, gravity=9.81)
    load, mass = np.where(bodies.row < 4, 1.0, 2.0)[:, None], 4.0 / 3.0 * np.pi * 2500.0 * radius[:, None] ** 3
    assert rates == pytest.approx(velocity + 1e-3 * (load / mass - [0.0, 0.0, 9.81]), rel=1e-13)
    assert spins == pytest.approx(spin + 1e-3 * load / (0.4 * mass * radius[:, None] ** 2), rel=1e-13)


def test_bodies_keep_nothing_of_the_arrays_that_they_come_from():
    arrays = [np.zeros((2, 3)) for _ in range(3)]
    bodies = bodies_in_order(*arrays, np.ones(2), np.zeros(2, np.uint8), np.ones(1), 0.0)
    for rows in (bodies.sphere, bodies.velocity, bodies.spin):
        rows += 1.0
    for back in back_from(bodies):
        back += 1.0
    assert not any(array.any() for array in arrays)
    assert (bodies.velocity[:-2, :3] == 1.0).all()


def test_what_lies_in_the_period_keeps_every_bit_and_the_rest_comes_into_it():
    period = 0.2
    inside = [-0.1, -1e-300, 0.0, 0.07, np.nextafter(0.1, 0.0)]
    outside = {0.1: -0.1, -0.11: 0.09, 0.35: -0.05, -0.3: -0.1, np.nextafter(-0.1, -1.0): None}
    position = np.zeros((10, 3))
    position[:, 1] = [*inside, *outside]
    found = into_period(position, period)[:, 1]
    assert found[:5].tolist() == inside
    assert (found >= -0.1).all()
    assert (found < 0.1).all()
    for place, wanted in zip(found[5:9], list(outside.values())[:4], strict=True):
        assert place == pytest.approx(wanted, abs=1e-15)
    far = np.array([[0.0, 7.0, 0.0]])
    assert into_period(far, 0.0)[0, 1] == 7.0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_block_buffer_holds_the_constants_of_equal_spheres(dtype):
    law = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    buffer = blocks.block_buffer(np.zeros(blocks.BUFFER_SIZE, dtype), 0.03, 7.0, law)
    wanted = {
        blocks.REACH: 0.06, blocks.SKEW: 0.0, blocks.RS: 0.015, blocks.MS: 1 / 14, blocks.INVERSE_MS: 14.0,
        blocks.INERTIA: 1.4 * 0.03 * 0.03 / 14, blocks.MODULUS: 1.0, blocks.SHEAR: 2.0, blocks.DAMPING: 3.0,
        blocks.FRICTION: 4.0, blocks.ROLLING: 5.0,
    }  # fmt: skip
    for first, value in wanted.items():
        assert buffer[first : first + blocks.BLOCK].tolist() == [dtype(value)] * blocks.BLOCK
    assert np.count_nonzero(buffer) == 10 * blocks.BLOCK
    buffer = blocks.wall_buffer(np.zeros(blocks.BUFFER_SIZE, dtype), 0.03, 7.0, law)
    wanted |= {blocks.RS: 0.03, blocks.MS: 1 / 7, blocks.INVERSE_MS: 7.0, blocks.INERTIA: 1.4 * 0.03 * 0.03 / 7}
    del wanted[blocks.REACH], wanted[blocks.SKEW]
    for first, value in wanted.items():
        assert buffer[first : first + blocks.BLOCK].tolist() == [dtype(value)] * blocks.BLOCK
