"""The scenes and the model that ship with the package, by name."""

from collections.abc import Mapping
from pathlib import Path

from hydra.errors import HydraException
from omegaconf import OmegaConf

import gran_bench
from gran_bench.compose import compose
from gran_bench.config import GenerateConfig, SceneConfig
from gran_bench.config.override_errors import explain
from gran_bench.config.reading import read_config, unknown_key
from gran_bench.config.rules import ConfigError, Name, check_arguments, checked_value
from gran_bench.scene import Scene, build_scene

SHIPPED = "shipped"  # the word for the default model where a model file is asked for
DEFAULT_MODEL = "holdout30rpm"


def shipped_scene(name: str, changes: Mapping[str, object] | None = None) -> Scene:
    """The scene of ``conf/scene/<name>.yaml``, with changes of keys below ``scene``: ``{"material.friction": 0.5}``.

    Raises:
        ConfigError: no such scene (names those there are), or a change that the schema does not allow.
        SceneError: a scene that cannot be.
    """
    return build_scene(shipped_scene_config(name, changes))


def shipped_scene_config(name: str, changes: Mapping[str, object] | None = None) -> SceneConfig:
    """What :func:`shipped_scene` builds a scene of; raises the same."""
    name, changes = checked_value(str, Name(), name, "scene"), {} if changes is None else changes
    check_arguments(changes=(changes, Mapping))
    try:
        composed = compose("generate", [f"scene={name}"])
    except HydraException as error:
        raise ConfigError(explain(error, GenerateConfig) or str(error)) from error
    values = OmegaConf.to_container(composed.scene, resolve=True)
    for key, value in changes.items():
        *sections, last = key.split(".")
        section = values
        for part in sections:
            section[part] = section = section.get(part) or {}
            if not isinstance(section, dict):
                raise unknown_key(f"scene.{key}", value, GenerateConfig)
        section[last] = value
    # Read as part of a whole config, so that what contradicts itself is refused as it is on the command line.
    return read_config(GenerateConfig, {"scene": values}).scene


def shipped_model(name: str = DEFAULT_MODEL) -> Path:
    """The file, for `load_model`, of a model that ships with the package, by the name of the recipe that trained it.

    Raises:
        ConfigError: no such model; names those there are.
    """
    checked_value(str, Name(), name, "model")
    package = Path(gran_bench.__file__).parent
    # An installed package carries the models; a clone has them where their results are.
    places = (package.parents[1] / "results", package / "models")
    models = {path.parent.name: path for place in places for path in place.glob("*/model.pt")}
    if name not in models:
        remedy = f"choose {' or '.join(sorted(models))}" if models else "give the file of a model of your own"
        raise ConfigError(f"model {name}: none of that name ships with the package; {remedy}")
    return models[name]
