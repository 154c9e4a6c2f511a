"""The scenes that ship with the package, by name, for use from Python."""

from __future__ import annotations

from collections.abc import Mapping

from omegaconf import OmegaConf

from gran_bench.config import SceneConfig
from gran_bench.config_check import read_config
from gran_bench.entry import compose
from gran_bench.scene import Scene, build_scene


def shipped_scene(name: str, changes: Mapping[str, object] | None = None) -> Scene:
    """The scene of ``conf/scene/<name>.yaml``.

    Args:
        name: ``drum``, ``drum_mu05``, ``drum_slice``, ``drum_small``.
        changes: dotted keys below ``scene``, such as ``{"material.friction": 0.5}``.

    Raises:
        ConfigError: a change that the schema does not allow.
        SceneError: a scene that cannot be.
        hydra.errors.MissingConfigException: no such scene; names those there are.
    """
    overrides = [f"scene.{key}={value}" for key, value in (changes or {}).items()]
    composed = compose("generate", [f"scene={name}", *overrides])
    values = OmegaConf.to_container(composed.scene, resolve=True)
    assert isinstance(values, dict)
    return build_scene(read_config(SceneConfig, values))
