"""A name that a user gives is never a path: one rule for all of them, on the command line and in the library."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gran_bench.compose import run_folder
from gran_bench.config import BenchmarkConfig, SceneConfig, TrackingConfig, TrainConfig
from gran_bench.config.reading import read_config
from gran_bench.config.rules import LONGEST_NAME, ConfigError, shown
from gran_bench.shipped import shipped_model, shipped_scene

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
    said = f"{key}={shown(value)} is impossible; choose a name, which is never a path: letters, digits, "
    assert str(told.value).startswith(said)


@pytest.mark.parametrize("value", ["smoke", "sweep_radius+model-radial-0.08", "2nd", "Trommel-größer"])
@pytest.mark.parametrize("key", NAMES)
def test_a_plain_name_is_taken(key: str, value: str):
    read_config(NAMES[key], nested(key, value))


def test_the_library_refuses_a_path_where_it_is_put():
    config = TrainConfig(scene=SceneConfig(name="drum"))
    with pytest.raises(ConfigError, match=r"^tracking\.folder=\.\./\.\./evil is impossible"):
        config.tracking.folder = "../../evil"
    with pytest.raises(ConfigError, match=r"^tracking\.sweep=\.\./\.\./evil is impossible"):
        TrackingConfig(sweep="../../evil")
    with pytest.raises(ConfigError, match=r"^scene\.name=\.\./evil is impossible"):
        replace(config.scene, name="../evil")


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
