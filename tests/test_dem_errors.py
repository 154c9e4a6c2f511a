"""What cannot run is refused before the first step; what fails on the way stops with the failed frame in hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gran_bench.config import ContainerConfig, DemConfig, FillingConfig, SceneConfig
from gran_bench.config.rules import ConfigError
from gran_bench.dem import engine_numpy
from gran_bench.dem.fast import engine as engine_numba
from gran_bench.dem.integrate import Divergence, Physics
from gran_bench.dem.simulate import SimulationError, settle, simulate
from gran_bench.dem.time_step import TimeStepError
from gran_bench.dem.walls import wall_poses
from gran_bench.scene import Plane, Rotation, Scene, SceneError, build_scene
from gran_bench.state import ContactHistory, ParticleState, StateError


@pytest.fixture
def scene() -> Scene:
    """A short drum."""
    return build_scene(
        SceneConfig(name="small", container=ContainerConfig(length=0.2), filling=FillingConfig(count=20))
    )


def at(*position: tuple[float, float, float]) -> ParticleState:
    """Spheres of 50 mm at rest."""
    position = np.array(position, float)
    return ParticleState(position, np.zeros_like(position), np.zeros_like(position), np.full(len(position), 0.025))


def test_duplicates_are_named(scene):
    with pytest.raises(StateError, match="particles 0 and 2 have the same position; remove the duplicates"):
        simulate(scene, at((0, 0, 0), (0.2, 0, 0), (0, 0, 0)), 0.1)


def test_an_overlap_of_a_fifth_is_refused_and_just_less_is_not(scene):
    with pytest.raises(StateError, match="particles 0 and 1 overlap by 20%"):
        simulate(scene, at((0, 0, 0), (0.0399, 0, 0)), 0.1)
    assert simulate(scene, at((0, 0, 0), (0.0401, 0, 0)), 0.01).steps > 0


def test_a_particle_outside_is_named(scene):
    with pytest.raises(StateError, match="particle 1 has its centre outside the container"):
        simulate(scene, at((0, 0, 0), (0, 0, -0.51)), 0.1)


def test_a_particle_deep_in_a_wall_is_named_with_the_wall(scene):
    with pytest.raises(StateError, match="particle 0 overlaps wall 2 by 20%"):
        simulate(scene, at((0, 0.09, 0)), 0.1)


def test_a_bed_that_its_own_weight_crushes_is_refused_where_it_settled(scene):
    filling = replace(scene.filling, settled_speed=0.05)
    crushed = replace(scene.material, youngs_modulus=1e4)
    soft = replace(scene, filling=filling, material=crushed, wall_material=crushed)
    with pytest.raises(StateError, match=r"by 20% .* crushes the bed: raise scene\.material\.youngs_modulus"):
        settle(soft, 0, dem=DemConfig(time_step=1e-3))


def test_an_overlap_from_which_no_run_could_start_is_a_warning_of_the_result(scene):
    soft = replace(scene.material, youngs_modulus=3e4)
    head_on = replace(at((0, 0, 0), (0.06, 0, 0)), velocity=np.array([[3.0, 0, 0], [-3.0, 0, 0]]))
    free = replace(scene, walls=(), gravity=(0.0, 0.0, 0.0), material=soft, wall_material=soft)
    (warning,) = simulate(free, head_on, 0.05, dem=DemConfig(time_step=1e-4)).warnings
    assert "of the mean diameter" in warning
    assert "t = 0.0" in warning
    assert simulate(free, replace(head_on, velocity=0.1 * head_on.velocity), 0.05).warnings == ()


def test_a_history_of_another_scene_is_refused(scene):
    history = ContactHistory(np.array([0]), np.array([7]), np.zeros((1, 3)), np.full(1, 1e-4))
    with pytest.raises(StateError, match="names 1 contacts whose particles or walls this scene does not have"):
        simulate(scene, replace(at((0, 0, 0)), history=history), 0.1)


def test_a_step_beyond_a_fifth_of_the_contact_time_names_the_largest_safe_one(scene):
    with pytest.raises(TimeStepError, match=r"largest safe step is 0\.000370") as caught:
        simulate(scene, at((0, 0, 0)), 0.1, dem=DemConfig(time_step=1e-3))
    assert "dem.allow_unsafe_step=true" in str(caught.value)


def test_an_unsafe_step_that_is_allowed_is_recorded(scene):
    result = simulate(scene, at((0, 0, 0)), 0.1, dem=DemConfig(time_step=1e-3, allow_unsafe_step=True))
    assert result.time_step == 1e-3
    assert any("cannot resolve it" in warning for warning in result.warnings)


@pytest.mark.parametrize("engine", ["numba", "numpy"])
def test_divergence_names_particle_and_time_and_keeps_the_frames(scene, engine):
    # In free fall at 1000 g a sphere passes 31.25 m/s, a quarter of its radius in a step, in the first frame.
    heavy = replace(scene, walls=(), gravity=(0.0, 0.0, -9810.0))
    dem = DemConfig(engine=engine, time_step=2e-4, allow_unsafe_step=True)
    with pytest.raises(SimulationError, match=r"diverged at t = 0\.0032 s: particle 0 moves at 32\.4 m/s") as caught:
        simulate(heavy, at((0, 0, 0), (0.2, 0, 0)), 0.1, dem=dem)
    trajectory = caught.value.trajectory
    assert trajectory.frame_count == 2
    assert trajectory.velocity[-1, 1, 2] == pytest.approx(-32.4, abs=0.1)
    assert np.isnan(trajectory.diagnostics["overlap_max"][-1])


@pytest.mark.parametrize("engine", ["numba", "numpy"])
def test_a_speed_that_crosses_a_quarter_of_a_radius_in_a_step_is_refused_before_the_first(scene, engine):
    free = replace(scene, walls=())
    state = replace(at((0, 0, 0), (0.2, 0, 0)), velocity=np.array([[0, 0, 0], [0, 0, 60.0]]))
    with pytest.raises(StateError, match=r"particle 1 crosses .* less than 31.2 m/s, or set dem\.time_step") as caught:
        simulate(free, state, 0.1, dem=DemConfig(engine=engine))
    remedy = float(str(caught.value).rsplit("at most ", 1)[1].split(" s")[0])
    dem = DemConfig(engine=engine, time_step=0.99 * remedy)
    assert simulate(free, state, 0.01, dem=dem).final.velocity[1, 2] == pytest.approx(60.0, abs=0.1)


def test_divergence_in_a_bed_is_caught_with_the_frames_so_far(scene):
    # A step far beyond the contact time makes contacts explode.
    soft = replace(scene, frame_interval=0.02)
    state = soft.fresh_filling(0)
    with pytest.raises(SimulationError, match=r"choose a smaller dem\.time_step") as caught:
        simulate(soft, state, 4.0, dem=DemConfig(time_step=5e-3, allow_unsafe_step=True))
    assert caught.value.trajectory.frame_count >= 2


def test_escape_names_the_particle_and_saves_the_frame(scene):
    # Heavy enough to sink through a wall a thousand times too soft.
    material = replace(scene.material, youngs_modulus=1e3)
    soft = replace(scene, material=material, wall_material=material)
    with pytest.raises(SimulationError, match=r"particle 0 is .* m beyond a wall, more than its radius") as caught:
        simulate(soft, at((0, 0, -0.47)), 2.0, dem=DemConfig(time_step=1e-3, allow_unsafe_step=True))
    assert np.hypot(*caught.value.trajectory.position[-1, 0, ::2]) > 0.525


def test_a_particle_that_is_not_a_number_or_has_no_size_is_named():
    for field, words in (
        ("position", "position is not finite for particle 1; repair the values or remove"),
        ("velocity", "velocity is not finite for particle 1"),
        ("angular_velocity", "angular_velocity is not finite for particle 1"),
        ("radius", "radius must be positive and finite; particle 1 is not"),
    ):
        values = np.array(getattr(at((0, 0, 0), (0.2, 0, 0)), field))
        values[1] = np.nan
        with pytest.raises(StateError, match=words):
            replace(at((0, 0, 0), (0.2, 0, 0)), **{field: values})
    for radius in (0.0, -0.025, np.inf):
        with pytest.raises(StateError, match="particle 0 is not"):
            replace(at((0, 0, 0), (0.2, 0, 0)), radius=np.array([radius, 0.025]))


@pytest.mark.parametrize(
    ("key", "value", "legal"),
    [
        ("restitution", 1.01, r"\(0, 1\]"),
        ("restitution", 0.0, r"\(0, 1\]"),
        ("poisson_ratio", 0.5, r"\(-1, 0.5\)"),
        ("density", 0.0, "> 0 kg/m³"),
        ("youngs_modulus", -1e7, "> 0 Pa"),
        ("friction", -0.1, "≥ 0"),
    ],
)
def test_an_impossible_material_names_key_value_and_what_is_legal(scene, key, value, legal):
    with pytest.raises(SceneError, match=rf"material\.{key}=\S+ is impossible; choose a value .*{legal}"):
        replace(scene.material, **{key: value})


@pytest.mark.parametrize("step", [0.0, -1e-4, np.nan])
def test_an_impossible_step_is_refused_before_the_first(scene, step):
    with pytest.raises(ConfigError, match=r"dem\.time_step=.* choose a value > 0 s, or null"):
        simulate(scene, at((0, 0, 0)), 0.1, dem=DemConfig(time_step=step))


def test_a_material_that_the_scene_lacks_is_refused_with_the_particles(scene):
    state = replace(at((0, 0, 0), (0.2, 0, 0)), material=np.array([0, 1], np.uint8))
    with pytest.raises(StateError, match=r"particle 1 is of a material that the scene does not have \(it has 1\)"):
        simulate(scene, state, 0.1)
    assert replace(state, material=[0, 1]).material.dtype == np.uint8


def test_a_bed_that_never_rests_is_an_error(scene):
    restless = replace(scene, filling=replace(scene.filling, longest_settling=0.05))
    sentence = r"not at rest after 0\.05 s of settling: particle \d+ moves at .*rolling_friction=0.*longest_settling"
    with pytest.raises(SimulationError, match=sentence):
        settle(restless, 0)


def test_a_filling_that_does_not_fit_says_how_many_do(scene):
    crowded = replace(scene, filling=replace(scene.filling, count=10_000))
    words = r"has room for \d+, at scene\.filling\.lattice_spacing=.* choose fewer or smaller"
    with pytest.raises(SceneError, match=words):
        settle(crowded, 0)


def test_an_end_between_two_frames_is_refused(scene):
    with pytest.raises(ValueError, match=r"end_time=0\.015 s is not a whole number of frames"):
        simulate(scene, at((0, 0, 0)), 0.015)


def test_an_unknown_engine_is_refused_with_the_known_ones(scene):
    with pytest.raises(ValueError, match=r"dem\.engine=nunba is impossible; choose numba or numpy or lammps"):
        simulate(scene, at((0, 0, 0)), 0.1, dem=DemConfig(engine="nunba"))


@pytest.mark.parametrize("skin", [0.0, -0.01, np.nan])
def test_an_impossible_skin_is_refused(scene, skin):
    with pytest.raises(ValueError, match=r"dem\.skin=.* choose a value > 0 m"):
        Physics.of(scene, 0.025, skin)


def test_a_wall_that_would_not_turn_into_itself_is_refused(scene):
    tilted = replace(scene, walls=(Plane((0, 0, -0.3), (0.0, 0.0, 1.0)),), rotation=Rotation((0.0,), (30.0,)))
    with pytest.raises(ValueError, match="wall 0 turns about"):
        Physics.of(tilted, 0.025)


def test_a_period_too_short_for_the_spheres_is_refused():
    thin = build_scene(
        SceneConfig(
            name="thin",
            container=ContainerConfig(length=0.1, periodic_axis=True),
            filling=FillingConfig(count=5),
        )
    )
    with pytest.raises(ValueError, match="shorter than twice the reach"):
        settle(thin, 0)


@pytest.mark.parametrize("engine", [engine_numba, engine_numpy])
def test_a_speed_whose_square_is_no_number_is_a_divergence(scene, engine):
    rest = at((0.0, 0.0, 0.0), (0.0, 0.0, 0.2))
    state = replace(rest, velocity=np.array([[0.0, 0.0, 0.0], [1e200, 0.0, 0.0]]))
    with pytest.raises(Divergence) as caught, np.errstate(all="ignore"):
        engine.advance(state, Physics.of(scene, 0.025), 1e-4, wall_poses(scene, 0.0, 1e-4, 3))
    assert (caught.value.particle, caught.value.steps) == (1, 0)
