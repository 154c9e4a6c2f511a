"""Odd but legal: nothing to move, no weight, no rotation, backwards, far too fast. Each has a stated behaviour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gran_bench.config import ContainerConfig, DemConfig, FillingConfig, SceneConfig
from gran_bench.dem.simulate import settle, simulate
from gran_bench.scene import Scene, build_scene
from gran_bench.shipped import shipped_scene
from gran_bench.state import ParticleState

FIELDS = ("position", "velocity", "angular_velocity")


@pytest.fixture(params=["numba", "numpy"])
def dem(request: pytest.FixtureRequest) -> DemConfig:
    """Both engines do the same."""
    return DemConfig(engine=request.param)


def drum(count: int = 30) -> Scene:
    """A short drum."""
    return build_scene(
        SceneConfig(
            name="small",
            container=ContainerConfig(diameter=0.4, length=0.2),
            filling=FillingConfig(count=count, settled_speed=0.02),
            start_time=0.3,
            end_time=0.5,
        )
    )


def identical(one: ParticleState, other: ParticleState) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in FIELDS) and np.array_equal(
        one.history.force, other.history.force
    )


def test_an_empty_container_settles_at_once_and_turns(dem):
    scene = drum(count=0)
    state = settle(scene, 0, dem=dem)
    assert (state.count, state.time) == (0, 0.3)
    assert simulate(scene.at_speed(30.0), state, 0.5, dem=dem).trajectory.position.shape == (21, 0, 3)


def test_one_particle_falls_and_rests(dem):
    state = settle(drum(count=1), 0, dem=dem)
    assert np.hypot(state.position[0, 0], state.position[0, 2]) == pytest.approx(0.175, abs=1e-3)


def test_without_gravity_the_filling_is_at_rest_where_it_is_put(dem):
    scene = drum()
    filling = replace(scene.filling, longest_settling=60.0)  # without gravity no time is measured by falls
    scene = replace(scene, gravity=(0.0, 0.0, 0.0), filling=filling)
    state = settle(scene, 0, dem=dem)
    assert state.time == 0.3
    assert identical(state, replace(scene.fresh_filling(0), time=0.3))


def test_a_drum_at_0_rpm_stands_still(dem):
    scene = drum()
    bed = settle(scene, 0)
    still = simulate(scene.at_rest(), bed, 0.36, dem=dem).final
    assert identical(simulate(scene.at_speed(0.0), bed, 0.36, dem=dem).final, still)


def test_backwards_is_the_mirror_image_of_forwards(dem):
    scene = drum()
    bed = settle(scene, 0)
    polar, axial = np.array([-1.0, 1.0, 1.0]), np.array([1.0, -1.0, -1.0])
    history = bed.history
    mirrored = replace(
        bed,
        position=bed.position * polar,
        velocity=bed.velocity * polar,
        angular_velocity=bed.angular_velocity * axial,
        history=replace(history, force=history.force * polar),
    )
    forwards = simulate(scene.at_speed(30.0), bed, 0.36, dem=dem).final
    backwards = simulate(scene.at_speed(-30.0), mirrored, 0.36, dem=dem).final
    assert np.abs(forwards.velocity[:, 0]).max() > 0.05
    assert np.abs(backwards.position - forwards.position * polar).max() < 1e-9
    assert np.abs(backwards.angular_velocity - forwards.angular_velocity * axial).max() < 1e-5


def test_500_rpm_throws_the_bed_against_the_wall(dem):
    scene = drum()
    result = simulate(scene.at_speed(500.0), settle(scene, 0), 0.5, dem=dem)
    final, rim = result.final, 500 * 2 * np.pi / 60 * 0.2
    assert result.warnings == ()
    assert np.hypot(final.position[:, 0], final.position[:, 2]).min() > 0.1
    assert 0.5 < np.linalg.norm(final.velocity, axis=1).mean() < rim
    assert not scene.at_speed(500.0).has_angle_of_repose


SMALL = {
    "drum_ramp": {"container.length": 0.2, "filling.count": 100, "start_time": 0.3, "end_time": 5.3},
    "hopper": {"filling.count": 400, "start_time": 0.4, "end_time": 0.8, "filling.settled_speed": 0.05},
    "packing_binary": {"filling.count": 49, "end_time": 0.4, "container.width": 0.25, "container.length": 0.25},
    "packing_polydisperse": {"filling.count": 49, "end_time": 0.4, "container.width": 0.3, "container.length": 0.3},
}


def small(name: str) -> Scene:
    """A shipped scene with few spheres."""
    scene = shipped_scene(name, SMALL[name])
    if name == "drum_ramp":  # all of the ramp within a fifth of a second
        scene = replace(scene, rotation=replace(scene.rotation, times=(0.3, 0.35, 0.45, 0.47, 0.47)))
    return scene


@pytest.mark.parametrize(
    ("name", "middle", "end"),
    [
        ("drum_ramp", 0.4, 0.5),
        ("hopper", 0.54, 0.6),
        ("packing_binary", 0.24, 0.3),
        ("packing_polydisperse", 0.24, 0.3),
    ],
)
def test_a_checkpoint_in_mid_contact_goes_on_bit_for_bit(name, middle, end):
    scene = small(name)
    dem = DemConfig(time_step=2e-4, allow_unsafe_step=True)
    bed = settle(scene, 3)
    whole, half = simulate(scene, bed, end, dem=dem), simulate(scene, bed, middle, dem=dem).final
    assert len(half.history) > 10
    assert identical(simulate(scene, half, end, dem=dem).final, whole.final)
    assert np.array_equal(whole.final.material, bed.material)
    if name == "hopper":  # spheres leave before and after the checkpoint
        left = whole.trajectory.diagnostics["discharged"]
        assert 0 < left[round((middle - 0.4) / 0.01)] < left[-1]


@pytest.mark.parametrize("name", ["drum_ramp", "hopper", "packing_polydisperse"])
def test_the_same_seed_twice_is_the_same_and_another_is_not(name):
    scene = small(name)
    runs = [simulate(scene, settle(scene, seed), scene.start_time + 0.2) for seed in (3, 3, 4)]
    assert identical(runs[0].final, runs[1].final)
    assert np.array_equal(runs[0].trajectory.position, runs[1].trajectory.position)
    assert not np.array_equal(runs[0].final.position, runs[2].final.position)
