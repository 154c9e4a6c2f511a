"""The automatic step, and what is said of a step that is asked for."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from gran_bench.config import SceneConfig
from gran_bench.config.rules import ConfigError
from gran_bench.dem.contact import sphere_mass
from gran_bench.dem.simulate import choose_time_step
from gran_bench.dem.time_step import (
    DAMPING_FRACTION,
    TIME_STEP_FRACTION,
    TimeStepError,
    contact_times,
    dividing_step,
    impact_speed,
    rayleigh_time,
)
from gran_bench.scene import Scene, build_scene


@pytest.fixture
def drum() -> Scene:
    """The paper's drum at 30 rpm."""
    return build_scene(SceneConfig(name="drum"))


def test_the_drum_gets_its_production_step(drum):
    step, warnings = choose_time_step(drum)
    assert step == pytest.approx(2e-4)
    assert warnings == ()


def test_the_rayleigh_time_of_the_drum(drum):
    m = drum.material
    assert rayleigh_time(0.025, m.density, m.shear_modulus, m.poisson_ratio) == pytest.approx(2.159e-3, rel=1e-3)


@pytest.mark.parametrize("youngs_modulus", [1e5, 1e6, 1e8, 7e10])
def test_the_frame_interval_is_a_whole_multiple_of_the_automatic_step(drum, youngs_modulus):
    material = replace(drum.material, youngs_modulus=youngs_modulus)
    scene = replace(drum, material=material, wall_material=material)
    step, _ = choose_time_step(scene)
    steps = scene.frame_interval / step
    assert steps == pytest.approx(round(steps), abs=1e-9)
    rayleigh = rayleigh_time(0.025, 2500.0, material.shear_modulus, material.poisson_ratio)
    largest = TIME_STEP_FRACTION * min(rayleigh, contact_times(scene)[0])
    assert step <= largest * (1 + 1e-9)
    assert step > largest * round(steps) / (round(steps) + 1) * (1 - 1e-9) or round(steps) == 1


def test_a_softer_or_faster_scene_is_judged_by_its_contact_time(drum):
    assert impact_speed(drum) == pytest.approx(math.sqrt(2 * 9.81))
    fast = drum.at_speed(600.0)
    assert impact_speed(fast) == pytest.approx(600 * 2 * math.pi / 60 * 0.5)
    assert contact_times(fast)[0] < contact_times(drum)[0]


def test_strong_damping_shortens_the_step(drum):
    material = replace(drum.material, restitution=0.02)
    step, _ = choose_time_step(replace(drum, material=material, wall_material=material))
    assert step <= DAMPING_FRACTION * contact_times(replace(drum, material=material, wall_material=material))[1]
    assert step < choose_time_step(drum)[0]


def test_the_step_resolves_the_dashpot_of_a_stiff_rolling_spring(drum):
    material = replace(drum.material, rolling_friction=1.0)
    step, _ = choose_time_step(replace(drum, material=material, wall_material=material))
    # Sphere on wall: its largest overlap, k_r = 2.25 · 2 E* √(r δ) (μ_r r)², C_r = 2 √(7/5 m r² k_r), I = 2/5 m r².
    r, mass, modulus = 0.025, sphere_mass(2500.0, 0.025), 0.5 * 1e7 / (1 - 0.29**2)
    overlap = (1.25 * mass * 2 * 9.81 / (4 / 3 * modulus * math.sqrt(r))) ** 0.4
    stiffness = 2.25 * 2 * modulus * math.sqrt(r * overlap) * r**2
    damping_time = 0.4 * mass * r**2 / (2 * math.sqrt(1.4 * mass * r**2 * stiffness))
    assert step <= DAMPING_FRACTION * damping_time < choose_time_step(drum)[0]
    smooth = replace(material, friction=0.0)  # no rolling model, no limit
    assert choose_time_step(replace(drum, material=smooth, wall_material=smooth)) == choose_time_step(drum)


def test_a_requested_step_is_shortened_to_divide_the_frame_and_says_so(drum):
    step, warnings = choose_time_step(drum, 3e-4)
    assert step == pytest.approx(1e-2 / 34)
    assert len(warnings) == 1
    assert "was shortened" in warnings[0]
    assert choose_time_step(drum, 1e-4) == (pytest.approx(1e-4), ())
    with pytest.raises(TimeStepError, match=r"dem\.time_step=0\.003 s, shortened to 0\.0025 s, is 0\.6"):
        choose_time_step(drum, 3e-3)


def test_warning_from_a_tenth_and_error_from_a_fifth_of_the_contact_time(drum):
    contact_time, _ = contact_times(drum)
    scene = replace(drum, frame_interval=contact_time)
    assert choose_time_step(scene, contact_time / 11)[1] == ()
    _, warnings = choose_time_step(scene, contact_time / 10)
    assert "lets restitution depend on the step" in warnings[0]
    with pytest.raises(TimeStepError, match="largest safe step") as caught:
        choose_time_step(scene, contact_time / 5)
    safe = float(str(caught.value).split("largest safe step is ")[1].split(" s")[0])
    assert choose_time_step(scene, safe)[1] == ()
    assert "cannot resolve" in choose_time_step(scene, contact_time / 5, allow_unsafe=True)[1][0]


@pytest.mark.parametrize("step", [0.0, -1e-4, math.nan, math.inf])
def test_an_impossible_step_is_refused(drum, step):
    with pytest.raises(ConfigError, match="choose a value > 0 s, or null"):
        choose_time_step(drum, step)


def test_smaller_spheres_get_a_smaller_step(drum):
    assert choose_time_step(drum, radius=0.005)[0] < choose_time_step(drum)[0]


def test_dividing_step_is_not_fooled_by_rounding():
    assert dividing_step(1e-2, 2e-4) == 1e-2 / 50
    assert dividing_step(1e-2, 1.0) == 1e-2
