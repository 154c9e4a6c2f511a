"""Frames are copies: how often a state is stored, and where a run stops and goes on, changes no bit of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from gran_bench.config import ContainerConfig, DemConfig, FillingConfig, MaterialConfig, RotationConfig, SceneConfig
from gran_bench.dem import engine_numpy
from gran_bench.dem.fast import engine as engine_numba
from gran_bench.dem.fast import lists
from gran_bench.dem.integrate import Physics
from gran_bench.dem.simulate import settle, simulate
from gran_bench.dem.walls import wall_poses
from gran_bench.scene import Disc, Filling, Material, Outlet, Plane, Room, Scene, Sizes, Vibration, build_scene
from gran_bench.state import ContactHistory, ParticleState

STEP, SPAN = 2e-4, 0.06
FIELDS = ("position", "velocity", "angular_velocity")
HISTORY = ("first", "second", "force", "overlap", "rolling_moment")


def drum(count: int = 120, periodic: bool = False, **changes: object) -> Scene:
    """A short drum whose speed jumps and ramps within the run."""
    scene = build_scene(
        SceneConfig(
            name="short",
            container=ContainerConfig(diameter=0.5, length=0.2, periodic_axis=periodic),
            filling=FillingConfig(count=count),
            material=MaterialConfig(),
            rotation=RotationConfig(times=[1.5, 1.513, 1.513, 1.55], speeds_rpm=[20.0, 40.0, 10.0, 60.0]),
        )
    )
    return replace(scene, **changes)


def sizes() -> Scene:
    scene = drum(60)
    return replace(scene, filling=replace(scene.filling, diameter=0.036, sizes=Sizes("uniform", spread=0.3)))


def rolls() -> Scene:
    stuff = replace(drum().material, rolling_friction=0.1)
    return drum(material=stuff, wall_material=stuff)


def two_materials() -> Scene:
    scene = drum()
    heavy = replace(scene.material, density=7800.0, friction=0.6)
    return replace(scene, more_materials=(heavy,), filling=replace(scene.filling, fractions=(0.5, 0.5)))


def shaken() -> Scene:
    """A floor that shakes, between walls that rest; and a disc in it that falls away."""
    stuff = Material(1e7, 0.29, 2500.0, 0.5, 0.3)
    up = (0.0, 0.0, 1.0)
    floor = Plane((0.0, 0.0, -0.2), up, motion=Vibration(2e-3, 37.0, up, start=1.5))
    room = Room((-0.15, -0.15, -0.13), (0.15, 0.15, 0.3))
    lid = Disc((0.0, 0.0, -0.15), up, 0.1, opens=1.5231)
    return Scene("shaken", (floor, lid), Filling(125, 0.05), stuff, stuff, start_time=1.5, end_time=1.6, room=room)


def leaving() -> Scene:
    """Spheres that fall through an outlet, most of them between two looks."""
    return replace(drum(), walls=(), outlet=Outlet((0.0, 0.0, -0.1), (0.0, 0.0, 1.0)))


SCENES: dict[str, Callable[[], Scene]] = {
    "caps": drum,
    "periodic": lambda: drum(periodic=True),
    "rolling": rolls,
    "sizes": sizes,
    "materials": two_materials,
    "shaken": shaken,
    "outlet": leaving,
}


def moving(scene: Scene) -> ParticleState:
    """A filling that flies about, so that contacts come and go all the time."""
    rng, state = np.random.default_rng(1), (drum() if scene.outlet else scene).fresh_filling(0)
    shape = state.position.shape
    return replace(
        state, velocity=rng.normal(0, 1.5, shape), angular_velocity=rng.normal(0, 20, shape), time=scene.start_time
    )


def same(one: ParticleState, other: ParticleState) -> None:
    """Two states are bit for bit the same, what their contacts remember included."""
    for name in FIELDS:
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
    for name in HISTORY:
        assert np.array_equal(getattr(one.history, name), getattr(other.history, name)), name


def in_order(state: ParticleState) -> ParticleState:
    history = state.history
    order = np.lexsort((history.second, history.first))
    return replace(state, history=ContactHistory(*(array[order] for array in vars(history).values())))


@pytest.fixture(params=["numba", "numpy"])
def dem(request: pytest.FixtureRequest) -> DemConfig:
    """Both engines, at the same step whatever the frames."""
    return DemConfig(engine=request.param, time_step=STEP, allow_unsafe_step=True)


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_the_interval_of_frames_changes_no_bit_at_common_times(scene, dem):
    scene = scene()
    state = moving(scene)
    runs = {
        interval: simulate(replace(scene, frame_interval=interval), state, scene.start_time + SPAN, dem=dem)
        for interval in (0.06, 0.015, 0.01, 0.005, 0.001)
    }
    often = runs.pop(0.001)
    assert len(often.final.history) > 5 or scene.outlet
    for interval, run in runs.items():
        assert run.time_step == often.time_step
        stride = round(interval / 0.001)
        for name in FIELDS:
            found = getattr(often.trajectory, name)[::stride]
            assert np.array_equal(getattr(run.trajectory, name), found), (name, interval)
        same(run.final, often.final)
        # What a frame holds of all its steps is the most of what shorter ones hold.
        for name in ("overlap_peak", "wall_overlap_peak", "overlap_share_peak", "approach_peak"):
            fine = often.trajectory.diagnostics[name][1:].reshape(-1, stride).max(axis=1)
            assert np.array_equal(run.trajectory.diagnostics[name][1:], fine), name


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
@pytest.mark.parametrize("stop", [0.0, 0.001, 0.013, 0.03, 0.05])
def test_a_run_goes_on_from_any_frame_bit_for_bit(scene, stop, dem):
    scene = replace(scene(), frame_interval=0.001)
    state, end = moving(scene), scene.start_time + SPAN
    whole = simulate(scene, state, end, dem=dem)
    half = simulate(scene, state, scene.start_time + stop, dem=dem)
    rest = simulate(scene, half.final, end, dem=dem)
    assert rest.final.time == whole.final.time
    same(rest.final, whole.final)
    first = round(stop / 0.001)
    for name in FIELDS:
        assert np.array_equal(getattr(rest.trajectory, name), getattr(whole.trajectory, name)[first:]), name


@pytest.mark.parametrize("threads", [(1, 1), (3, 1), (2, 3)])
@pytest.mark.parametrize("scene", [scene for name, scene in SCENES.items() if name != "outlet"])
def test_sorting_on_the_way_is_a_stretch_from_what_is_there(scene, threads, monkeypatch):
    monkeypatch.setattr(engine_numba, "CHUNK_SIZES", (30, 60, 1000, 2000))
    scene, (before, after) = scene(), threads
    state = moving(scene)
    physics = replace(Physics.of(scene, float(state.radius.max()), 0.02), threads=before)
    there = engine_numba.Stretch(state, physics, STEP, wall_poses(scene, state.time, STEP, 90))
    there.run(40)
    seen, physics = there.state(), replace(physics, threads=after, skin=0.03)
    held = there.held()._replace(order=None)
    anew = engine_numba.Stretch(seen, physics, STEP, wall_poses(scene, state.time, STEP, 50, 40), held)
    there.sort(physics)
    same(there.state(), seen)
    assert there.threads == anew.threads == after
    for steps in (1, 49):
        there.run(steps)
        anew.run(steps)
        for one, other in zip(there.moving() + there.held()[:3], anew.moving() + anew.held()[:3], strict=True):
            assert np.array_equal(one, other)
        same(in_order(there.state()), in_order(anew.state()))
    assert len(there.state().history) > 5


def test_lists_that_need_more_room_on_the_way_get_it(monkeypatch):
    # Room for no pair at first, and a skin with which each sphere may touch all three walls.
    scene = rolls()
    state = moving(scene)
    physics, poses = Physics.of(scene, 0.025, 0.4), wall_poses(scene, state.time, STEP, 60)
    plenty = engine_numba.advance(state, physics, STEP, poses)
    monkeypatch.setattr(lists, "PAIRS_A_PARTICLE", 0)
    scarce = engine_numba.Stretch(state, replace(physics, skin=0.01), STEP, poses)
    scarce.run(20)
    rooms = [len(getattr(scarce._lists[0], name)) for name in ("pair_i", "geometry")]
    scarce.sort(physics)
    scarce.run(40)
    grown = [len(getattr(scarce._lists[0], name)) for name in ("pair_i", "geometry")]
    assert all(few < many for few, many in zip(rooms, grown, strict=True))
    assert np.abs(scarce.state().position - plenty.position).max() < 1e-9


def test_the_skin_of_the_reference_changes_no_bit_of_it(monkeypatch):
    scene = drum(periodic=True)
    state, dem, found = moving(scene), DemConfig(engine="numpy", time_step=STEP), []
    for skin in (1e-4, engine_numpy.SKIN, 0.7):
        monkeypatch.setattr(engine_numpy, "SKIN", skin)
        found.append(simulate(scene, state, scene.start_time + SPAN, dem=dem).final)
    assert len(found[0].history) > 5
    same(found[0], found[1])
    same(found[2], found[1])


def test_a_run_that_everybody_has_left_goes_on_without_them(dem):
    scene = replace(leaving(), outlet=Outlet((0.0, 0.0, 0.3), (0.0, 0.0, 1.0)), frame_interval=0.001)
    state = moving(scene)
    state = replace(state, position=state.position + np.array([0.0, 0.0, 0.6]))
    fast = replace(state, velocity=np.tile([0.0, 0.0, -20.0], (state.count, 1)))
    whole = simulate(scene, fast, scene.start_time + 0.06, dem=dem)
    assert whole.trajectory.diagnostics["discharged"][[0, -1]].tolist() == [0, state.count]
    half = simulate(scene, fast, scene.start_time + 0.053, dem=dem).final
    rest = simulate(scene, half, scene.start_time + 0.06, dem=dem)
    same(rest.final, whole.final)


def test_threads_skin_and_single_precision_go_on_bit_for_bit_too(monkeypatch):
    monkeypatch.setattr(engine_numba, "CHUNK_SIZES", (30, 60, 1000, 2000))
    scene = drum(frame_interval=0.003)
    state, end = moving(scene), scene.start_time + SPAN
    for precision in ("float64", "float32"):
        runs = []
        for interval, threads, skin in ((0.003, 1, None), (0.015, 3, 0.005), (0.06, 2, 0.03)):
            dem = DemConfig(time_step=STEP, precision=precision, threads=threads, skin=skin)
            first = simulate(replace(scene, frame_interval=interval), state, end, dem=dem).final
            runs.append(first)
        dem = DemConfig(time_step=STEP, precision=precision, threads=2)
        half = simulate(scene, state, scene.start_time + 0.027, dem=dem).final
        runs.append(simulate(scene, half, end, dem=replace(dem, threads=1)).final)
        for run in runs[1:]:
            same(run, runs[0])


def test_what_was_changed_on_the_way_starts_anew(dem):
    # Forces that were kept for another state, step or scene would be wrong for it.
    scene = drum(frame_interval=0.005)
    state, end = simulate(scene, moving(scene), scene.start_time + 0.015, dem=dem).final, scene.start_time + 0.02
    position = state.position.copy()
    position[7] += (0.0, 1e-4, 0.0)
    stiffer = replace(scene.material, youngs_modulus=2e7)
    for place, start, step in (
        (scene, replace(state, position=position), STEP),
        (scene, replace(state, history=ContactHistory.empty()), STEP),
        (scene, replace(state, radius=0.99 * state.radius), STEP),
        (replace(scene, material=stiffer), state, STEP),
        (replace(scene, gravity=(0.0, 0.0, -1.6)), state, STEP),
        (scene.at_speed(30.0), state, STEP),
        (scene, state, 0.5 * STEP),
    ):
        settings = replace(dem, time_step=step)
        kept, lost = (simulate(place, s, end, dem=settings).final for s in (start, replace(start, continuation=None)))
        same(kept, lost)
    kept, lost = (simulate(scene, s, end, dem=dem).final for s in (state, replace(state, continuation=None)))
    assert not np.array_equal(kept.position, lost.position), "forces that were kept are used where they hold"


def test_a_bed_settles_alike_whatever_the_frames_of_the_run_to_come():
    scene = drum(40)
    scene = replace(scene, filling=replace(scene.filling, settled_speed=0.05))
    dem = DemConfig(time_step=STEP)
    one, other = (settle(replace(scene, frame_interval=i), 0, dem=dem) for i in (0.01, 0.002))
    same(one, other)
    assert one.continuation is None, "a bed at rest starts anew in a drum that turns"


def test_a_step_is_the_same_number_whatever_interval_it_divides():
    for step in (2e-4, 1e-4, 1e-3 / 3, 7e-5):
        found = set()
        for multiple in (1, 2, 3, 5, 7, 10, 50, 75, 143):
            scene = drum(frame_interval=multiple * step)
            found.add(simulate(scene, moving(scene), scene.start_time, dem=DemConfig(time_step=step)).time_step)
        assert len(found) == 1, step
