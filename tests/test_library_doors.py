"""Every public door of the library refuses what cannot be in one clear sentence, with the command line's own words."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from beds import drum
from doors import (
    GLASS,
    ORIGIN,
    SCENE,
    SINGLE,
    UP,
    Still,
    doors,
    history,
    refused,
    state,
    trajectory,
)

from gran_bench.compose import checked_config, compose
from gran_bench.config import (
    DatasetConfig,
    DemConfig,
    GenerateConfig,
    MaterialConfig,
    OptimConfig,
    SceneConfig,
    TrackingConfig,
    TrainConfig,
)
from gran_bench.config.rules import ConfigError
from gran_bench.dem.simulate import settle
from gran_bench.scene import (
    Cone,
    Cylinder,
    Disc,
    Filling,
    Outlet,
    PairCoefficients,
    Plane,
    Room,
    Rotation,
    Sizes,
    Spin,
    Translation,
    Vibration,
    box,
)
from gran_bench.shipped import shipped_scene
from gran_bench.state import ContactHistory, ParticleState
from gran_bench.surrogate.rollout import rollout

# ---- configs -------------------------------------------------------------------------------------------------


@doors(
    (lambda: DemConfig(precision="float16"), "dem.precision=float16 is impossible; choose float64 or float32"),
    (lambda: DemConfig(engine="nunba"), "dem.engine=nunba is impossible; choose numba or numpy or lammps"),
    (lambda: DemConfig(time_step=-1), "dem.time_step=-1 is impossible; choose a value > 0 s, or null"),
    (lambda: DemConfig(time_step=math.inf), "dem.time_step=inf is impossible; choose a value > 0 s, or null"),
    (lambda: DemConfig(time_step=10**400), "dem.time_step=inf is impossible"),
    (lambda: DemConfig(time_step="1e-4"), "dem.time_step=1e-4 has the wrong type; give a number, or null"),
    (lambda: DemConfig(threads=2.5), "dem.threads=2.5 has the wrong type; give a whole number, or null"),
    (lambda: DemConfig(threads=True), "dem.threads=true has the wrong type; give a whole number, or null"),
    (lambda: DemConfig(allow_unsafe_step=1), "dem.allow_unsafe_step=1 has the wrong type; give true or false"),
    (lambda: replace(DemConfig(), skin=math.nan), "dem.skin=nan is impossible; choose a value > 0 m, or null"),
    (lambda: setattr(DemConfig(), "timestep", 1e-4), "dem.timestep=0.0001: no such key; the keys are engine"),
    (lambda: MaterialConfig(restitution=1.2), "scene.material.restitution=1.2 is impossible; choose a value in (0, 1]"),
    (lambda: SceneConfig(name=""), "scene.name= is impossible; choose a name, which is never a path"),
    (lambda: SceneConfig(gravity=-9.81), "scene.gravity=-9.81 is no list; write scene.gravity=[-9.81]"),
    (lambda: SceneConfig(gravity=[0, 0, None]), "scene.gravity[2]=null has the wrong type; give a number"),
    (lambda: SceneConfig(container={"kind": "box"}), "scene.container={'kind': 'box'} has the wrong type; give a Cont"),
    (lambda: DatasetConfig(replicas=1), "dataset.replicas=1 is impossible; choose a value ≥ 2"),
    (lambda: OptimConfig(weight_average=1.0), "optim.weight_average=1 is impossible; choose a value in [0, 1)"),
    (lambda: TrainConfig(dem={"engine": "numpy"}), "dem={'engine': 'numpy'} has the wrong type; give a DemConfig"),
    (lambda: TrainConfig(seed=-1), "seed=-1 is impossible; choose a value ≥ 0"),
)
def test_a_section_refuses_what_its_keys_cannot_hold(door, sentence):
    refused(door, sentence)


@pytest.mark.parametrize(
    ("override", "make"),
    [
        ("dem.precision=float16", lambda: DemConfig(precision="float16")),
        ("dem.time_step=-1", lambda: DemConfig(time_step=-1)),
        ("scene.material.restitution=0", lambda: MaterialConfig(restitution=0)),
        ("scene.material.friction=-0.5", lambda: replace(GLASS, friction=-0.5)),
        ("scene.filling.count=-1", lambda: Filling(-1, 0.05)),
        ("scene.filling.jitter=0.2", lambda: Filling(1, 0.05, jitter=0.2)),
        ("scene.gravity=[0,0]", lambda: replace(SCENE, gravity=[0, 0])),
        ("scene.frame_interval=0", lambda: replace(SCENE, frame_interval=0)),
        ("scene.end_time=1", lambda: replace(SCENE, end_time=1)),
        ("scene.frame_interval=0.03", lambda: rollout(Still(), replace(drum(), frame_interval=0.03), state())),
        ("scene.rotation.speeds_rpm=[nan]", lambda: SCENE.at_speed(math.nan)),
        ("scene.rotation.speeds_rpm=[1,2]", lambda: Rotation((1.5,), (1, 2))),
        ("dem.engine=numpy dem.precision=float32", lambda: settle(SCENE, 0, dem=SINGLE)),
    ],
)
def test_the_library_says_what_the_command_line_says(override, make):
    with pytest.raises(ConfigError) as by_command:
        checked_config(compose("generate", override.split()), GenerateConfig)
    refused(make, str(by_command.value))


def test_numpy_numbers_tuples_arrays_and_paths_are_as_good_as_plain_values(tmp_path):
    dem = DemConfig(time_step=np.float32(0.25), threads=np.int64(2), allow_unsafe_step=np.bool_(True))
    assert [type(value) for value in (dem.time_step, dem.threads, dem.allow_unsafe_step)] == [float, int, bool]
    assert dem == DemConfig(time_step=0.25, threads=2, allow_unsafe_step=True)
    assert SceneConfig(gravity=np.array([0, 0, -1])).gravity == [0.0, 0.0, -1.0]
    assert DatasetConfig(training_speeds_rpm=(20, np.float64(25))).training_speeds_rpm == [20.0, 25.0]
    assert TrackingConfig(root=tmp_path).root == str(tmp_path)
    assert Rotation(np.array([0.0]), [30]) == Rotation((0.0,), (30.0,))
    assert Plane(np.zeros(3), [0, 0, 1]) == Plane(ORIGIN, UP)
    assert replace(SCENE, walls=list(SCENE.walls), gravity=[0, 0, -9.81]) == SCENE


# ---- scenes --------------------------------------------------------------------------------------------------


@doors(
    (lambda: replace(GLASS, youngs_modulus=math.inf), "scene.material.youngs_modulus=inf is impossible; choose"),
    (lambda: replace(GLASS, density="heavy"), "scene.material.density=heavy has the wrong type; give a number"),
    (lambda: PairCoefficients(0, 1, restitution=2), "scene.mixed.restitution=2 is impossible; choose a value in (0"),
    (lambda: PairCoefficients(0.5, 1), "scene.mixed.first=0.5 has the wrong type; give a whole number"),
    (lambda: Filling(2.5, 0.05), "scene.filling.count=2.5 has the wrong type; give a whole number"),
    (lambda: Filling(1, math.nan), "scene.filling.diameter=nan is impossible; choose a value > 0 m"),
    (lambda: Filling(1, 0.05, settled_speed=0), "scene.filling.settled_speed=0 is impossible; choose a value > 0 m/s"),
    (lambda: Filling(1, 0.05, positions=[[0, 0]]), "scene.filling.positions[0]=[0.0, 0.0] is no vector; give three"),
    (lambda: Filling(1, 0.05, positions=[0, 0, 0]), "is no list of vectors; write scene.filling.positions=[[x, y, z]]"),
    (lambda: Filling(2, 0.05, positions=[ORIGIN]), "scene.filling.positions does not give three numbers for each"),
    (lambda: Filling(1, 0.05, fractions=(1.5, -0.5)), "scene.filling.fractions[0]=1.5 is impossible; choose a value"),
    (lambda: Filling(1, 0.05, sizes="lognormal"), "scene.filling.sizes=lognormal has the wrong type; give a Sizes"),
    (lambda: Sizes("lognormal", spread=math.nan), "scene.filling.sizes.spread=nan is impossible"),
    (lambda: Room(ORIGIN, UP, radius=-1), "room.radius=-1 is impossible; choose a value > 0 m, or null"),
    (lambda: Plane(ORIGIN, (0, 0, math.nan)), "plane.normal[2]=nan is impossible; choose a finite value"),
    (lambda: Plane(ORIGIN, (0, 0, 2)), "plane.normal=[0.0, 0.0, 2.0] has length 2; give a unit vector"),
    (lambda: Plane((0, 0), UP), "plane.point=[0.0, 0.0] is no vector; give three components"),
    (lambda: Plane(ORIGIN, UP, turns="no"), "plane.turns=no has the wrong type; give true or false"),
    (lambda: Plane(ORIGIN, UP, motion=Rotation()), "plane.motion=Rotation(…) has the wrong type; give a Spin or Trans"),
    (lambda: Plane(ORIGIN, UP, opens=math.nan), "plane.opens=nan is impossible; choose a finite value, or null"),
    (lambda: Cylinder(ORIGIN, UP, "1 m"), "cylinder.radius=1 m has the wrong type; give a number"),
    (lambda: Disc(ORIGIN, UP, 1.0, hole=-0.1), "disc.hole=-0.1 is impossible; choose a value ≥ 0 m"),
    (lambda: Cone(ORIGIN, UP, 0.1, math.inf, 1.0), "cone.end_radius=inf is impossible; choose a value ≥ 0 m"),
    (lambda: Outlet(ORIGIN, UP, radius=0), "outlet.radius=0 is impossible; choose a value > 0 m, or null"),
    (lambda: box(0, 1), "box.lower=0 is no list"),
    (lambda: box((0, 0), (1, 1)), "box.lower=[0.0, 0.0] is no vector; give three components"),
    (lambda: Rotation((0.0,), ("fast",)), "scene.rotation.speeds_rpm[0]=fast has the wrong type; give a number"),
    (lambda: Rotation((1, 0), (1, 1)), "scene.rotation.times=[1.0, 0.0] goes back in time; sort it"),
    (lambda: Spin((0.0,), (math.nan,)), "spin.speeds_rpm[0]=nan is impossible; choose a finite value in rpm"),
    (lambda: Translation((0.0,), (1.0,)), "is no list of vectors; write translation.velocities=[[x, y, z]]"),
    (lambda: Vibration(1e-3, -1, UP), "vibration.frequency=-1 is impossible; choose a value ≥ 0 Hz"),
    (lambda: replace(SCENE, walls=(Plane(ORIGIN, UP), "floor")), "scene.walls[1]=floor has the wrong type; give a"),
    (lambda: replace(SCENE, wall_material=None), "scene.wall_material=null has the wrong type; give a Material"),
    (lambda: replace(SCENE, outlet=Plane(ORIGIN, UP)), "scene.outlet=Plane(…) has the wrong type; give a Outlet"),
    (lambda: replace(SCENE, gravity=(0, 0, math.nan)), "scene.gravity[2]=nan is impossible; choose a finite value"),
    (lambda: replace(SCENE, start_time=-1), "scene.start_time=-1 is impossible; choose a value ≥ 0 s"),
    (lambda: SCENE.at_speed(None), "scene.rotation.speeds_rpm[0]=null has the wrong type; give a number"),
    (lambda: SCENE.at_speed("30"), "scene.rotation.speeds_rpm[0]=30 has the wrong type; give a number"),
    (lambda: shipped_scene("drum_smal"), "scene=drum_smal: no such choice; did you mean drum_small?"),
    (lambda: shipped_scene(None), "scene=null has the wrong type; give a word"),
    (lambda: shipped_scene("drum", {"material.frction": 0.5}), "no such key; did you mean scene.material.friction?"),
    (lambda: shipped_scene("drum", {"filling.count.x": 5}), "scene.filling.count.x=5: no such key"),
    (lambda: shipped_scene("drum", {"material.friction": "0.5"}), "scene.material.friction=0.5 has the wrong type"),
    (lambda: shipped_scene("drum", {"gravity": [0, 0]}), "scene.gravity=[0.0, 0.0] is no vector; give three"),
    (lambda: shipped_scene("drum", ["gravity"]), "changes=['gravity'] has the wrong type; give a Mapping"),
)
def test_a_scene_that_cannot_be_is_refused(door, sentence):
    refused(door, sentence)


def test_a_change_of_a_shipped_scene_is_a_plain_value_and_may_start_a_section():
    scene = shipped_scene("drum", {"wall_material.friction": np.float64(0.9), "gravity": np.array([0, 0, -1.62])})
    assert scene.wall_material == replace(scene.material, friction=0.9)
    assert scene.gravity == (0.0, 0.0, -1.62)
    assert shipped_scene("drum", {"wall_material": None}) == shipped_scene("drum")


# ---- states --------------------------------------------------------------------------------------------------


@doors(
    (lambda: state(position="here"), "position is no array of numbers"),
    (lambda: state(position=None), "position is no array of numbers"),
    (lambda: state(position=[[0, 0, 0], [0, 0]]), "position is no array of numbers"),
    (lambda: state(position=torch.zeros(2, 3, requires_grad=True)), "position is no array of numbers"),
    (lambda: state(position=0.0), "position has shape (); expected (0, 3)"),
    (lambda: state(velocity=np.zeros((3, 3))), "velocity has shape (3, 3); expected (2, 3)"),
    (lambda: state(velocity=np.zeros((2, 3), complex)), "velocity is no array of numbers"),
    (lambda: state(angular_velocity=[[0, 0, math.nan], [0, 0, 0]]), "angular_velocity is not finite for particle 0"),
    (lambda: state(radius=0.025), "radius has shape (); expected (2,)"),
    (lambda: state(radius=[0.025, -1]), "radius must be positive and finite; particle 1 is not"),
    (lambda: state(material=[0.5, 0]), "material of float64 is no array of indices; give whole numbers up to 255"),
    (lambda: state(material=[0, -1]), "material of int64 is no array of indices; give whole numbers up to 255"),
    (lambda: state(material=[0]), "material has shape (1,); expected (2,)"),
    (lambda: state(time=math.nan), "time=nan is impossible; choose a finite value"),
    (lambda: state(time="now"), "time=now has the wrong type; give a number"),
    (lambda: state(history=None), "history=null has the wrong type; give a ContactHistory"),
    (lambda: history(first=["a"]), "history.first of <U1 is no array of indices"),
    (lambda: history(second=[0, 1]), "history.second has shape (2,); expected (1,)"),
    (lambda: history(force=[0, 0, 0]), "history.force has shape (3,); expected (1, 3)"),
    (lambda: trajectory(position=[0, 1]), "trajectory position has shape (2,); expected (F, N, 3)"),
    (lambda: trajectory(velocity="fast"), "trajectory velocity is no array of numbers"),
    (lambda: trajectory(time=[0, 0]), "trajectory time is not finite or does not increase; give the time of"),
    (lambda: trajectory(time=[0]), "trajectory time has shape (1,); expected (2,)"),
    (lambda: trajectory(radius=[0]), "trajectory radius must be positive and finite; particle 0 is not"),
    (lambda: trajectory(velocity_kind="median"), "velocity_kind='median'; choose instantaneous or mean"),
    (lambda: trajectory(diagnostics={"overlap_mean": [0]}), "trajectory overlap_mean has shape (1,); expected (2,)"),
)
def test_a_state_that_cannot_be_is_refused(door, sentence):
    refused(door, sentence)


def test_lists_will_do_for_arrays():
    lists = {entry.name: getattr(state(), entry.name) for entry in fields(ParticleState)}
    lists |= {name: value.tolist() for name, value in lists.items() if isinstance(value, np.ndarray)}
    from_lists = ParticleState(**lists)
    for name in ("position", "velocity", "angular_velocity", "radius", "material"):
        assert np.array_equal(getattr(from_lists, name), getattr(state(), name))
    assert from_lists.material.dtype == np.uint8
    assert from_lists.position.dtype == np.float64
    assert trajectory().position.shape == (2, 1, 3)
    assert history().first.dtype == np.int64
    assert len(ContactHistory([], [], np.zeros((0, 3)), [])) == 0


def test_an_array_of_numbers_is_not_copied():
    position = np.zeros((2, 3), np.float32)
    assert state(position=position).position is position
