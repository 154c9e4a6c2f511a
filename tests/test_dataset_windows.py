"""Windows for training: the right frames and resumable draws; tests/test_fair_play.py keeps the hold-out away."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gran_bench.config import ContainerConfig, DatasetConfig, DemConfig, FillingConfig, SceneConfig
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import (
    Case,
    DatasetError,
    Split,
    Windows,
    dataset_digest,
    ensure_cases,
    read_case,
    split_cases,
)
from gran_bench.scene import build_scene

CONFIG = SceneConfig(
    name="drum_tiny",
    container=ContainerConfig(diameter=0.4, length=0.2, periodic_axis=True),
    filling=FillingConfig(count=40),
    start_time=0.4,
    end_time=0.7,
)
SPEEDS = DatasetConfig(training_speeds_rpm=[25.0, 35.0], holdout_speeds_rpm=[30.0])


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> tuple[Split, Path]:
    """A data set of three speeds and its folder."""
    root = tmp_path_factory.mktemp("data")
    split = split_cases(build_scene(CONFIG), DemConfig(), SPEEDS)
    ensure_cases(split.all, root, workers=1, progress=False)
    return split, root


@pytest.fixture(scope="module")
def cases(data: tuple[Split, Path]) -> list[Case]:
    split, root = data
    return [read_case(spec.path(root)) for spec in split.training]


def test_a_window_shows_consecutive_frames_of_one_case(cases: list[Case]):
    windows = Windows(cases)
    window = windows.window(case=1, start=4, frames_ahead=3)
    motion = cases[1].trajectory
    np.testing.assert_array_equal(window.position, motion.position[4:8])
    np.testing.assert_array_equal(window.angular_velocity, motion.angular_velocity[4:8])
    np.testing.assert_array_equal(window.previous_position, motion.position[3])
    assert window.time == pytest.approx(0.44)
    assert window.scene == cases[1].scene
    assert windows.window(0, 0, 3).previous_position is None


@pytest.mark.parametrize("field", ["position", "velocity", "angular_velocity"])
def test_a_frame_that_is_not_finite_is_named_before_any_training(cases: list[Case], field: str):
    values = np.array(getattr(cases[1].trajectory, field))
    values[7, 3, 1] = np.nan
    broken = replace(cases[1], trajectory=replace(cases[1].trajectory, **{field: values}))
    with pytest.raises(DatasetError, match=rf"a {field} that is not finite in 1 of its frames, first in frame 7"):
        Windows([cases[0], broken])


def test_draws_are_a_pure_function_of_seed_and_number(cases: list[Case]):
    def starts(seed: int, numbers: range) -> list[tuple[int, int]]:
        windows = Windows(cases, seed)
        return [(w.case, w.start) for w in (windows.draw(k, 3) for k in numbers)]

    assert starts(1, range(20, 40)) == starts(1, range(40))[20:]
    assert starts(1, range(40)) != starts(2, range(40))


def test_draws_cover_every_case_and_every_start_that_fits(cases: list[Case]):
    drawn = [Windows(cases).draw(k, 5) for k in range(1500)]
    assert {w.case for w in drawn} == {0, 1}
    assert {w.start for w in drawn} == set(range(26))  # 31 frames, 5 ahead


def test_a_share_of_windows_starts_in_the_start_up(cases: list[Case]):
    def early(share: float) -> float:
        windows = Windows(cases, seed=3, startup_fraction=share, startup_seconds=0.05)
        return float(np.mean([windows.draw(k, 1).start < 5 for k in range(1000)]))

    assert early(1.0) == 1.0
    # 5 of 30 starts are early anyway.
    assert early(0.0) == pytest.approx(5 / 30, abs=0.05)
    assert early(0.6) == pytest.approx(0.6 + 0.4 * 5 / 30, abs=0.05)


def test_mean_velocity_is_the_displacement_over_the_frame_even_across_the_seam(cases: list[Case]):
    case, period = cases[0], cases[0].scene.period
    # Shift the bed along the periodic axis so that some spheres cross the seam within the window.
    y = case.trajectory.position[:, :, 1:2]
    shifted = np.concatenate(
        [case.trajectory.position[..., :1], (y + 0.05) % period - 0.5 * period, case.trajectory.position[..., 2:]], 2
    )
    crossing = Windows([replace(case, trajectory=replace(case.trajectory, position=shifted))])
    plain = Windows([case])
    for start in (3, 10):
        expected = plain.window(0, start, 2)
        found = crossing.window(0, start, 2)
        for k in range(3):
            np.testing.assert_allclose(found.velocity_at(k, "mean"), expected.velocity_at(k, "mean"), atol=1e-4)
    window = plain.window(0, 3, 2)
    moved = window.position[1].astype(float) - window.position[0]
    moved[:, 1] -= period * np.round(moved[:, 1] / period)
    np.testing.assert_allclose(window.velocity_at(1, "mean"), moved / 0.01, rtol=1e-6)
    np.testing.assert_array_equal(window.velocity_at(1, "instantaneous"), window.velocity[1])
    settled = plain.window(0, 0, 2)
    np.testing.assert_array_equal(settled.velocity_at(0, "mean"), settled.velocity[0])


def test_the_solvers_own_overlap_is_a_mean_over_all_contacts(cases: list[Case]):
    figures = cases[0].trajectory.diagnostics
    pairs, walls = figures["contact_count"][2], figures["wall_contact_count"][2]
    assert pairs > 0
    assert walls > 0
    total = pairs * figures["overlap_mean"][2] + walls * figures["wall_overlap_mean"][2]
    window = Windows(cases).window(0, 2, 1)
    assert window.mean_overlap[0] == pytest.approx(total / (pairs + walls))


def test_a_frame_without_contacts_has_no_overlap(cases: list[Case]):
    figures = dict(cases[0].trajectory.diagnostics)
    for count, mean in (("contact_count", "overlap_mean"), ("wall_contact_count", "wall_overlap_mean")):
        figures |= {count: np.zeros_like(figures[count]), mean: np.full_like(figures[mean], np.nan)}
    apart = replace(cases[0], trajectory=replace(cases[0].trajectory, diagnostics=figures))
    np.testing.assert_array_equal(Windows([apart]).window(0, 0, 2).mean_overlap, np.zeros(3))


def test_a_data_set_is_known_by_its_cases_in_any_order(data: tuple[Split, Path], cases: list[Case]):
    split, root = data
    assert dataset_digest(cases) == dataset_digest(cases[::-1])
    assert dataset_digest(cases) == dataset_digest([spec.path(root) for spec in split.training])
    assert dataset_digest(cases) != dataset_digest(cases[:1])


# ---- bad input -----------------------------------------------------------------------------------------------


def test_windows_that_cannot_be_drawn_say_why(cases: list[Case]):
    with pytest.raises(DatasetError, match=r"rollout\.frames=31 is more than .* has \(30 ahead"):
        Windows(cases).draw(0, 31)
    with pytest.raises(DatasetError, match="no case to train on"):
        Windows([])
    with pytest.raises(ConfigError, match=r"startup_fraction=1\.5"):
        Windows(cases, startup_fraction=1.5)
    other = replace(cases[0], scene=replace(cases[0].scene, frame_interval=0.02))
    with pytest.raises(DatasetError, match=r"frame intervals of \[0\.01, 0\.02\] s"):
        Windows([cases[0], other])
