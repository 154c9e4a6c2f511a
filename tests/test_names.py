"""A name that a user gives is never a path: one rule for all of them, on the command line and in the library."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gran_bench.comparison.command import run_benchmark
from gran_bench.composition import PlannedJob, run_folder
from gran_bench.config import BenchmarkConfig, EvaluateConfig, SceneConfig, TrainConfig
from gran_bench.config_check import read_config
from gran_bench.config_rules import LONGEST_NAME, ConfigError
from gran_bench.experiment import run_evaluation, run_experiment
from gran_bench.shipped import shipped_model, shipped_scene
from gran_bench.sweep_run import open_sweep

PATHS = ["../../evil", "x/y", "..", ".", ".hidden", "/tmp/evil", "x\\y", "~", "a b", "$HOME", "*", "x\ny", "n" * 151]
NAMES = {
    "tracking.folder": TrainConfig,
    "tracking.sweep": TrainConfig,
    "experiment": TrainConfig,
    "scene.name": TrainConfig,
    "profile.name": BenchmarkConfig,
}


def nested(key: str, value: str) -> dict:
    """``{"a": {"b": value}}`` for ``a.b``, with the scene's name where the schema must have one."""
    section, _, name = key.rpartition(".")
    values = {section: {name: value}} if section else {name: value}
    values.setdefault("scene", {}).setdefault("name", "drum")
    return values


@pytest.mark.parametrize("value", PATHS, ids=repr)
@pytest.mark.parametrize("key", NAMES)
def test_a_name_that_could_be_a_path_is_refused_with_field_value_and_remedy(key: str, value: str):
    with pytest.raises(ConfigError) as told:
        read_config(NAMES[key], nested(key, value))
    said = str(told.value)
    assert said.startswith(f"{key}={value} is impossible; choose a name, which is never a path: letters, digits, ")


@pytest.mark.parametrize("value", ["smoke", "sweep_radius+model-radial-0.08", "2nd", "Trommel-größer"])
@pytest.mark.parametrize("key", NAMES)
def test_a_plain_name_is_taken(key: str, value: str):
    read_config(NAMES[key], nested(key, value))


@pytest.fixture
def config(tmp_path: Path) -> TrainConfig:
    """A config that would write below ``tmp_path/a/b``."""
    config = TrainConfig(scene=SceneConfig(name="drum"))
    config.dataset.root = config.tracking.root = str(tmp_path / "a" / "b")
    return config


def test_the_library_refuses_as_the_command_line_does_before_any_work(config: TrainConfig, tmp_path: Path):
    config.tracking.folder = "../../evil"
    with pytest.raises(ConfigError, match=r"^tracking\.folder=\.\./\.\./evil is impossible"):
        run_experiment(config)
    config.tracking.folder, config.tracking.sweep = None, "../../evil"
    with (
        pytest.raises(ConfigError, match=r"^tracking\.sweep=\.\./\.\./evil is impossible"),
        open_sweep([PlannedJob("run", {}, config)], "sweep"),
    ):
        pass
    compared = BenchmarkConfig(scene=replace(config.scene, name="../evil"), root=str(tmp_path / "a" / "b"))
    with pytest.raises(ConfigError, match=r"^scene\.name=\.\./evil is impossible"):
        run_benchmark(compared)
    judged = EvaluateConfig(checkpoint=str(shipped_model()), tracking=config.tracking)
    with pytest.raises(ConfigError, match=r"^tracking\.sweep="):
        run_evaluation(judged)
    assert list(tmp_path.iterdir()) == []


def test_what_ships_is_found_by_name_alone():
    with pytest.raises(ConfigError, match=r"^scene=\.\./scene/drum is impossible; choose a name"):
        shipped_scene("../scene/drum")
    with pytest.raises(ConfigError, match=r"^model=\.\./models/holdout30rpm is impossible; choose a name"):
        shipped_model("../models/holdout30rpm")


@pytest.mark.parametrize("letter", ["n", "é", "粒"])
def test_the_name_of_a_long_command_fits_into_a_folder_in_any_script(letter: str):
    name = run_folder(letter * 100, [f"+note={letter * 100}", "seed=1"])
    assert len(name.encode()) <= LONGEST_NAME
    read_config(TrainConfig, nested("tracking.folder", name))
    assert name != run_folder(letter * 100, [f"+note={letter * 100}", "seed=2"])
