"""What a scene is made of: schedules, sizes, materials; what it needs, and what it makes of a data set."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from gran_bench.config import DatasetConfig, DemConfig, GenerateConfig, MaterialConfig, SceneConfig
from gran_bench.config.reading import read_config
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import (
    CaseSpec,
    DatasetError,
    ensure_case,
    from_document,
    generate,
    own_case,
    read_case,
    read_settled,
    split_cases,
    to_document,
)
from gran_bench.dem.integrate import Physics, pair_law
from gran_bench.dem.simulate import settle, simulate
from gran_bench.scene import (
    Cone,
    Cylinder,
    Disc,
    Filling,
    Material,
    Outlet,
    PairCoefficients,
    Plane,
    Scene,
    SceneError,
    Sizes,
    Spin,
    Translation,
    Vibration,
    build_scene,
)
from gran_bench.shipped import shipped_scene

GLASS, STEEL = Material(1e7, 0.25, 2500.0, 0.9, 0.1, 0.04), Material(4e7, 0.3, 7800.0, 0.4, 0.4, 0.01)


# ---- what ships ----------------------------------------------------------------------------------------------


def speeds_at(scene: Scene, *times: float) -> list[float]:
    return [round(scene.rotation.angular_speed(t) * 30 / math.pi, 9) for t in times]


def test_the_ramp_goes_from_30_to_40_in_half_a_second_and_then_to_20_at_once():
    ramp = shipped_scene("drum_ramp")
    assert speeds_at(ramp, 1.4, 1.5, 3.5, 3.75, 4.0, 4.49, 4.5, 5.5) == [0, 30, 30, 35, 40, 40, 20, 20]


def test_the_stop_stands_for_a_second():
    assert speeds_at(shipped_scene("drum_stop"), 1.5, 3.49, 3.5, 4.49, 4.5, 5.5) == [30, 30, 0, 0, 30, 30]


def test_the_fillings_are_half_and_one_and_a_half_times_the_drums_and_the_long_drum_is_filled_as_high():
    drum, low, high, long = (shipped_scene(f"drum{what}") for what in ("", "_low", "_high", "_long"))
    assert (low.filling.count, high.filling.count) == (drum.filling.count // 2, drum.filling.count * 3 // 2)
    assert long.filling.count / long.length == drum.filling.count / drum.length


def test_a_free_flight_never_has_a_contact():
    scene = shipped_scene("free_flight", {"filling.count": 30})
    result = simulate(scene, settle(scene, 0), 0.2)
    assert not result.trajectory.diagnostics["contact_count"].any()
    start = result.trajectory.position[0]
    expected = start * (1 + scene.filling.expansion * 0.2) + [0, 0, -0.5 * 9.81 * 0.2**2]
    assert result.final.position == pytest.approx(expected, abs=1e-12)


def test_a_collision_keeps_momentum_and_loses_energy():
    scene = shipped_scene("collision")
    result = simulate(scene, settle(scene, 0), scene.end_time)
    momentum = result.trajectory.velocity.sum(axis=1)
    assert momentum == pytest.approx(np.broadcast_to(momentum[0], momentum.shape), abs=1e-13)
    energy = result.trajectory.diagnostics["kinetic_energy_translational"]
    assert energy[-1] < 0.5 * energy[0]


@pytest.mark.parametrize("name", ["packing", "packing_polydisperse"])
def test_a_box_filled_under_gravity_comes_to_rest_on_its_floor(name):
    scene = shipped_scene(name, {"filling.count": 150, "end_time": 1.5})
    state = settle(scene, 0)
    assert state.time == 0.0
    final = simulate(scene, state, scene.end_time).final
    assert np.linalg.norm(final.velocity, axis=1).mean() < 0.02
    assert (final.position[:, 2] > 0.95 * final.radius).all()
    assert final.position[:, 2].mean() < 0.7 * state.position[:, 2].mean()


def test_what_a_scene_needs_is_derived_and_said():
    needs = {
        name: shipped_scene(name).needs for name in ("drum", "drum_slice", "hopper", "free_flight", "packing_binary")
    }
    assert needs["drum"].wall_motion
    assert not needs["drum"].wall_geometry
    assert needs["drum"].end_caps
    assert not needs["drum_slice"].end_caps
    assert needs["hopper"].outlet
    assert needs["hopper"].wall_geometry  # its lid goes
    assert not needs["hopper"].wall_motion
    assert not needs["free_flight"].walls
    assert needs["packing_binary"].materials
    assert needs["packing_binary"].polydispersity
    assert "skips rolling, wall_motion, wall_geometry" in str(needs["packing_binary"])
    scene = Scene("one", (), Filling(0, 0.05), GLASS, GLASS)
    still, lift = Plane((0, 0, 0), (0, 0, 1.0), turns=False), Translation((0.0,), ((0, 0, 1.0),))
    assert not replace(scene, walls=(still,)).needs.wall_motion
    assert replace(scene, walls=(replace(still, motion=lift),)).needs.wall_geometry
    assert not replace(scene, walls=(replace(still, motion=replace(lift, velocities=((0, 0, 0),))),)).needs.wall_motion


# ---- materials -----------------------------------------------------------------------------------------------


def test_a_material_meets_itself_with_its_own_coefficients_and_another_with_the_geometric_mean():
    scene = Scene("two", (), Filling(0, 0.05), GLASS, GLASS, more_materials=(STEEL,))
    assert scene.materials == (GLASS, STEEL)
    assert scene.coefficients(0, 0) == (0.9, 0.1, 0.04)
    assert scene.coefficients(1, 1) == (0.4, 0.4, 0.01)
    assert scene.coefficients(0, 1) == scene.coefficients(1, 0) == pytest.approx((0.6, 0.2, 0.02))
    measured = replace(scene, pair_coefficients=(PairCoefficients(1, 0, friction=0.33),))
    assert measured.coefficients(0, 1) == pytest.approx((0.6, 0.33, 0.02))


def test_the_moduli_of_two_materials_add_as_springs_in_series():
    scene = Scene("two", (), Filling(0, 0.05), GLASS, GLASS, more_materials=(STEEL,))
    law = pair_law(scene, 0, 1)
    assert 1 / law.effective_modulus == pytest.approx((1 - 0.25**2) / 1e7 + (1 - 0.3**2) / 4e7)
    shear = [m.youngs_modulus / (2 * (1 + m.poisson_ratio)) for m in (GLASS, STEEL)]
    assert 1 / law.effective_shear_modulus == pytest.approx((2 - 0.25) / shear[0] + (2 - 0.3) / shear[1])


def test_the_engines_get_a_law_for_every_meeting():
    walls = (Plane((0, 0, 0), (0, 0, 1.0)), Plane((0, 0, 1.0), (0, 0, -1.0)))
    scene = Scene("two", walls, Filling(0, 0.05), GLASS, STEEL, more_materials=(STEEL,))
    physics = Physics.of(scene, 0.025)
    assert physics.pair_laws.shape == (2, 2, 5)
    assert physics.wall_laws.shape == (2, 2, 5)
    assert physics.density.tolist() == [2500.0, 7800.0]
    assert np.array_equal(physics.pair_laws[0, 1], physics.pair_laws[1, 0])
    assert physics.wall_laws[:, :, 3] == pytest.approx(0.4)  # the wall's friction counts
    assert np.array_equal(physics.pair_laws[1, 1], physics.wall_laws[1, 0])


def test_a_filling_shares_out_its_materials():
    scene = shipped_scene("packing_binary", {"filling.count": 100})
    state = scene.fresh_filling(0)
    assert state.material.dtype == np.uint8
    assert np.bincount(state.material).tolist() == [75, 25]
    assert np.array_equal(np.unique(state.radius), [0.015, 0.025])
    assert not np.array_equal(state.material, scene.fresh_filling(1).material)
    assert scene.coefficients(0, 1)[1] == 0.4
    assert scene.material.poisson_ratio == scene.materials[1].poisson_ratio  # left out, so the first's


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"pair_coefficients": (PairCoefficients(0, 2),)}, "materials 0 and 2 name one that the scene does not have"),
        ({"filling": Filling(4, 0.05, fractions=(0.5, 0.2, 0.3))}, "more materials than the scene's 2"),
    ],
)
def test_materials_that_are_not_there_are_refused(changes, words):
    scene = Scene("two", (), Filling(0, 0.05), GLASS, GLASS, more_materials=(STEEL,))
    with pytest.raises(SceneError, match=words):
        replace(scene, **changes)
    with pytest.raises(SceneError, match="contradict the material's own"):
        PairCoefficients(1, 1)


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        ({"filling": {"second_fraction": 0.5}}, r"second_fraction=0.5 needs a second material"),
        ({"mixed": {"friction": 0.5}}, r"scene\.mixed\.friction=0.5 is of a second material"),
        ({"filling": {"count": 2, "positions": [[0, 0, 0]]}}, r"scene\.filling\.positions does not give three numbers"),
        ({"filling": {"positions": [0, 0, 0]}}, r"no list of vectors; write scene\.filling\.positions=\[\[x, y, z\]\]"),
        ({"container": {"kind": "bix"}}, r"scene\.container\.kind=bix: no such container; did you mean box\?"),
        ({"container": {"kind": "box", "diameter": 1.0}}, r"belongs to scene\.container\.kind=drum or none or hopper"),
    ],
)
def test_a_scene_config_that_contradicts_itself_is_refused(scene, words):
    with pytest.raises(ConfigError, match=words):
        read_config(GenerateConfig, {"scene": {"name": "mine", **scene}})


def scene_of(**sections) -> Scene:
    return build_scene(read_config(GenerateConfig, {"scene": {"name": "mine", **sections}}).scene)


@pytest.mark.parametrize(
    ("container", "words"),
    [
        ({"diameter": 200.0, "length": 0.2}, r"scene\.container\.diameter=200 m holds 3e\+10 sites"),
        ({"diameter": 0.2, "length": 1e6}, r"scene\.container\.length=1e\+06 m holds 1e\+11 sites"),
        ({"kind": "box", "width": 70.0, "length": 50.0}, r"scene\.container\.width=70 m holds \de\+10 sites"),
        ({"kind": "hopper", "height": 900.0}, r"scene\.container\.height=900 m holds \de\+08 sites"),
    ],
)
def test_a_container_in_millimetres_is_refused_before_its_lattice_is_made(container, words):
    scene = scene_of(container=container, filling={"diameter": 0.006, "count": 600})
    with pytest.raises(SceneError, match=words + r" of a lattice for 600 spheres of 0\.006 m; lengths are in m"):
        scene.fresh_filling(0)


def test_spheres_that_their_own_weight_crushes_are_refused_with_the_unit_of_their_modulus():
    words = r"scene\.material\.youngs_modulus=63 Pa .* it is in Pa: choose at least 1\.5e\+03"
    with pytest.raises(SceneError, match=words):
        scene_of(material={"youngs_modulus": 63.0}, filling={"diameter": 0.006})
    assert scene_of(material={"youngs_modulus": 1.6e3}, filling={"diameter": 0.006}).materials
    assert scene_of(material={"youngs_modulus": 63.0}, filling={"settles": False}, gravity=[0.0, 0.0, 0.0]).materials


# ---- cases ---------------------------------------------------------------------------------------------------


def rich_scene() -> Scene:
    """A scene that has some of everything."""
    walls = (
        Plane((0, 0, 0), (0, 0, 1.0), motion=Vibration(1e-3, 50.0, (0, 0, 1.0), 0.1, 1.5)),
        Cylinder((0, 0, 0), (0, 0, 1.0), 0.5, length=1.0, motion=Spin((1.5,), (10.0,), (0, 0, 1.0), (0, 0, 0.5))),
        Disc((0, 0, 0), (0, 0, 1.0), 0.5, hole=0.1, opens=1.5),
        Cone((0, 0, 0), (0, 0, 1.0), 0.1, 0.5, 0.4, motion=Translation((1.5, 2.0), ((0, 0, 0), (0, 0, 1.0)))),
    )
    return Scene(
        "rich", walls, Filling(2, 0.05, sizes=Sizes("uniform", spread=0.1), positions=((0, 0, 1.0), (0, 0, 2.0))),
        GLASS, STEEL, more_materials=(STEEL,), pair_coefficients=(PairCoefficients(0, 1, friction=0.2),),
        outlet=Outlet((0, 0, -1.0), (0, 0, 1.0), 0.3),
    )  # fmt: skip


@pytest.mark.parametrize("name", ["rich", "hopper", "packing_binary", "collision", "drum_ramp"])
def test_every_scene_survives_its_document(name):
    scene = rich_scene() if name == "rich" else shipped_scene(name)
    assert from_document(to_document(scene)) == scene


def test_a_schedule_keeps_itself_when_cases_are_made(tmp_path, capsys):
    config = SceneConfig(name="small", start_time=0.3, end_time=0.5)
    config.container.length, config.filling.count = 0.2, 20
    config.rotation.times, config.rotation.speeds_rpm = [0.3, 0.4], [10.0, 30.0]
    settings = GenerateConfig(scene=config, dataset=DatasetConfig(root=str(tmp_path), workers=1))
    (path,) = generate(settings)
    said = capsys.readouterr().out
    assert "keeps its own motion, so it makes one case" in said
    assert "small_schedule_seed0" in path.name
    assert read_case(path).scene == build_scene(config)
    with pytest.raises(DatasetError, match="keeps its own motion, so it makes one case and no splits by speed"):
        split_cases(build_scene(config), DemConfig(), settings.dataset)


def test_a_scene_of_two_materials_is_a_case_that_goes_on_bit_for_bit(tmp_path):
    changes = {"filling.count": 30, "end_time": 0.3, "container.height": 1.0}
    scene, dem = shipped_scene("packing_binary", changes), DemConfig()
    spec = own_case(scene, dem, DatasetConfig())
    assert isinstance(spec, CaseSpec)
    case = read_case(ensure_case(spec, tmp_path))
    assert case.scene == scene
    assert np.bincount(case.settled.material).tolist() == [23, 7]
    assert np.array_equal(read_settled(spec.settled_path(tmp_path))[0].material, case.settled.material)
    again = simulate(case.scene, case.settled, scene.end_time, dem=dem).trajectory
    assert np.array_equal(again.position.astype(np.float32), case.trajectory.position)


def test_the_config_of_a_material_fills_in_what_the_second_leaves_out():
    config = read_config(
        GenerateConfig, {"scene": {"name": "m", "material": {"friction": 0.2}, "second_material": {"density": 1.0}}}
    )
    assert config.scene.second_material == MaterialConfig(friction=0.2, density=1.0)
