"""Which config values fit together: times in order, frames that divide a span, splits that do not overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

from gran_bench.config import (
    BenchmarkConfig,
    CconvModelConfig,
    ContactModelConfig,
    DatasetConfig,
    DemConfig,
    EvaluateConfig,
    GenerateConfig,
    JudgeConfig,
    SceneConfig,
    TrainConfig,
)
from gran_bench.config.choices import check_choices
from gran_bench.config.registry import HOUSE, WALLS
from gran_bench.config.rules import ConfigError, Section, shown

# What rooms further on can do, said here because a config is refused before they are loaded; a test holds them equal.
FUSED_SIZES = (16, 4)  # model.hidden and model.channels that the contact network's kernel is compiled for
LONGEST_HORIZON = 10  # frames ahead that the short-horizon errors look


def check_consistency(config: object) -> None:
    """Hold the values of a whole config against each other.

    Args:
        config: of a command, with values that are legal each by itself; sections alone have nothing to contradict.

    Raises:
        ConfigError: names a dotted key, its value, what it contradicts and the remedy.
    """
    if isinstance(config, TrainConfig | GenerateConfig):
        _check_scene(config.scene)
        _check_speeds(config.scene, config.dataset)
    if isinstance(config, TrainConfig | GenerateConfig | EvaluateConfig):
        check_dem(config.dem)
        _check_dataset(config.dataset)
    if isinstance(config, BenchmarkConfig):
        _check_benchmark(config)
    if isinstance(config, TrainConfig):
        _check_trainable(config.scene)
        check_model(config.model)
        _check_training(config)
        check_choices(config)
    if isinstance(config, TrainConfig | EvaluateConfig):
        _check_judge(config.judge, config.dataset)
        _check_device(config.device)


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise ConfigError(message)


def _check_scene(scene: SceneConfig) -> None:
    filling = scene.filling
    _require(len(scene.gravity) == 3, f"scene.gravity={scene.gravity} is no vector; give three components")
    check_schedule(scene.rotation.times, scene.rotation.speeds_rpm, "scene.rotation.speeds_rpm", "scene.rotation.times")
    check_end(scene)
    check_frames(scene)
    check_filling(filling)
    if scene.container.kind != "none" and WALLS.owner(scene.container.kind) == HOUSE:
        for name in ("diameter", "width", "length", "height", "orifice"):
            room = getattr(scene.container, name, filling.diameter * 2.0)
            _require(
                filling.diameter < room,
                f"scene.filling.diameter={filling.diameter:g} does not fit into scene.container.{name}={room:g}; "
                "choose smaller spheres",
            )
    _check_materials(scene)


def check_dem(dem: DemConfig) -> None:
    """Hold the values of a solver's settings against each other.

    Raises:
        ConfigError: names a key, its value, what it contradicts and the remedy.
    """
    _require(
        dem.precision == "float64" or dem.engine == "numba",
        f"dem.precision={dem.precision} is for dem.engine=numba; dem.engine={dem.engine} computes in float64 alone",
    )


def check_schedule(times: Sequence[float], rates: Sequence, rates_name: str, times_name: str) -> None:
    """Refuse a schedule without knots, without one rate for each, or whose times go back.

    Raises:
        ConfigError: names the key, its values and the remedy.
    """
    times, rates = list(times), list(rates)
    _require(
        len(times) == len(rates) > 0,
        f"{rates_name}={shown(rates)} does not match {times_name}={shown(times)}; give one speed for each time",
    )
    _require(times == sorted(times), f"{times_name}={shown(times)} goes back in time; sort it")


def check_end(scene: Any) -> None:
    """Refuse a scene, or the config of one, that ends before it starts.

    Raises:
        ConfigError: names the key, its value and the remedy.
    """
    _require(
        scene.end_time > scene.start_time,
        f"scene.end_time={scene.end_time:g} is not after scene.start_time={scene.start_time:g}; choose more",
    )


def check_frames(scene: Any) -> None:
    """Refuse a scene, or the config of one, whose span is no whole number of frames.

    Raises:
        ConfigError: names the key, its value and the remedy.
    """
    span = scene.end_time - scene.start_time
    frames = span / scene.frame_interval
    _require(
        abs(frames - round(frames)) < 1e-6 and round(frames) >= 1,
        f"scene.frame_interval={scene.frame_interval:g} does not divide the {span:g} s from scene.start_time to "
        "scene.end_time into whole frames; change one of the three",
    )


def check_filling(filling: Any) -> None:
    """Refuse a filling, or the config of one, whose spheres overlap or are not all placed.

    Raises:
        ConfigError: names the key, its value and the remedy.
    """
    largest = (filling.lattice_spacing - 1.0) / 2.0
    _require(
        filling.jitter <= largest + 1e-12,
        f"scene.filling.jitter={filling.jitter:g} lets spheres overlap at a spacing of "
        f"{filling.lattice_spacing:g} diameters; choose at most {largest:.3g}",
    )
    for name in ("positions", "velocities", "spins"):
        rows = getattr(filling, name)
        _require(
            all(len(row) == 3 for row in rows) and len(rows) in (0, filling.count),
            f"scene.filling.{name} does not give three numbers for each of scene.filling.count={filling.count} "
            "spheres; give them, or [] for none",
        )
    _require(
        len(filling.radii) in (0, filling.count if filling.positions else 0),
        f"scene.filling.radii has {len(filling.radii)} entries for {len(filling.positions)} scene.filling.positions; "
        "give one for each placed sphere, or [] for none",
    )
    _require(
        not filling.radii or filling.sizes.kind == "one",
        f"scene.filling.sizes.kind={filling.sizes.kind} and scene.filling.radii both say how large the spheres are; "
        "give one of them",
    )


def _check_materials(scene: SceneConfig) -> None:
    filling = scene.filling
    _require(
        scene.second_material is not None or filling.second_fraction == 0,
        f"scene.filling.second_fraction={filling.second_fraction:g} needs a second material; describe it "
        "(+scene.second_material.density=7800)",
    )
    for entry in fields(scene.mixed):
        value = getattr(scene.mixed, entry.name)
        _require(
            scene.second_material is not None or value is None,
            f"scene.mixed.{entry.name}={value} is of contacts with a second material, and there is none; describe it "
            "(+scene.second_material.density=7800) or leave the key null",
        )


def _check_trainable(scene: SceneConfig) -> None:
    kind, speeds = scene.container.kind, scene.rotation.speeds_rpm
    _require(
        scene.filling.count >= 1,
        f"scene.filling.count={scene.filling.count} leaves nothing to learn from; choose a value ≥ 1",
    )
    _require(
        kind != "none",
        "scene.container.kind=none has no container that could turn at the speeds of a data set, so there is nothing "
        "to train on; choose a drum",
    )
    _require(
        WALLS[kind].drum,
        f"scene.container.kind={kind} does not turn, so it makes one case and no data set to train on; choose a drum "
        "(python -m gran_bench.generate makes the case)",
    )
    _require(
        len(set(speeds)) == 1,
        f"scene.rotation.speeds_rpm={speeds} is a schedule, which its one case keeps, so there is no data set to train "
        "on; train on a drum with one speed",
    )
    unlike = [
        name
        for name, differs in (
            ("filling.sizes.kind", scene.filling.sizes.kind != "one"),
            ("filling.second_fraction", scene.filling.second_fraction != 0),
            ("filling.settles", not scene.filling.settles),
            ("filling.positions", bool(scene.filling.positions)),
        )
        if differs
    ]
    _require(
        not unlike,
        f"scene.{unlike[0] if unlike else ''} makes spheres that the surrogates cannot tell apart or do not start from "
        "a settled bed; train on a drum of equal spheres",
    )


def _check_speeds(scene: SceneConfig, dataset: DatasetConfig) -> None:
    takes_speeds = WALLS[scene.container.kind].drum and len(set(scene.rotation.speeds_rpm)) == 1
    _require(
        len(dataset.training_speeds_rpm) > 0 or not takes_speeds,
        "dataset.training_speeds_rpm=[] leaves nothing to train on; give at least one speed",
    )


def _check_dataset(dataset: DatasetConfig) -> None:
    seen: dict[float, str] = {}
    for name in ("training_speeds_rpm", "validation_speeds_rpm", "holdout_speeds_rpm"):
        for speed in getattr(dataset, name):
            _require(
                speed not in seen,
                f"dataset.{name}={getattr(dataset, name)} has {speed:g} rpm, which dataset.{seen.get(speed)} has "
                "already; a speed belongs to one split, once",
            )
            _require(
                seen.get(-speed, name) == name,
                f"dataset.{name}={getattr(dataset, name)} has {speed:g} rpm, whose mirror image "
                f"dataset.{seen.get(-speed)} has; keep both in one split",
            )
            seen[speed] = name
    _require(
        dataset.unseen_packing_seed != dataset.packing_seed,
        f"dataset.unseen_packing_seed={dataset.unseen_packing_seed} is the seed of dataset.packing_seed, "
        "so the packing would not be unseen; choose another",
    )


def _check_judge(judge: JudgeConfig, dataset: DatasetConfig) -> None:
    _require(
        len(dataset.holdout_speeds_rpm) == 1,
        f"dataset.holdout_speeds_rpm={dataset.holdout_speeds_rpm} is not one speed; one held-out case is judged",
    )
    made = {*dataset.training_speeds_rpm, *dataset.validation_speeds_rpm, *dataset.holdout_speeds_rpm}
    for speed in judge.speeds_rpm:
        _require(
            speed in made,
            f"judge.speeds_rpm={judge.speeds_rpm} has {speed:g} rpm, which no split of dataset has; "
            f"choose from {sorted(made)}",
        )


def _check_benchmark(config: BenchmarkConfig) -> None:
    speeds, profile = config.dataset.holdout_speeds_rpm, config.profile
    _require(
        not config.dataset.files,
        f"dataset.files={config.dataset.files}: the benchmark times the DEM that makes the data; leave it empty",
    )
    _require(
        len(speeds) == 1,
        f"dataset.holdout_speeds_rpm={speeds} is not one speed; methods are compared at one held-out speed",
    )
    _require(
        1.0 in profile.step_multiples,
        f"profile.step_multiples={profile.step_multiples} lacks the automatic step, which all times are held against; "
        "add 1",
    )
    _require(
        profile.judged_rounds <= profile.rounds,
        f"profile.judged_rounds={profile.judged_rounds} is more than profile.rounds={profile.rounds}; "
        "choose at most that",
    )
    for name in ("step_multiples", "single_multiples", "soft_moduli", "soft_multiples", "stiffness", "counts"):
        values = getattr(profile, name)
        _require(
            len(values) == len(set(values)),
            f"profile.{name}={values} has a value twice; a method is compared once",
        )
    _require(
        config.scene.filling.count >= 1,
        f"scene.filling.count={config.scene.filling.count} leaves nothing to compare; choose a value ≥ 1",
    )


def _check_device(device: str) -> None:
    if device != "cuda":
        return
    import torch  # only here: it loads for seconds

    _require(
        torch.cuda.is_available(),
        "device=cuda needs a CUDA device that PyTorch can use, and there is none; choose device=cpu or device=auto",
    )


def check_model(model: Section) -> None:
    """Hold the values of a model of the house against each other.

    Raises:
        ConfigError: names a key, its value, what it contradicts and the remedy.
    """
    if isinstance(model, CconvModelConfig):
        wanted = "radial" if model.name == "radial" else "lattice"
        other = next(name for name in ("ccnn", "radial") if name != model.name)
        _require(
            model.kernel == wanted,
            f"model.kernel={model.kernel} is not the kernel of model={model.name}; choose model={other}",
        )
        _require(model.width % 2 == 0, f"model.width={model.width} cannot be split in two halves; choose an even width")
    if isinstance(model, ContactModelConfig):
        _require(
            model.backend != "fused" or (model.hidden, model.channels) == FUSED_SIZES,
            f"model.hidden={model.hidden} with model.channels={model.channels} is not what model.backend=fused is "
            f"compiled for; choose {FUSED_SIZES[0]} and {FUSED_SIZES[1]}, or model.backend=torch",
        )


def _check_training(config: TrainConfig) -> None:
    optim = config.optim
    available = round((config.scene.end_time - config.scene.start_time) / config.scene.frame_interval)
    _require(
        available >= LONGEST_HORIZON,
        f"scene.end_time={config.scene.end_time:g} makes cases of {available} frames; judging looks {LONGEST_HORIZON} "
        "frames ahead, so choose a later end",
    )
    _require(
        config.trainer.budget != "time" or config.trainer.minutes is not None,
        "trainer.budget=time needs minutes to spend, and trainer.minutes is null; give trainer.minutes",
    )
    _require(
        optim.final_learning_rate <= optim.learning_rate,
        f"optim.final_learning_rate={optim.final_learning_rate:g} exceeds optim.learning_rate="
        f"{optim.learning_rate:g}; choose at most that",
    )
