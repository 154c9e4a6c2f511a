"""``python -m gran_bench.import_case FILE --scene SCENE``: the scene, the span, the file, and how to train on it."""

import argparse
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

import hydra
import numpy as np
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from gran_bench.compose import CONFIG_MODULE, VERSION_BASE
from gran_bench.config import GenerateConfig
from gran_bench.config.override_errors import explain
from gran_bench.config.reading import read_config
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import read_case
from gran_bench.import_case.arrays import import_arrays
from gran_bench.import_case.reading import read_trajectory
from gran_bench.processes import run_command
from gran_bench.scene import Scene, SceneError, build_scene
from gran_bench.shipped import shipped_scene


def import_command(words: Sequence[str] | None = None) -> int:
    """Make a case of the trajectory that a command line names; the exit code."""
    parser = argparse.ArgumentParser(
        "python -m gran_bench.import_case", description="Make a case of another code's run."
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
    return run_command(parser, _import, words)


def _import(chosen: argparse.Namespace) -> None:
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
    path = import_arrays(scene=scene, root=chosen.data, source=" ".join(map(str, chosen.files)), **options, **found)
    case = read_case(path).scene
    print(f"{case.filling.count} spheres, {case.frame_count} frames every {case.frame_interval:g} s: {path}")
    keys = {"filling.count": (scene.filling.count, case.filling.count)}
    keys |= {name: (getattr(scene, name), getattr(case, name)) for name in ("frame_interval", "end_time")}
    changed = "".join(f" scene.{name}={new:.12g}" for name, (old, new) in keys.items() if new != old)
    if scene.takes_speeds:
        if chosen.speed is None:
            taken = f"{case.rotation.speeds_rpm[0]:g} rpm, the speed of scene {scene.name!r}"
            print(f"taken for a run at {taken}; where it had another, import it again with --speed RPM")
        changed = f" dataset.training_speeds_rpm=[…] dataset.holdout_speeds_rpm=[…]{changed}"
    print(f"to train on it and others of its scene: dataset=imported dataset.files=[{path.parent}]{changed}")


def named_scene(name: str) -> Scene:
    """The scene of a YAML file, whose ``defaults`` name files beside it or shipped scenes, or a shipped one by name.

    Raises:
        ConfigError: no such file or scene, or a value that no scene can have.
        SceneError: a scene that cannot be.
    """
    path = Path(name).resolve()
    if path.suffix != ".yaml":
        return shipped_scene(name)
    try:
        with hydra.initialize_config_dir(str(path.parent), version_base=VERSION_BASE):
            values = hydra.compose(path.stem, [f"hydra.searchpath=['file://{resources.files(CONFIG_MODULE)}/scene']"])
    except (HydraException, OmegaConfBaseException, UnicodeDecodeError, YAMLError) as error:
        raise ConfigError(f"--scene {name} cannot be read: {explain(error, GenerateConfig) or error}") from error
    return build_scene(read_config(GenerateConfig, {"scene": OmegaConf.to_container(values, resolve=True)}).scene)
