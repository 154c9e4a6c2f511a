"""The command around an import: the scene, the span, the file, and how to train on it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from hydra.errors import HydraException
from omegaconf import OmegaConf

from gran_bench.compose import compose
from gran_bench.config import GenerateConfig
from gran_bench.config.override_errors import explain
from gran_bench.config.reading import read_config
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import DatasetError, read_case
from gran_bench.import_case.arrays import import_arrays
from gran_bench.import_case.reading import read_trajectory
from gran_bench.scene import Scene, SceneError, build_scene
from gran_bench.state import StateError

FAILED, REFUSED = 1, 2


def import_command(words: Sequence[str] | None = None) -> int:
    """Import what a command line names.

    Args:
        words: of the command line.

    Returns:
        The exit code: 0; 1 where the case cannot be written; 2 where the data or the scene are refused.
    """
    parser = argparse.ArgumentParser(
        "python -m gran_bench.import_case", description="Make a case of a trajectory of another code."
    )
    add = parser.add_argument
    add("files", nargs="+", type=Path, metavar="FILE", help="text dumps of LAMMPS or LIGGGHTS (also .gz), or an .npz")
    add("--scene", required=True, metavar="YAML", help="a scene's YAML file, or the name of a shipped scene")
    add("--speed", type=float, metavar="RPM", help="of a drum; default: the scene's rotation")
    add("--time-step", type=float, metavar="S", help="of a dump that counts steps")
    add("--frame-interval", type=float, metavar="S", help="of data without times")
    add("--from", dest="start", type=float, metavar="S", help="in the clock of the data: leave out what is before")
    add("--type", type=int, nargs="+", default=[], help="of the spheres to import, where there are others")
    add("--trajectory", type=int, metavar="K", help="of an .npz that has several, from 0")
    add("--packing", type=int, default=0, metavar="K", help="number of the settled bed it starts from (default: 0)")
    add("--replica", type=int, default=0, metavar="K", help="number of a nudged run of the same start: a noise floor")
    add("--name", help="of the case's file; default: scene, speed, packing, replica and a hash")
    add("--data", type=Path, default=Path("data"), help="data cache (default: data)")
    chosen = parser.parse_args(words)
    try:
        scene = named_scene(chosen.scene)
        if chosen.speed is not None and not scene.takes_speeds:
            raise SceneError(f"--speed {chosen.speed:g}: scene {scene.name!r} keeps its own motion; leave it out")
        scene = scene if chosen.speed is None else scene.at_speed(chosen.speed)
        found = read_trajectory(chosen.files, chosen.time_step, chosen.type, chosen.trajectory)
        if chosen.start is not None and "time" in found:
            kept = found["time"] >= chosen.start - 1e-7 * scene.frame_interval
            print(f"{kept.sum()} of {len(kept)} frames are from {chosen.start:g} s on")
            found |= {name: found[name][kept] for name in found if name == "time" or np.ndim(found[name]) > 1}
        options = {name: getattr(chosen, name) for name in ("frame_interval", "packing", "replica", "name")}
        source = " ".join(map(str, chosen.files))
        path = import_arrays(scene=scene, root=chosen.data, source=source, **options, **found)
    except BrokenPipeError:
        raise
    except (ConfigError, DatasetError, SceneError, StateError) as error:
        print(f"error: {error}", file=sys.stderr)
        return REFUSED
    except OSError as error:
        print(f"error: {error.filename}: {error.strerror or error}; choose another --data", file=sys.stderr)
        return FAILED
    case = read_case(path).scene
    print(f"{case.filling.count} spheres, {case.frame_count} frames every {case.frame_interval:g} s: {path}")
    keys = {"filling.count": (scene.filling.count, case.filling.count)}
    keys |= {name: (getattr(scene, name), getattr(case, name)) for name in ("frame_interval", "end_time")}
    changed = "".join(f" scene.{name}={new:.12g}" for name, (old, new) in keys.items() if new != old)
    print(f"to train on it and others of its scene: dataset=imported dataset.files=[{path.parent}]{changed}")
    return 0


def named_scene(name: str) -> Scene:
    """The scene of a YAML file, or a shipped one by its name.

    Args:
        name: of a file (``defaults`` names files beside it or shipped scenes, as for Hydra), or of a shipped scene.

    Raises:
        ConfigError: no such file or scene, or a value that no scene can have.
        SceneError: a scene that cannot be.
    """
    return build_scene(read_config(GenerateConfig, {"scene": _values(name)}).scene)


def _values(name: str) -> dict[str, Any]:
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        try:
            return OmegaConf.to_container(compose("generate", [f"scene={name}"]).scene, resolve=True)
        except HydraException as error:
            said = explain(error, GenerateConfig) or str(error).splitlines()[0]
            raise ConfigError(f"--scene {name}: {said}; or give a YAML file") from error
    try:
        own = OmegaConf.to_container(OmegaConf.load(path))  # which knows 1.0e7 for a number; PyYAML does not
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"--scene {name} cannot be read: {str(error).splitlines()[0]}") from error
    if not isinstance(own, dict):
        raise ConfigError(f"--scene {name} holds no keys; give container, motion, material and diameter of a scene")
    values: dict[str, Any] = {}
    for base in own.pop("defaults", []):
        if base != "_self_":
            beside = path.with_name(f"{base}.yaml")
            more = _values(str(beside) if beside.is_file() else str(base))
            values = OmegaConf.to_container(OmegaConf.merge(values, more))
    return OmegaConf.to_container(OmegaConf.merge(values, own))
