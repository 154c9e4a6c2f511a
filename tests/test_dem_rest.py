"""A bed is at rest when it stays at rest: never at the top of a bounce or at the turning point of a swing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gran_bench.dem.rest import Rest
from gran_bench.dem.simulate import SimulationError, settle, simulate
from gran_bench.shipped import shipped_scene
from gran_bench.state import ParticleState

LIMIT = 1.428e-3 * (9.81 * 0.05) ** 0.5  # m/s, filling.settled_froude of the shipped scenes
BOUNCING_BALL = {
    "container.height": 0.3, "filling.count": 1, "filling.settles": True, "material.restitution": 0.9,
}  # fmt: skip


def speed_afterwards(scene, bed):
    """Root mean square of the speeds at each frame of a second in which the walls stand still, m/s."""
    velocity = simulate(scene.at_rest(), bed, bed.time + 1.0).trajectory.velocity
    return np.sqrt(np.square(velocity).sum(axis=2).mean(axis=1))


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("drum_small", {"filling.count": 40}),
        ("drum_small", {"filling.count": 120, "material.friction": 0.1}),
        ("drum_small", {"filling.count": 3, "material.rolling_friction": 0.05}),
        ("drum_small", {"filling.count": 1, "material.rolling_friction": 0.05}),
        ("packing", {"container.height": 0.3, "filling.count": 90, "filling.settles": True}),
        ("hopper", {"filling.count": 150, "container.orifice": 0.06}),
    ],
)
def test_a_settled_bed_stays_at_rest_for_a_second(name, changes):
    scene = shipped_scene(name, changes)
    assert speed_afterwards(scene, settle(scene, 0)).max() < LIMIT


@pytest.mark.parametrize("seed", [10, 30, 39, 41, 46])
def test_a_ball_that_bounces_is_not_at_rest_in_mid_air(seed):
    # Of sixty seeds, in these a look came within 0.1 ms of the top of a bounce.
    scene = shipped_scene("packing", BOUNCING_BALL)
    bed = settle(scene, seed)
    assert bed.position[0, 2] == pytest.approx(scene.filling.radius, rel=0.01)
    assert speed_afterwards(scene, bed).max() < LIMIT


@pytest.mark.parametrize(
    ("changes", "brake"),
    [({"material.friction": 0.0}, "friction=0"), ({"filling.count": 1}, "rolling_friction=0")],
    ids=["a bed on smooth walls", "a ball that rolls"],
)
def test_a_swing_that_nothing_brakes_is_an_error_that_says_what_would(changes, brake):
    scene = shipped_scene("drum_small", {"filling.longest_settling": 6.0, **changes})
    below = r"at rest it stays below 0\.001 m/s \(scene\.filling\.settled_froude"
    sentence = rf"particle \d+ moves at .* m/s.*{below}.*{brake}: choose"
    with pytest.raises(SimulationError, match=sentence):
        settle(scene, 0)


def bed_of(scene, speeds, time, spin=0.0, height=0.0):
    """Spheres with these speeds along x at one height, seen at a time."""
    velocity = np.zeros((len(speeds), 3))
    velocity[:, 0] = speeds
    position = np.full_like(velocity, height)
    turning = np.full_like(velocity, spin)
    return ParticleState(position, velocity, turning, np.full(len(speeds), scene.filling.radius), time)


def rests_at(scene, speed_of, duration=3.0, count=3000, **more):
    """Time when the looks at such a bed end, s; None where it moves to the end."""
    rest = Rest(scene)
    for time in np.arange(0.0, duration, rest.look_interval):
        speeds = np.broadcast_to(speed_of(time), count)
        bed = bed_of(scene, speeds, time, **more)
        if rest.look(time, bed.position, bed.velocity):
            return time
    return None


@pytest.fixture(scope="module")
def drum():
    return shipped_scene("drum")


def test_half_a_period_of_the_slowest_swing_must_pass(drum):
    # A ball rolls in a trough of radius 0.5 m with 2π √(7/5 · 0.5 m / g).
    half = np.pi * np.sqrt(1.4 * 0.5 / 9.81)
    assert rests_at(drum, lambda _: 0.0) == pytest.approx(half, rel=1e-9)
    assert rests_at(drum, lambda time: 1.001 * LIMIT if time < 1.0 else 0.0) == pytest.approx(1.0 + half, abs=0.1)


@pytest.mark.parametrize("length", [0.02, 0.1, 0.475])  # m, to the centre of the swing
@pytest.mark.parametrize("phase", [0.0, 0.5, 1.0, 2.0])
def test_no_swing_hides_at_its_turning_point(drum, length, phase):
    pace = np.sqrt(9.81 / (1.4 * length))
    assert rests_at(drum, lambda time: 1.1 * LIMIT * abs(np.sin(pace * time + phase))) is None


def test_one_sphere_that_bounces_among_many_is_seen(drum):
    # The mean of 100 000 speeds would hide it.
    lone = np.zeros(100_000)
    lone[7] = 0.1
    assert rests_at(drum, lambda _: lone, count=len(lone), duration=1.5) is None


def test_spin_without_a_brake_does_not_count(drum):
    assert rests_at(drum, lambda _: 0.0, spin=50.0) is not None


def test_spheres_beyond_the_outlet_do_not_count():
    hopper = shipped_scene("hopper")
    assert rests_at(hopper, lambda _: 1.0, height=-1.0) is not None
    assert rests_at(hopper, lambda _: 1.0, height=0.1) is None


def test_without_gravity_nothing_swings(drum):
    weightless = replace(drum, gravity=(0.0, 0.0, 0.0), filling=replace(drum.filling, settled_speed=LIMIT))
    assert rests_at(weightless, lambda _: 0.0) == pytest.approx(0.1)


def test_a_start_time_after_the_longest_settling_is_no_unrest():
    ball = BOUNCING_BALL | {"material.restitution": 0.5}
    scene = shipped_scene("packing", ball | {"start_time": 2.0, "end_time": 3.0, "filling.longest_settling": 1.5})
    assert settle(scene, 0).time == 2.0
