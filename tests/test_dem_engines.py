"""Two engines, one trajectory; and a run that stops and goes on is the run that did not stop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gran_bench.config import ContainerConfig, DemConfig, FillingConfig, MaterialConfig, RotationConfig, SceneConfig
from gran_bench.dem import engine_numpy
from gran_bench.dem.fast import engine as engine_numba
from gran_bench.dem.integrate import Physics
from gran_bench.dem.simulate import settle, simulate
from gran_bench.dem.walls import wall_poses
from gran_bench.scene import Filling, Material, Scene, build_scene
from gran_bench.state import ContactHistory, ParticleState

STEP = 2e-4
FIELDS = ("position", "velocity", "angular_velocity")


def small_drum(periodic: bool = False, rolling: float = 0.0) -> Scene:
    """200 spheres in a short drum whose speed ramps, jumps and ramps again."""
    return build_scene(
        SceneConfig(
            name="small",
            container=ContainerConfig(length=0.2, periodic_axis=periodic),
            filling=FillingConfig(count=200, settled_speed=0.02),
            material=MaterialConfig(rolling_friction=rolling),
            rotation=RotationConfig(times=[1.5, 1.6, 1.6, 1.7], speeds_rpm=[10.0, 30.0, 20.0, 60.0]),
        )
    )


@pytest.fixture(scope="module", params=[(False, 0.0), (True, 0.0), (False, 0.1)], ids=["caps", "periodic", "rolling"])
def bed(request) -> tuple[Scene, ParticleState]:
    """A moving bed with old, new, sticking and sliding contacts."""
    scene = small_drum(*request.param)
    return scene, simulate(scene, settle(scene, 0), 1.62).final


def test_forces_of_one_step_agree_to_rounding(bed):
    scene, state = bed
    physics, walls = Physics.of(scene, 0.025), wall_poses(scene, state.time, STEP, 1)
    fast = engine_numba.advance(state, physics, STEP, walls)
    reference = engine_numpy.advance(state, physics, STEP, walls)
    for name in FIELDS[1:]:
        gained = getattr(reference, name) - getattr(state, name)
        error = np.abs(getattr(fast, name) - getattr(reference, name)).max()
        assert np.abs(gained).max() > 0
        assert error < 1e-12 * np.abs(gained).max()


def test_both_engines_remember_the_same_contacts(bed):
    scene, state = bed
    physics, walls = Physics.of(scene, 0.025), wall_poses(scene, state.time, STEP, 5)
    lists = []
    for engine in (engine_numba, engine_numpy):
        history = engine.advance(state, physics, STEP, walls).history
        order = np.lexsort((history.second, history.first))
        lists.append([getattr(history, name)[order] for name in ("first", "second", "force", "rolling_moment")])
    (first, second, force, moment), expected = lists
    assert len(first) > 300
    assert np.array_equal(first, expected[0])
    assert np.array_equal(second, expected[1])
    assert (second < 0).any()
    assert np.abs(force - expected[2]).max() < 1e-11 * np.abs(force).max()
    assert np.abs(moment - expected[3]).max() <= 1e-11 * np.abs(moment).max()


def test_a_hundred_steps_agree_to_a_tenth_of_a_nanometre(bed):
    scene, state = bed
    runs = [simulate(scene, state, 1.64, dem=DemConfig(engine=name, time_step=STEP)) for name in ("numba", "numpy")]
    assert runs[0].steps == runs[1].steps == 100
    fast, reference = (run.trajectory.position for run in runs)
    assert np.abs(reference[-1] - reference[0]).max() > 1e-3
    assert np.abs(fast - reference).max() < 1e-10
    for name, figure in runs[0].trajectory.diagnostics.items():
        assert figure == pytest.approx(runs[1].trajectory.diagnostics[name], rel=1e-8), name


@pytest.mark.parametrize("engine", ["numba", "numpy"])
def test_a_run_that_stops_at_a_frame_goes_on_bit_for_bit(bed, engine):
    scene, state = bed
    dem = DemConfig(engine=engine)
    end = 1.72 if engine == "numba" else 1.65
    whole = simulate(scene, state, end, dem=dem).final
    half = simulate(scene, state, 1.64, dem=dem).final
    resumed = simulate(scene, half, end, dem=dem).final
    assert resumed.time == whole.time
    for name in FIELDS:
        assert np.array_equal(getattr(resumed, name), getattr(whole, name)), name
    for name in ("first", "second", "force", "overlap", "rolling_moment"):
        assert np.array_equal(getattr(resumed.history, name), getattr(whole.history, name)), name


def test_the_history_matters_for_a_restart(bed):
    scene, state = bed
    forgetful = replace(state, history=ContactHistory.empty())
    kept, lost = (simulate(scene, s, 1.64).final.position for s in (state, forgetful))
    assert np.abs(kept - lost).max() > 1e-6


def test_the_order_of_the_particles_does_not_matter(bed):
    scene, state = bed[0], replace(bed[1], continuation=None)  # it has the forces of its own order
    shuffle = np.random.default_rng(0).permutation(state.count)
    place = np.argsort(shuffle)
    history = state.history
    first = place[history.first]
    second = np.where(history.second < 0, history.second, place[history.second])
    swap = (second >= 0) & (second < first)
    sign = np.where(swap, -1.0, 1.0)[:, None]
    shuffled = replace(
        state,
        **{name: getattr(state, name)[shuffle] for name in (*FIELDS, "radius")},
        history=ContactHistory(
            np.where(swap, second, first),
            np.where(swap, first, second),
            sign * history.force,
            history.overlap,
            sign * history.rolling_moment,
        ),
    )
    straight, mixed = (simulate(scene, s, 1.64).final.position for s in (state, shuffled))
    assert np.abs(mixed - straight[shuffle]).max() < 1e-10


@pytest.mark.parametrize("rolling", [0.0, 0.1])
@pytest.mark.parametrize("sizes", ["one", "many"])
def test_unequal_radii_and_masses_agree_too(rolling, sizes):
    scene = small_drum(rolling=rolling)
    scene = replace(scene, more_materials=(replace(scene.material, density=7800.0),))
    rng = np.random.default_rng(4)
    state = scene.fresh_filling(0)
    radius = rng.uniform(0.015, 0.025, state.count) if sizes == "many" else state.radius
    kind, spin = rng.integers(0, 2, state.count).astype(np.uint8), rng.normal(0, 20, (state.count, 3))
    velocity = rng.normal(0, 1, (state.count, 3))
    state = replace(state, radius=radius, velocity=velocity, angular_velocity=spin, material=kind)
    runs = [
        simulate(scene, state, 0.06, dem=DemConfig(engine=name, time_step=1e-4)).final for name in ("numba", "numpy")
    ]
    assert len(runs[0].history) > 20
    assert np.abs(runs[0].position - runs[1].position).max() < 1e-10
    assert np.abs(runs[0].angular_velocity - runs[1].angular_velocity).max() < 1e-6
    assert (np.abs(runs[0].history.rolling_moment).max() > 0) == (rolling > 0)


@pytest.mark.parametrize("engine", ["numba", "numpy"])
@pytest.mark.parametrize("count", [0, 1])
def test_none_and_one_particle_run(engine, count):
    scene = small_drum()
    state = ParticleState(*(np.zeros((count, 3)) for _ in range(3)), np.full(count, 0.025))
    result = simulate(scene, state, 0.02, dem=DemConfig(engine=engine))
    assert result.trajectory.position.shape == (3, count, 3)
    assert result.trajectory.position[-1, :, 2] == pytest.approx(np.full(count, -0.5 * 9.81 * 0.02**2))
    assert result.trajectory.diagnostics["overlap_max"].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("engine", ["numba", "numpy"])
def test_without_gravity_and_walls_spheres_fly_straight_on(engine):
    material = Material(1e7, 0.29, 2500.0, 0.5, 0.3)
    scene = Scene("free", (), Filling(2, 0.05), material, material, gravity=(0.0, 0.0, 0.0), start_time=0.0)
    state = ParticleState(
        np.array([[0.0, 0, 0], [1.0, 0, 0]]),
        np.array([[0.0, 1.0, 0], [0, 0, -2.0]]),
        np.array([[5.0, 0, 0], [0, 7.0, 0]]),
        np.full(2, 0.025),
    )
    final = simulate(scene, state, 0.1, dem=DemConfig(engine=engine)).final
    assert final.position == pytest.approx(state.position + 0.1 * state.velocity, abs=1e-13)
    assert np.array_equal(final.velocity, state.velocity)
    assert np.array_equal(final.angular_velocity, state.angular_velocity)


def test_frames_follow_the_clock_of_the_scene():
    scene = small_drum()
    state = replace(scene.fresh_filling(0), time=1.5)
    trajectory = simulate(scene, state, 1.55).trajectory
    assert trajectory.time == pytest.approx(1.5 + 0.01 * np.arange(6), abs=1e-12)
    assert np.array_equal(trajectory.position[0], state.position)
    assert trajectory.position.dtype == np.float64


def test_periodic_positions_stay_in_their_period():
    scene = small_drum(periodic=True)
    state = scene.fresh_filling(0)
    state = replace(state, velocity=np.tile([0.0, 3.0, 0.0], (state.count, 1)))
    y = simulate(scene, state, 0.2).trajectory.position[..., 1]
    assert (y >= -0.1).all()
    assert (y < 0.1).all()
    assert (np.diff(y, axis=0) < -0.1).any()  # some did wrap around


def test_settling_ends_at_rest_at_the_start_of_the_scene(bed):
    scene, _ = bed
    state = settle(scene, 3)
    assert state.time == scene.start_time
    assert np.linalg.norm(state.velocity, axis=1).mean() < scene.filling.settled_speed
    assert (state.history.second >= 0).any()
    again = settle(scene, 3)
    assert np.array_equal(state.position, again.position)
    assert np.array_equal(state.history.force, again.history.force)
