"""Counting energy changes no bit, both engines count the same, and the balance closes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gran_bench.config import ContainerConfig, DemConfig, FillingConfig, MaterialConfig, RotationConfig, SceneConfig
from gran_bench.dataset.case_file import read_case, write_case
from gran_bench.dataset.scene_document import to_document
from gran_bench.dataset.summary import power_words
from gran_bench.dem.energy_balance import EnergyBalance
from gran_bench.dem.simulate import SimulationResult, settle, simulate
from gran_bench.metrics.power import driving_power, driving_torque
from gran_bench.plots.power import energy_balance
from gran_bench.scene import Scene, build_scene
from gran_bench.state import ParticleState

STEP = 1e-4
FIELDS = ("position", "velocity", "angular_velocity")


def drum(periodic: bool = False, rolling: float = 0.0) -> Scene:
    """200 spheres in a short drum that turns at 30 rpm."""
    return build_scene(
        SceneConfig(
            name="counted",
            container=ContainerConfig(length=0.2, periodic_axis=periodic),
            filling=FillingConfig(count=200, settled_speed=0.02),
            material=MaterialConfig(rolling_friction=rolling),
            rotation=RotationConfig(times=[1.5], speeds_rpm=[30.0]),
        )
    )


@pytest.fixture(scope="module", params=[(False, 0.0), (True, 0.1)], ids=["caps", "periodic, rolling"])
def bed(request) -> tuple[Scene, ParticleState]:
    scene = drum(*request.param)
    return scene, settle(scene, 0)


def run(bed: tuple[Scene, ParticleState], end: float, **keys: object) -> SimulationResult:
    return simulate(*bed, end, dem=DemConfig(**{"time_step": STEP, "power": True} | keys))


@pytest.mark.parametrize("keys", [{}, {"precision": "float32"}, {"slip": "full_radius"}, {"engine": "numpy"}])
def test_counting_changes_no_bit_of_the_trajectory(bed, keys):
    end = 1.53 if keys.get("engine") == "numpy" else 1.7
    counted, plain = run(bed, end, **keys), run(bed, end, power=False, **keys)
    for name in FIELDS:
        assert np.array_equal(getattr(counted.trajectory, name), getattr(plain.trajectory, name)), name
    for name in ("first", "second", "force", "overlap", "rolling_moment"):
        assert np.array_equal(getattr(counted.final.history, name), getattr(plain.final.history, name)), name
    assert not plain.trajectory.energy
    assert plain.final.history.ledger.shape[1] == 0
    assert counted.trajectory.energy["wall_power"][1:].any()


def test_both_engines_count_the_same(bed):
    start = bed[0], run(bed, 1.6, power=False).final
    fast, slow = (run(start, 1.63, engine=name).trajectory.energy for name in ("numba", "numpy"))
    assert fast.keys() == slow.keys()
    assert all(slow[name][1:].any() for name in ("wall_power", "loss_sliding", "wall_loss_sliding", "spectrum_impact"))
    largest = max(np.abs(values[1:]).max() for name, values in slow.items() if "loss" in name)
    for name, values in slow.items():
        scale = largest if "loss" in name else np.abs(values[1:]).max()
        assert np.abs(fast[name][1:] - values[1:]).max() <= 1e-7 * scale, name


def test_unequal_spheres_of_two_materials_are_counted_alike():
    scene = replace(drum(rolling=0.1), more_materials=(replace(drum().material, density=7800.0),))
    rng = np.random.default_rng(4)
    state = scene.fresh_filling(0)
    state = replace(
        state,
        radius=rng.uniform(0.015, 0.025, state.count),
        velocity=rng.normal(0, 1, (state.count, 3)),
        angular_velocity=rng.normal(0, 20, (state.count, 3)),
        material=rng.integers(0, 2, state.count).astype(np.uint8),
    )
    fast, slow = (run((scene, state), 0.06, engine=name).trajectory for name in ("numba", "numpy"))
    for name, values in slow.energy.items():
        scale = np.abs(values[1:]).max()
        assert np.abs(fast.energy[name][1:] - values[1:]).max() <= 1e-6 * scale, name
    balance = EnergyBalance.of(fast).figures(0.0)
    assert abs(balance["unaccounted_W"]) < 0.01 * balance["loss_W"]


def test_neither_skin_nor_threads_change_what_is_counted():
    scene = build_scene(
        SceneConfig(name="two_chunks", container=ContainerConfig(length=0.6),
                    filling=FillingConfig(count=1600, settled_speed=0.2),
                    rotation=RotationConfig(times=[1.5], speeds_rpm=[30.0]))
    )  # fmt: skip
    start = scene, replace(scene.fresh_filling(0), time=1.5)
    choices = ((0.01, 1), (0.03, 1), (0.02, 2))
    runs = [run(start, 1.7, time_step=2e-4, skin=skin, threads=threads) for skin, threads in choices]
    for name, values in runs[0].trajectory.energy.items():
        for other in runs[1:]:
            assert np.array_equal(other.trajectory.energy[name], values, equal_nan=True), name
    assert runs[0].trajectory.energy["loss_sliding"][1:].any()


def test_a_run_that_stops_and_goes_on_counts_the_same(bed):
    whole = run(bed, 1.7).trajectory.energy
    half = run(bed, 1.64)
    rest = run((bed[0], half.final), 1.7).trajectory.energy
    for name, values in whole.items():
        assert rest[name][1:] == pytest.approx(values[15:], rel=1e-9, abs=1e-12), name


def test_a_longer_frame_has_the_mean_of_the_shorter_ones(bed):
    scene, state = bed
    short = run(bed, 1.7).trajectory.energy
    long = run((replace(scene, frame_interval=5 * scene.frame_interval), state), 1.7).trajectory.energy
    for name, values in long.items():
        expected = short[name][5::5]
        if "energy" not in name and "elastic" not in name:
            expected = short[name][1:].reshape(4, 5, *values.shape[1:]).mean(axis=1)
        assert values[1:] == pytest.approx(expected, rel=1e-9, abs=1e-12), name


def test_the_balance_closes_to_a_percent(bed):
    trajectory = run(bed, 2.5).trajectory
    balance = EnergyBalance.of(trajectory)
    found = balance.figures(1.5)
    assert found["power_W"] > 1.0
    assert abs(found["unaccounted_W"]) < 0.01 * found["power_W"]
    parts = sum(value for name, value in found.items() if "loss_" in name and name != "loss_W")
    assert parts == pytest.approx(found["loss_W"])
    # Frame by frame it closes, too: nothing cancels that should not.
    assert np.abs(balance.unaccounted).mean() < 0.03 * np.abs(balance.power).mean()
    for name, values in balance.losses.items():
        assert values.min() > -1e-3 * found["power_W"], name


def test_power_is_the_torque_times_the_speed(bed):
    energy = run(bed, 1.8).trajectory.energy
    omega = 30.0 * 2.0 * np.pi / 60.0
    assert energy["wall_torque"][1:] * omega == pytest.approx(energy["wall_power"][1:], rel=1e-9, abs=1e-12)


def test_every_contact_that_begins_is_counted_until_it_ends(bed):
    result = run(bed, 1.8)
    energy, interval = result.trajectory.energy, bed[0].frame_interval
    for kind, count in (("", "contact_count"), ("wall_", "wall_contact_count")):
        rates = (energy[f"{kind}spectrum_{name}"][1:].sum() for name in ("impact", "normal", "shear"))
        begun, *ended = (round(float(rate * interval)) for rate in rates)
        touching = result.trajectory.diagnostics[count]
        assert ended == [begun + touching[0] - touching[-1]] * 2
        assert begun > (5 if kind else 50)


def test_the_torque_of_the_motion_is_the_torque_of_the_walls(bed):
    scene = bed[0]
    trajectory = run(bed, 2.2).trajectory
    torque, power = driving_torque(trajectory, scene), driving_power(trajectory, scene)
    walls = trajectory.energy["wall_torque"].sum(axis=1)
    assert np.isnan(torque.value[0])
    assert torque.value[1:].mean() == pytest.approx(walls[1:].mean(), rel=0.01)
    assert np.corrcoef(torque.value[1:], walls[1:])[0, 1] > 0.99
    assert power.value[1:] == pytest.approx(torque.value[1:] * np.pi)


def test_a_metric_of_a_drum_is_undefined_elsewhere():
    scene = replace(drum(), drum_radius=None)
    start = simulate(drum(), settle(drum(), 0), 1.52).trajectory
    assert driving_torque(start, scene).undefined_because


def test_a_case_file_keeps_what_was_counted(bed, tmp_path):
    scene, state = bed
    trajectory = run(bed, 1.55).trajectory
    write_case(tmp_path / "case.h5", {"scene": to_document(scene)}, scene, trajectory, state, {})
    kept, part = read_case(tmp_path / "case.h5"), read_case(tmp_path / "case.h5", slice(2, 4))
    later = EnergyBalance.of(trajectory).figures(trajectory.time[2])["power_W"]
    assert f"the walls give {later:.4g} W: " in power_words(tmp_path / "case.h5")
    for name, values in trajectory.energy.items():
        assert np.array_equal(kept.trajectory.energy[name], values, equal_nan=True), name
        assert np.array_equal(part.trajectory.energy[name], values[2:4], equal_nan=True), name


def test_the_figure_shows_power_losses_and_spectra(bed, tmp_path):
    path = energy_balance(run(bed, 1.7).trajectory, tmp_path / "energy_balance.png", 1.6)
    assert path.stat().st_size > 50_000


def test_a_run_that_did_not_count_has_no_balance(bed, tmp_path):
    with pytest.raises(ValueError, match=r"dem\.power=true"):
        energy_balance(run(bed, 1.52, power=False).trajectory, tmp_path / "none.png", 1.5)
