"""Spheres that leave: out of the dynamics, in the frames, counted, and never through a wall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gran_bench.config import DemConfig
from gran_bench.dem.outlet import part_of, rejoined
from gran_bench.dem.simulate import SimulationError, settle, simulate
from gran_bench.scene import Filling, Material, Outlet, Plane, Scene
from gran_bench.shipped import shipped_scene
from gran_bench.state import ContactHistory, ParticleState

UP = (0.0, 0.0, 1.0)


@pytest.fixture(params=["numba", "numpy"])
def dem(request: pytest.FixtureRequest) -> DemConfig:
    """Both engines do the same."""
    return DemConfig(engine=request.param)


def falling(radius: float | None = None) -> tuple[Scene, ParticleState]:
    """Three spheres that pass z = 0 at 0, 0.1 and 0.2 s or so, the last one a metre aside."""
    material = Material(1e7, 0.3, 2500.0, 0.5, 0.3)
    outlet = Outlet((0, 0, 0), UP, radius)
    scene = Scene("fall", (), Filling(3, 0.05), material, material, start_time=0.0, end_time=1.0, outlet=outlet)
    position = np.array([[0, 0, 0.001], [0.1, 0, 0.05], [1.0, 0, 0.2]])
    return scene, ParticleState(position, np.zeros((3, 3)), np.ones((3, 3)), np.full(3, 0.025))


def test_a_sphere_beyond_the_outlet_keeps_its_last_state_and_is_counted(dem):
    scene, state = falling()
    trajectory = simulate(scene, state, 0.3, dem=dem).trajectory
    height, count = trajectory.position[:, :, 2], trajectory.diagnostics["discharged"]
    assert np.array_equal(count, (height < 0).sum(axis=1))
    assert (count[0], count[-1]) == (0, 3)
    for sphere in range(3):
        out = int(np.argmax(height[:, sphere] < 0))
        assert out > 0
        for field in ("position", "velocity", "angular_velocity"):
            kept = getattr(trajectory, field)[out:, sphere]
            assert np.array_equal(kept, np.broadcast_to(kept[0], kept.shape)), field
    energy = trajectory.diagnostics["kinetic_energy_translational"]
    assert energy[-1] == 0.0  # of those that take part
    assert energy[5] > 0.0


def test_who_leaves_far_from_the_outlet_came_through_a_wall_and_stops_the_run(dem):
    scene, state = falling(radius=0.5)
    with pytest.raises(SimulationError, match=r"particle 2 escaped by t = 0\.21 s: past the outlet") as caught:
        simulate(scene, state, 0.3, dem=dem)
    assert caught.value.trajectory.position[-1, 2, 2] < 0
    assert caught.value.trajectory.frame_count == 22


def test_an_outlet_that_nobody_reaches_changes_no_bit(dem):
    material = Material(1e7, 0.3, 2500.0, 0.5, 0.3)
    floor = Plane((0, 0, 0), UP)
    scene = Scene("floor", (floor,), Filling(27, 0.05), material, material, start_time=0.0, end_time=1.0)
    state = replace(scene, walls=()).fresh_filling(0)
    state = replace(state, position=state.position + np.array([0, 0, 0.2]))
    assert not scene.needs.outlet
    finals = [
        simulate(s, state, 0.3, dem=dem).final for s in (scene, replace(scene, outlet=Outlet((0, 0, -9.0), UP, 1.0)))
    ]
    assert len(finals[0].history) > 5
    assert np.array_equal(finals[0].position, finals[1].position)
    assert np.array_equal(finals[0].history.force, finals[1].history.force)


def test_contacts_keep_their_names_when_a_part_goes_on_alone():
    history = ContactHistory(
        np.array([0, 0, 1, 2, 3]), np.array([1, -2, 3, 3, -1]), np.arange(15.0).reshape(5, 3), np.arange(5.0)
    )
    position = np.arange(12.0).reshape(4, 3)
    state = ParticleState(position, position, position, np.ones(4), 0.0, history, np.array([0, 1, 2, 3], np.uint8))
    inside = np.array([True, False, True, True])
    part = part_of(state, inside)
    assert part.history.first.tolist() == [0, 1, 2]
    assert part.history.second.tolist() == [-2, 2, -1]
    assert part.material.tolist() == [0, 2, 3]
    whole = rejoined(state, inside, replace(part, position=-part.position))
    assert whole.history.first.tolist() == [0, 2, 3]
    assert whole.history.second.tolist() == [-2, 3, -1]
    assert np.array_equal(whole.position[1], position[1])
    assert np.array_equal(whole.position[inside], -position[inside])


def test_a_hopper_holds_its_bed_until_it_opens_and_every_sphere_leaves_through_its_orifice():
    changes = {"filling.count": 500, "start_time": 0.6, "end_time": 1.2, "filling.settled_speed": 0.02}
    scene = shipped_scene("hopper", changes)
    bed = settle(scene, 0)
    assert bed.position[:, 2].min() > 0.0
    assert (bed.history.second == -3).any()  # some rest on the lid
    trajectory = simulate(scene, bed, scene.end_time).trajectory
    count = trajectory.diagnostics["discharged"]
    assert count[0] == 0
    assert count[-1] > 300
    gone = trajectory.position[-1, trajectory.position[-1, :, 2] < -0.06]
    assert len(gone) == count[-1]
    assert np.hypot(gone[:, 0], gone[:, 1]).max() < 0.08  # the orifice's radius
    still_in = trajectory.position[-1, trajectory.position[-1, :, 2] > 0.0]
    cone = 0.08 + still_in[:, 2]
    assert (np.hypot(still_in[:, 0], still_in[:, 1]) < np.minimum(cone, 0.22)).all()
