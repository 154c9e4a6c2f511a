"""Every step is watched: an impact between two frames leaves its flag, and a step is held against actual speeds."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gran_bench.config import ContainerConfig, DemConfig, FillingConfig, MaterialConfig, RotationConfig, SceneConfig
from gran_bench.dem.contact import hertz_impact, sphere_mass
from gran_bench.dem.integrate import wall_law
from gran_bench.dem.simulate import settle, simulate
from gran_bench.dem.time_step import TimeStepError, contact_times
from gran_bench.scene import Filling, Material, Plane, Scene, build_scene
from gran_bench.shipped import shipped_scene
from gran_bench.state import ParticleState

RADIUS = 0.025
PEAKS = {"overlap_peak": "overlap_max", "wall_overlap_peak": "wall_overlap_max"}


@pytest.fixture(params=["numba", "numpy"])
def engine(request: pytest.FixtureRequest) -> str:
    """Both engines watch."""
    return request.param


def open_space(youngs_modulus: float = 1e7, floor: bool = False, gravity: float = 0.0) -> Scene:
    """Nothing, or a floor at z = 0."""
    stuff = Material(youngs_modulus, 0.3, 2500.0, 1.0, 0.0)
    walls = (Plane((0, 0, 0), (0, 0, 1.0)),) if floor else ()
    return Scene("open", walls, Filling(2, 2 * RADIUS), stuff, stuff, gravity=(0, 0, -gravity), start_time=0.0)


def head_on(speed: float, gap: float) -> ParticleState:
    """Two spheres that close in at twice a speed, m/s, over a gap, m."""
    half = RADIUS + 0.5 * gap
    position, velocity = (np.array([[-x, 0, 0], [x, 0, 0]]) for x in (half, -speed))
    return ParticleState(position, velocity, np.zeros((2, 3)), np.full(2, RADIUS))


def test_the_collision_at_ten_metres_a_second_is_flagged_though_no_frame_saw_its_depth(engine):
    changes = {
        "filling.positions": [[-0.1, 0, 0], [0.1, 0, 0]],
        "filling.velocities": [[10, 0, 0], [-10, 0, 0]],
        "filling.spins": [],
    }
    scene = shipped_scene("collision", changes)
    result = simulate(scene, settle(scene, 0), scene.end_time, dem=DemConfig(engine=engine))
    seen = result.trajectory.diagnostics
    assert seen["overlap_max"].max() < 0.2 * 0.05, "the frames know nothing"
    (flag,) = result.warnings
    assert "28% of the mean diameter" in flag
    assert "by t = 0.01 s" in flag
    assert "stiffer material" in flag
    frame = int(np.argmax(seen["overlap_peak"]))
    assert seen["overlap_share_peak"][frame] == pytest.approx(seen["overlap_peak"][frame] / 0.05)
    assert seen["approach_peak"][frame] == pytest.approx(20.0, rel=1e-6)


def test_spheres_that_pass_through_each_other_do_not_do_so_without_a_word(engine):
    dem = DemConfig(engine=engine, time_step=5e-6)
    result = simulate(open_space(), head_on(1000.0, 0.01), 0.01, dem=dem)
    assert result.final.position[0, 0] > result.final.position[1, 0], "one went through the other"
    assert result.trajectory.diagnostics["overlap_max"].max() == 0.0
    assert any("pass through each other" in flag for flag in result.warnings)


@pytest.mark.parametrize("speed", [0.3, 2.0])
def test_the_peak_of_an_elastic_impact_is_that_of_hertz(engine, speed):
    scene = open_space()
    result = simulate(scene, head_on(0.5 * speed, 1e-3), 0.02, dem=DemConfig(engine=engine, time_step=1e-5))
    modulus = 0.5 * 1e7 / (1 - 0.3**2)
    depth, _, _ = hertz_impact(modulus, 0.5 * RADIUS, 0.5 * sphere_mass(2500.0, RADIUS), speed)
    seen = result.trajectory.diagnostics
    assert seen["overlap_peak"].max() == pytest.approx(depth, rel=1e-4)
    assert seen["wall_overlap_peak"].max() == 0.0
    assert seen["approach_peak"].max() == pytest.approx(speed, rel=1e-9)
    assert result.warnings == ()


def tumbling(precision: str, engine: str, interval: float) -> dict[str, np.ndarray]:
    """Diagnostics of a small drum of spheres of many sizes that fly about, with frames so far apart, s."""
    scene = build_scene(
        SceneConfig(
            container=ContainerConfig(diameter=0.5, length=0.2),
            filling=FillingConfig(count=100),
            material=MaterialConfig(),
            rotation=RotationConfig(times=[0.0], speeds_rpm=[30.0]),
        )
    )
    rng, state = np.random.default_rng(0), scene.fresh_filling(0)
    state = replace(
        state, velocity=rng.normal(0, 1, (state.count, 3)), radius=rng.uniform(0.015, 0.025, state.count), time=1.5
    )
    dem = DemConfig(engine=engine, precision=precision, time_step=2e-4, allow_unsafe_step=True)
    return simulate(replace(scene, frame_interval=interval), state, 1.52, dem=dem).trajectory.diagnostics


@pytest.mark.parametrize(("engine", "precision"), [("numba", "float64"), ("numba", "float32"), ("numpy", "float64")])
def test_a_frame_holds_the_most_of_all_its_steps(engine, precision):
    seen, every = tumbling(precision, engine, 0.01), tumbling(precision, engine, 2e-4)
    for peak, largest in PEAKS.items():
        of_steps = every[largest][1:].reshape(2, 50).max(axis=1)
        assert (of_steps > 0).all()
        assert seen[peak][1:] == pytest.approx(of_steps, rel=1e-6 if precision == "float32" else 1e-12)
        assert (seen[peak] >= seen[largest] * (1 - 1e-6)).all()
    assert (seen["overlap_peak"][1:] > seen["overlap_max"][1:]).all(), "frames alone miss it"


def test_both_engines_see_the_same_peaks():
    fast, reference = (tumbling("float64", engine, 0.01) for engine in ("numba", "numpy"))
    for name in (*PEAKS, "overlap_share_peak", "approach_peak"):
        assert fast[name][1:].min() > 0
        assert fast[name] == pytest.approx(reference[name], rel=1e-7), name


def test_a_sphere_that_leaves_the_floor_again_before_a_frame_is_flagged_as_well(engine):
    scene = open_space(1e6, floor=True)
    state = ParticleState(np.array([[0, 0, 0.05]]), np.array([[0, 0, -15.0]]), np.zeros((1, 3)), np.full(1, RADIUS))
    result = simulate(scene, state, 0.03, dem=DemConfig(engine=engine, time_step=1e-5))
    assert result.final.position[0, 2] > 0.05
    deepest = result.trajectory.diagnostics["wall_overlap_peak"].max()
    law, mass = wall_law(scene, 0), sphere_mass(2500.0, RADIUS)
    assert deepest == pytest.approx(hertz_impact(law.effective_modulus, RADIUS, mass, 15.0)[0], rel=0.15)
    assert any(f"reached {deepest / (2 * RADIUS):.0%} of the mean diameter" in flag for flag in result.warnings)


def test_the_step_is_held_against_the_speeds_of_the_first_state(engine):
    # Hertz's contact time goes with v^(−1/5): at 36 times the nominal speed it is half as long.
    scene = replace(open_space(1e9, gravity=9.81), frame_interval=1e-3)
    nominal, _ = contact_times(scene)
    step, state, end = 0.095 * nominal, head_on(80.0, 0.05), 1e-3
    result = simulate(scene, state, end, dem=DemConfig(engine=engine, time_step=step))
    assert any("close in at up to 160 m/s" in flag and "lets restitution depend" in flag for flag in result.warnings)
    slow = simulate(scene, replace(state, velocity=0.01 * state.velocity), end, dem=DemConfig(time_step=step))
    assert not any("close in" in flag for flag in slow.warnings)
    # Both fly the same way: neither meets the other, but both may meet what rests.
    alike = simulate(scene, replace(state, velocity=np.abs(state.velocity)), end, dem=DemConfig(time_step=step))
    assert any("close in at up to 80 m/s" in flag for flag in alike.warnings)


def test_a_step_that_cannot_resolve_an_impact_of_the_first_state_is_refused(engine):
    scene = open_space(1e10, gravity=9.81)
    nominal, shortest = contact_times(scene)[0], contact_times(scene, RADIUS, 400.0)[0]
    step = 0.22 * shortest
    assert step < 0.1 * nominal, "nothing is wrong with it otherwise"
    scene, state = replace(scene, frame_interval=step), head_on(200.0, 0.05)
    dem = DemConfig(engine=engine, time_step=step)
    with pytest.raises(TimeStepError, match=r"close in at up to 400 m/s: .* cannot resolve it; set dem\.time_step"):
        simulate(scene, state, step, dem=dem)
    allowed = simulate(scene, state, step, dem=replace(dem, allow_unsafe_step=True))
    assert any("cannot resolve it" in flag for flag in allowed.warnings)


def test_an_impact_that_became_faster_than_anybody_had_reckoned_with_is_flagged():
    # Nothing tells beforehand that it falls from 20 m; the nominal impact is of a metre's fall.
    scene = open_space(1e8, floor=True, gravity=9.81)
    nominal, _ = contact_times(scene)
    state = ParticleState(np.array([[0, 0, 20.0]]), np.zeros((1, 3)), np.zeros((1, 3)), np.full(1, RADIUS))
    fine = simulate(scene, replace(state, position=0.03 * state.position), 0.5, dem=DemConfig())
    assert fine.warnings == ()
    dem = DemConfig(time_step=0.095 * nominal)
    result = simulate(scene, state, 2.1, dem=dem)
    speed = math.sqrt(2 * 9.81 * (20.0 - RADIUS))
    assert any(f"an impact at {speed:.3g} m/s by t = 2.02 s" in flag for flag in result.warnings)


def soft_drum() -> SceneConfig:
    """Two spheres so soft that they are crushed where they fall, and not where they lie."""
    return SceneConfig(
        name="soft",
        container=ContainerConfig(diameter=1.0, length=0.2),
        filling=FillingConfig(count=2, settled_speed=0.05, positions=[[0.0, 0.0, 0.3], [0.1, 0.0, 0.3]]),
        material=MaterialConfig(youngs_modulus=1e6),
        rotation=RotationConfig(times=[0.0, 1.0], speeds_rpm=[1.0, 2.0]),
        end_time=1.52,
    )


def test_settling_has_the_same_flags():
    said: list[str] = []
    bed = settle(build_scene(soft_drum()), 0, warn=said.append)
    assert bed.history.overlap.max() < 0.2 * 2 * RADIUS
    (flag,) = said
    assert "while the bed of 'soft' settled: an overlap that reached" in flag
    with pytest.warns(UserWarning, match="while the bed of 'soft' settled"):
        settle(build_scene(soft_drum()), 0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        calm = SceneConfig(filling=FillingConfig(count=5), material=MaterialConfig(rolling_friction=0.1))
        settle(build_scene(calm), 0)


def test_a_data_set_keeps_the_flags_of_its_beds_and_says_them(tmp_path: Path, capsys: pytest.CaptureFixture):
    from gran_bench.config import DatasetConfig, GenerateConfig
    from gran_bench.dataset import generate, read_attributes

    config = GenerateConfig(scene=soft_drum(), dataset=DatasetConfig(root=str(tmp_path)))
    (path,) = generate(config)
    assert "settled: an overlap that reached" in read_attributes(path)["warnings"]
    assert "settled: an overlap that reached" in capsys.readouterr().out
