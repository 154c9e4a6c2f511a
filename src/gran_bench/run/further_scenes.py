"""The cases of further scenes that a training sees beside its own: shipped scenes, of the run's own spheres."""

from dataclasses import fields, replace

from gran_bench.config import SceneConfig, TrainConfig
from gran_bench.config.rules import ConfigError, shown
from gran_bench.dataset import CaseSpec, own_case
from gran_bench.scene import SceneError, build_scene
from gran_bench.shipped import shipped_scene_config


def further_cases(config: TrainConfig) -> list[CaseSpec]:
    """The cases of ``trainer.mixture.scenes``, of each scene in turn; a drum has one for each speed.

    Raises:
        ConfigError: no such scene; one whose spheres differ from each other; one that turns at a held-out speed.
    """
    mixture, data = config.trainer.mixture, config.dataset
    speeds = mixture.speeds_rpm or data.training_speeds_rpm
    cases: list[CaseSpec] = []
    for name in mixture.scenes:
        try:
            further = of_the_same_spheres(shipped_scene_config(name), config.scene)
            scene = build_scene(further)
        except (ConfigError, SceneError) as error:
            raise ConfigError(f"trainer.mixture.scenes={shown(mixture.scenes)}: {error}") from error
        given = f"trainer.mixture.scenes={shown(mixture.scenes)}: {name}"
        if scene.takes_speeds:
            cases += [CaseSpec(scene.at_speed(speed), config.dem, data.packing_seed) for speed in speeds]
            continue
        if further.filling.positions or further.filling.sizes.kind != "one" or scene.more_materials:
            raise ConfigError(f"{given} has spheres of its own; choose a drum or packing")
        low, high = min(map(abs, scene.rotation.speeds_rpm)), max(map(abs, scene.rotation.speeds_rpm))
        for speed in (*data.validation_speeds_rpm, *data.holdout_speeds_rpm):
            if low <= abs(speed) <= high:
                raise ConfigError(f"{given} turns at {speed:g} rpm, which no training may see; leave it out")
        cases.append(own_case(scene, config.dem, data))
    return cases


def of_the_same_spheres(further: SceneConfig, own: SceneConfig) -> SceneConfig:
    """A scene at the size of another's spheres: its lengths in diameters and its times in frames stay as they are.

    Diameter, materials, gravity and frame interval are those of ``own``.
    """
    length, time = own.filling.diameter / further.filling.diameter, own.frame_interval / further.frame_interval
    container, rotation = further.container, further.rotation
    sizes = {e.name: length * getattr(container, e.name) for e in fields(container) if _is_length(e.metadata)}
    times = {name: time * getattr(further, name) for name in ("start_time", "end_time")}
    return replace(
        further,
        **times,
        container=replace(container, **sizes),
        filling=replace(further.filling, diameter=own.filling.diameter),
        rotation=replace(rotation, times=[time * knot for knot in rotation.times]),
        material=own.material,
        wall_material=own.wall_material,
        gravity=own.gravity,
        frame_interval=own.frame_interval,
        coarse_graining=own.coarse_graining,
        coarse_friction=own.coarse_friction,
        coarse_rolling_friction=own.coarse_rolling_friction,
    )


def _is_length(metadata: dict) -> bool:
    rule = metadata.get("rule")
    return getattr(rule, "unit", "") == "m"
