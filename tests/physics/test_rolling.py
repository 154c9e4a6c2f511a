"""A sphere that rolling friction stops comes to rest and stays; the rolling law takes energy and never gives any."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from gran_bench.config import DemConfig
from gran_bench.dem.contact import sphere_mass
from gran_bench.dem.rolling import rolling_moment
from gran_bench.dem.simulate import simulate
from gran_bench.scene import Material, PairCoefficients, Plane

RADIUS, GRAVITY, SPEED = 0.025, 9.81, 0.2
FLOOR = Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), turns=False)
MASS = sphere_mass(2500.0, RADIUS)


def resting_overlap(scene):
    """(m g / K)^{2/3} with K = 4/3 E* √r, m."""
    effective = scene.material.youngs_modulus / (1 - scene.material.poisson_ratio**2) / 2
    return (MASS * GRAVITY / (4 / 3 * effective * np.sqrt(RADIUS))) ** (2 / 3)


def rolling_on_the_floor(scene, spheres, seconds, dem):
    """Time, speed and spin of a ball that starts to roll at 0.2 m/s."""
    arm = RADIUS - resting_overlap(scene)
    state = spheres([[0, 0, arm]], [[SPEED, 0, 0]], [[0, SPEED / arm, 0]])
    run = simulate(replace(scene, frame_interval=0.005), state, seconds, dem=dem).trajectory
    return run.time, np.linalg.norm(run.velocity[:, 0], axis=1), np.linalg.norm(run.angular_velocity[:, 0], axis=1)


@pytest.mark.parametrize(
    "dem",
    [DemConfig(), DemConfig(precision="float32"), DemConfig(engine="numpy")],
    ids=["numba", "float32", "numpy"],
)
def test_a_rolling_ball_stops_when_theory_says_and_stays_at_rest(laboratory, spheres, dem):
    scene = laboratory(walls=(FLOOR,), gravity=GRAVITY, restitution=0.5, friction=0.5, rolling_friction=0.1)
    arm = RADIUS - resting_overlap(scene)
    # About the contact point: (m a² + 2/5 m r²) ω falls by μ_r r m g a second.
    stop = SPEED / arm * (arm**2 + 0.4 * RADIUS**2) / (0.1 * RADIUS * GRAVITY)
    time, speed, spin = rolling_on_the_floor(scene, spheres, 1.0, dem)
    assert stop == pytest.approx(0.285, abs=1e-3)
    rolls = time < 0.95 * stop
    assert speed[rolls] == pytest.approx(SPEED * (1 - time[rolls] / stop), abs=0.02 * SPEED)
    # Without a dashpot it rocks at 0.016 m/s for ever.
    assert speed[time > stop + 0.15].max() < 1e-3 * SPEED
    assert speed[time > 0.9].max() < 1e-6 * SPEED
    assert spin[time > 0.9].max() * RADIUS < 1e-6 * SPEED


@pytest.mark.parametrize("coefficient", [0.01, 0.5, 2.0])
def test_the_automatic_step_damps_rolling_whatever_its_coefficient(laboratory, spheres, coefficient):
    scene = laboratory(walls=(FLOOR,), gravity=GRAVITY, restitution=0.5, friction=3.0, rolling_friction=coefficient)
    # It stops after 0.0285 s / μ_r; what is left then dies in proportion to 1/μ_r.
    seconds = round(0.2 + 0.045 / coefficient, 2)
    time, speed, spin = rolling_on_the_floor(scene, spheres, seconds, DemConfig())
    assert speed[time > seconds - 0.05].max() < 1e-3 * SPEED
    assert spin[time > seconds - 0.05].max() * RADIUS < 1e-3 * SPEED


def kinetic_and_height(scene, trajectory):
    """Of all spheres, J at each frame; rotation included."""
    figures = trajectory.diagnostics
    height = MASS * GRAVITY * trajectory.position[:, :, 2].sum(axis=1)
    return figures["kinetic_energy_translational"] + figures["kinetic_energy_rotational"] + height


@pytest.mark.parametrize("engine", ["numba"], indirect=True)  # long; the engines agree to rounding
@pytest.mark.parametrize("coefficient", [0.1, 1.0])
def test_a_heap_with_rolling_friction_never_gains_energy_and_comes_to_rest(laboratory, spheres, engine, coefficient):
    sides = tuple(Plane(tuple(0.09 * axis), tuple(-axis), turns=False) for axis in (*np.eye(3)[:2], *-np.eye(3)[:2]))
    scene = laboratory(
        walls=(FLOOR, *sides), gravity=GRAVITY, restitution=0.5, friction=0.5, rolling_friction=coefficient
    )
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid([-0.05, 0.01], [-0.05, 0.01], [0.03, 0.09, 0.15, 0.21]), axis=-1).reshape(-1, 3)
    state = spheres(grid, rng.normal(0.0, 0.3, grid.shape), rng.normal(0.0, 30.0, grid.shape))
    trajectory = simulate(replace(scene, frame_interval=0.02), state, 3.0).trajectory
    energy = kinetic_and_height(scene, trajectory)
    # What contacts store goes in and out; of a sphere on the floor it is ⅖ F δ.
    stored = 0.4 * MASS * GRAVITY * resting_overlap(scene)
    assert np.diff(energy).max() < 0.01 * (energy[0] - energy[-1])
    assert (energy[len(energy) // 2 :] - np.minimum.accumulate(energy)[len(energy) // 2 :]).max() < stored
    # Spin about a contact's normal goes on: nothing in the model brakes it.
    assert np.linalg.norm(trajectory.velocity[-10:], axis=2).max() < 1e-4


def work_of_a_rolling_cycle(path, substeps=400):
    """Work done by a contact's rolling moment over a path of (overlap, angle), with its history, J."""
    corners, normal = np.array(path), np.array([[0.0, 0.0, 1.0]])
    history, before, work, moment = np.zeros((1, 3)), corners[:1, 0], 0.0, np.zeros((1, 3))
    for start, end in pairwise(corners):
        for k in range(1, substeps + 1):
            overlap = np.array([start[0] + (end[0] - start[0]) * k / substeps])
            turn = (end[1] - start[1]) / substeps
            # No inertia, no dashpot: the spring alone. A coefficient this high never reaches its limit.
            new, history = rolling_moment(
                history, np.array([[turn, 0.0, 0.0]]), normal, overlap, before,
                np.array([0.0125]), np.zeros(1), 5e6, 1.0, 1.0,
            )  # fmt: skip
            work += 0.5 * (moment + new)[0, 0] * turn
            before, moment = overlap, new
    return work


DEEP, SHALLOW, ANGLE = 2e-3, 1.5e-3, 1e-2


def test_rolling_at_high_load_and_back_at_low_load_gives_less_than_it_took():
    # What stays behind is what the stiffer spring took more than the softer one.
    deep, shallow = (-work_of_a_rolling_cycle([(d, 0), (d, ANGLE)]) for d in (DEEP, SHALLOW))
    cycle = -work_of_a_rolling_cycle([(SHALLOW, 0), (DEEP, 0), (DEEP, ANGLE), (SHALLOW, ANGLE), (SHALLOW, 0)])
    assert deep > shallow > 0.0
    assert cycle == pytest.approx(deep - shallow, rel=0.01)


def test_spheres_of_one_size_and_two_densities_meet_with_their_own_masses(laboratory, spheres, run):
    light = Material(1e7, 0.3, 2500.0, 0.5, 0.0)
    scene = replace(
        laboratory(),
        material=light,
        more_materials=(replace(light, density=25000.0),),
        pair_coefficients=(PairCoefficients(0, 1, 0.5, 0.0, 0.0),),
    )
    # Two light ones meet, and elsewhere two heavy ones, and one of each.
    position = [[0, 0, 0], [0.0501, 0, 0], [0, 1, 0], [0.0501, 1, 0], [0, 2, 0], [0.0501, 2, 0]]
    state = spheres(position, 3 * [[1, 0, 0], [0, 0, 0]])
    state = replace(state, material=np.array([0, 0, 1, 1, 0, 1], np.uint8))
    speed = run(scene, state, 2e-5, 1500, 1500).final.velocity[:, 0]
    assert speed[1::2] - speed[::2] == pytest.approx(3 * [0.5], abs=2e-3)
