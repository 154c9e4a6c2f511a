"""Which config values fit together: times in order, frames that divide a span, splits that do not overlap."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

from gran_bench.config import schema
from gran_bench.config.choices import check_choices
from gran_bench.config.commands import CalibrateConfig, CoarseGrainingConfig
from gran_bench.config.convolution import ConvolutionConfig
from gran_bench.config.registry import HOUSE, MODELS, WALLS
from gran_bench.config.rules import ConfigError, Section, raising, shown

# What rooms further on can do, said here because a config is refused before they are loaded; a test holds them equal.
FUSED_SIZES = (16, 4)  # model.hidden and model.channels that the contact network's kernel is compiled for
LONGEST_HORIZON = 10  # frames ahead that the short-horizon errors look
LEAST_COARSE = 10  # spheres that coarse-graining may leave: fewer are no bed
SPLITS = ("training_speeds_rpm", "validation_speeds_rpm", "holdout_speeds_rpm")


def check_consistency(config: object) -> None:
    """Refuse, as a `ConfigError`, values of a command's config that contradict each other; each by itself is legal."""
    if isinstance(config, schema.TrainConfig | schema.GenerateConfig):
        _check_scene(config.scene, config.dataset)
    if isinstance(config, schema.TrainConfig | schema.GenerateConfig | schema.EvaluateConfig):
        check_dem(config.dem)
        _check_dataset(config.dataset)
    if isinstance(config, schema.BenchmarkConfig):
        _check_benchmark(config)
    if isinstance(config, CoarseGrainingConfig) and len(config.dataset.holdout_speeds_rpm) != 1:
        given = f"dataset.holdout_speeds_rpm={config.dataset.holdout_speeds_rpm}"
        raise ConfigError(f"{given} is not one speed; coarse-grained DEMs are judged at one held-out speed")
    if isinstance(config, CalibrateConfig):
        _check_calibration(config)
    if isinstance(config, schema.TrainConfig):
        _check_training(config)
        check_model(config.model)
        check_choices(config)
    if isinstance(config, schema.TrainConfig | schema.EvaluateConfig):
        _check_judge(config)


@raising
def check_dem(dem: schema.DemConfig) -> Iterator[str]:
    """Refuse, as a `ConfigError`, settings of the solver that contradict each other."""
    if dem.precision != "float64" and dem.engine != "numba":
        yield f"dem.precision={dem.precision} is for dem.engine=numba; dem.engine={dem.engine} computes in float64"
    if dem.engine == "lammps" and dem.slip != "full_radius":
        yield f"dem.slip={dem.slip} is no law of dem.engine=lammps; choose dem.slip=full_radius, which is its law"
    if dem.engine == "lammps" and dem.power:
        yield "dem.power=true is for dem.engine=numba or numpy; dem.engine=lammps counts no energy"
    if dem.engine != "lammps" and dem.ranks != 1:
        yield f"dem.ranks={dem.ranks} is for dem.engine=lammps; dem.engine={dem.engine} has dem.threads"


@raising
def check_schedule(times: Sequence[float], rates: Sequence, rates_name: str, times_name: str) -> Iterator[str]:
    """Refuse, as a `ConfigError`, a schedule without knots, without one rate for each, or whose times go back."""
    times, rates = list(times), list(rates)
    if not len(times) == len(rates) > 0:
        yield f"{rates_name}={shown(rates)} does not match {times_name}={shown(times)}; give one speed for each time"
    if times != sorted(times):
        yield f"{times_name}={shown(times)} goes back in time; sort it"


@raising
def check_end(scene: Any) -> Iterator[str]:
    """Refuse, as a `ConfigError`, a scene, or the config of one, that ends before it starts."""
    if scene.end_time <= scene.start_time:
        yield f"scene.end_time={scene.end_time:g} is not after scene.start_time={scene.start_time:g}; choose more"


@raising
def check_frames(scene: Any) -> Iterator[str]:
    """Refuse, as a `ConfigError`, a scene, or the config of one, whose span is no whole number of frames."""
    span, frame = scene.end_time - scene.start_time, scene.frame_interval
    if abs(span / frame - round(span / frame)) >= 1e-6 or round(span / frame) < 1:
        remedy = "change it, scene.start_time or scene.end_time"
        yield f"scene.frame_interval={frame:g} does not divide the {span:g} s of the scene into whole frames; {remedy}"


@raising
def check_filling(filling: Any) -> Iterator[str]:
    """Refuse, as a `ConfigError`, a filling, or its config, whose spheres overlap or are not all placed."""
    key, spacing, count = "scene.filling", filling.lattice_spacing, filling.count
    largest = (spacing - 1.0) / 2.0
    if filling.jitter > largest + 1e-12:
        given = f"{key}.jitter={filling.jitter:g}"
        yield f"{given} lets spheres overlap at a spacing of {spacing:g} diameters; choose at most {largest:.3g}"
    for name in ("positions", "velocities", "spins"):
        rows = getattr(filling, name)
        if any(len(row) != 3 for row in rows) or len(rows) not in (0, count):
            remedy = "give them, or [] for none"
            yield f"{key}.{name} does not give three numbers for each of {key}.count={count} spheres; {remedy}"
    radii, places = len(filling.radii), len(filling.positions)
    if radii not in (0, count if places else 0):
        yield f"{key}.radii has {radii} entries for {places} {key}.positions; give one for each, or [] for none"
    if radii and filling.sizes.kind != "one":
        yield f"{key}.sizes.kind={filling.sizes.kind} and {key}.radii both say how large the spheres are; give one"


@raising
def check_coarse_graining(factor: float, filling: Any) -> Iterator[str]:
    """Refuse, as a `ConfigError`, a coarse-graining of a filling, or its config, that leaves no bed to look at."""
    given, count = f"scene.coarse_graining={factor:g}", filling.count
    if len(filling.positions):
        yield f"{given} replaces spheres of a lattice, and scene.filling.positions places them; leave it at 1"
    if count < LEAST_COARSE:
        yield f"{given} replaces spheres, and scene.filling.count={count} gives too few; leave it at 1"
    if (left := round(count / factor**3)) < LEAST_COARSE:
        largest = math.floor(100.0 * (count / LEAST_COARSE) ** (1.0 / 3.0)) / 100.0
        yield f"{given} leaves {left} of scene.filling.count={count} spheres, no bed; choose at most {largest:g}"


@raising
def check_model(model: Section) -> Iterator[str]:
    """Refuse, as a `ConfigError`, values of a model of the house that contradict each other."""
    if isinstance(model, ConvolutionConfig):
        kernels = {"ccnn": "lattice", "radial": "radial"}
        if model.kernel != kernels.get(model.name, model.kernel):
            other = "ccnn" if model.name == "radial" else "radial"
            yield f"model.kernel={model.kernel} is not the kernel of model={model.name}; choose model={other}"
        if model.width % 2:
            yield f"model.width={model.width} cannot be split in two halves; choose an even width"
    fused = isinstance(model, schema.ContactModelConfig) and model.backend == "fused"
    if fused and (model.hidden, model.channels) != FUSED_SIZES:
        given = f"model.hidden={model.hidden} with model.channels={model.channels}"
        remedy = "choose {} and {}, or model.backend=torch".format(*FUSED_SIZES)
        yield f"{given} is not what model.backend=fused is compiled for; {remedy}"


@raising
def _check_scene(scene: schema.SceneConfig, dataset: schema.DatasetConfig) -> Iterator[str]:
    filling, kind, rotation = scene.filling, scene.container.kind, scene.rotation
    if len(scene.gravity) != 3:
        yield f"scene.gravity={scene.gravity} is no vector; give three components"
    check_schedule(rotation.times, rotation.speeds_rpm, "scene.rotation.speeds_rpm", "scene.rotation.times")
    check_end(scene)
    check_frames(scene)
    check_filling(filling)
    for name, absolute in (("settled_froude", "settled_speed"), ("longest_settling_fall_times", "longest_settling")):
        if filling.settles and filling.count and not any(scene.gravity) and getattr(filling, absolute) is None:
            given = f"scene.filling.{name}={getattr(filling, name):g}"
            yield f"{given} is measured with gravity, and scene.gravity is 0; give scene.filling.{absolute}"
    for name in ("diameter", "width", "length", "height", "orifice"):
        room = getattr(scene.container, name, None)
        diameter = scene.coarse_graining * filling.diameter
        if kind != "none" and WALLS.owner(kind) == HOUSE and room is not None and diameter >= room:
            given = f"scene.filling.diameter={filling.diameter:g}"
            given += f" times scene.coarse_graining={scene.coarse_graining:g}" * (diameter > filling.diameter)
            yield f"{given} does not fit into scene.container.{name}={room:g}; choose smaller spheres"
    if scene.coarse_graining > 1.0:
        check_coarse_graining(scene.coarse_graining, filling)
        if dataset.files:
            given = f"scene.coarse_graining={scene.coarse_graining:g}"
            yield f"{given} replaces spheres that are to be made, and dataset.files={dataset.files} are; leave it at 1"
    for name in ("friction", "rolling_friction"):
        if scene.coarse_graining == 1.0 and (own := getattr(scene, f"coarse_{name}")) is not None:
            given = f"scene.coarse_{name}={own:g} is of coarse spheres, and scene.coarse_graining=1 makes none"
            yield f"{given}; change scene.material.{name}"
    if scene.second_material is None:
        describe = "describe it (+scene.second_material.density=7800)"
        if filling.second_fraction != 0:
            yield f"scene.filling.second_fraction={filling.second_fraction:g} needs a second material; {describe}"
        for name, value in asdict(scene.mixed).items():
            if value is not None:
                yield f"scene.mixed.{name}={value} is of a second material, and there is none; {describe} or give null"
    if takes_speeds(scene):
        if not dataset.training_speeds_rpm:
            yield "dataset.training_speeds_rpm=[] leaves nothing to train on; give at least one speed"
        if packings := dataset.training_packings:
            given = f"dataset.training_packings={packings}: the cases of a drum are its speeds, all from one packing"
            yield f"{given}; choose dataset.training_packings=[], such as dataset=holdout30"


def takes_speeds(scene: schema.SceneConfig) -> bool:
    """Whether the cases of a data set give the scene their speeds, as `Scene.takes_speeds`."""
    return WALLS[scene.container.kind].drum and len(set(scene.rotation.speeds_rpm)) == 1


@raising
def _check_dataset(dataset: schema.DatasetConfig) -> Iterator[str]:
    seen: dict[float, str] = {}
    for name in SPLITS:
        for speed in getattr(dataset, name):
            given = f"dataset.{name}={getattr(dataset, name)} has {speed:g} rpm"
            if speed in seen:
                yield f"{given}, which dataset.{seen[speed]} has already; a speed belongs to one split, once"
            if seen.get(-speed, name) != name:
                yield f"{given}, whose mirror image dataset.{seen[-speed]} has; keep both in one split"
            seen[speed] = name
    if dataset.unseen_packing_seed == dataset.packing_seed:
        given = f"dataset.unseen_packing_seed={dataset.unseen_packing_seed}"
        yield f"{given} is dataset.packing_seed too, so the packing would not be unseen; choose another"
    packings = dataset.training_packings
    for seed in packings:
        given = f"dataset.training_packings={packings} has {seed}"
        if packings.count(seed) > 1:
            yield f"{given} twice; give each seed once"
        for name in ("packing_seed", "unseen_packing_seed"):
            if seed == getattr(dataset, name):
                yield f"{given}, which is dataset.{name}: training would see what it is judged on; choose another"


@raising
def _check_training(config: schema.TrainConfig) -> Iterator[str]:
    scene, first, last = config.scene, config.optim.learning_rate, config.optim.final_learning_rate
    kind, speeds, filling = scene.container.kind, scene.rotation.speeds_rpm, scene.filling
    if filling.count < 1:
        yield f"scene.filling.count={filling.count} leaves nothing to learn from; choose a value ≥ 1"
    if kind == "none":
        yield "scene.container.kind=none has no container that could turn, so nothing to train on; choose a drum"
    turns = takes_speeds(scene)
    if not turns:
        does = f"rotation.speeds_rpm={speeds} is a schedule"
        if not WALLS[kind].drum:
            does = f"container.kind={kind} does not turn"
        if not MODELS[config.model.name].particles:
            yield f"scene.{does}: model={config.model.name} learns from drums at many speeds; choose scene=drum"
        if not config.dataset.training_packings:
            why = "its cases are packings, and dataset.training_packings=[] leaves nothing to train on"
            yield f"scene.{does}: {why}; give seeds, such as dataset=packings"
        if config.judge.speeds_rpm is not None:
            yield f"judge.speeds_rpm={config.judge.speeds_rpm}: scene.{does}; choose judge.speeds_rpm=null"
    for name, differs in {
        f"sizes.kind={filling.sizes.kind} makes spheres that": filling.sizes.kind != "one",
        f"second_fraction={filling.second_fraction:g} makes spheres that": filling.second_fraction != 0,
        "settles=false makes a start that": turns and not filling.settles,
        "positions make a start that": bool(filling.positions),
    }.items():
        if differs:
            yield f"scene.filling.{name} no surrogate can learn; train on equal spheres, in a drum on settled ones"
    available, needed = round((scene.end_time - scene.start_time) / scene.frame_interval), LONGEST_HORIZON
    if available < needed:
        given = f"scene.end_time={scene.end_time:g} makes cases of {available} frames"
        yield f"{given}; judging looks {needed} frames ahead, so choose a later end"
    if config.trainer.budget == "time" and config.trainer.minutes is None:
        yield "trainer.budget=time needs minutes to spend, and trainer.minutes is null; give trainer.minutes"
    if last > first:
        yield f"optim.final_learning_rate={last:g} exceeds optim.learning_rate={first:g}; choose at most that"


@raising
def _check_judge(config: schema.TrainConfig | schema.EvaluateConfig) -> Iterator[str]:
    dataset, speeds = config.dataset, config.judge.speeds_rpm
    if len(dataset.holdout_speeds_rpm) != 1:
        yield f"dataset.holdout_speeds_rpm={dataset.holdout_speeds_rpm} is not one speed; one held-out case is judged"
    made = {speed for name in SPLITS for speed in getattr(dataset, name)}
    for speed in speeds or ():
        if speed not in made:
            given = f"judge.speeds_rpm={speeds} has {speed:g} rpm"
            yield f"{given}, which no split of dataset has; choose from {sorted(made)}"
    if config.device == "cuda":
        import torch  # only here: it loads for seconds

        if not torch.cuda.is_available():
            yield "device=cuda needs a CUDA device that PyTorch can use; choose device=cpu or device=auto"


@raising
def _check_benchmark(config: schema.BenchmarkConfig) -> Iterator[str]:
    speeds, profile, count = config.dataset.holdout_speeds_rpm, config.profile, config.scene.filling.count
    if files := config.dataset.files:
        yield f"dataset.files={files}: the benchmark times the DEM that makes the data; leave it empty"
    if len(speeds) != 1:
        yield f"dataset.holdout_speeds_rpm={speeds} is not one speed; methods are compared at one held-out speed"
    if config.scene.coarse_graining != 1.0:
        given = f"scene.coarse_graining={config.scene.coarse_graining:g}"
        yield f"{given}: methods are held against the fine spheres; leave it at 1, change profile.coarse_graining"
    if 1.0 not in profile.step_multiples:
        given = f"profile.step_multiples={profile.step_multiples}"
        yield f"{given} lacks the automatic step, which all times are held against; add 1"
    if profile.judged_rounds > profile.rounds:
        given = f"profile.judged_rounds={profile.judged_rounds}"
        yield f"{given} is more than profile.rounds={profile.rounds}; choose at most that"
    ladders = ("step_multiples", "single_multiples", "soft_moduli", "soft_multiples", "coarse_graining")
    for name in (*ladders, "stiffness", "counts"):
        values = getattr(profile, name)
        if len(values) != len(set(values)):
            yield f"profile.{name}={values} has a value twice; a method is compared once"
    if count < 1:
        yield f"scene.filling.count={count} leaves nothing to compare; choose a value ≥ 1"


@raising
def _check_calibration(config: CalibrateConfig) -> Iterator[str]:
    scene, data = config.scene, config.dataset
    if scene.coarse_graining == 1.0:
        yield "scene.coarse_graining=1 leaves nothing to calibrate; choose more, such as 2"
    if not WALLS[scene.container.kind].drum or len(set(scene.rotation.speeds_rpm)) != 1:
        yield f"scene.name={scene.name} keeps its own motion and has no training speeds; choose a drum with one speed"
    if scene.second_material is not None:
        yield "scene.second_material has frictions of its own, which nothing here calibrates; choose one material"
    hidden = {abs(speed) for speed in data.holdout_speeds_rpm}
    for speed in config.speeds_rpm:
        given = f"speeds_rpm={config.speeds_rpm} has {speed:g} rpm"
        if abs(speed) in hidden:
            held = f"dataset.holdout_speeds_rpm={data.holdout_speeds_rpm} holds out"
            yield f"{given}, which {held} for judging: no calibration may read it; choose training speeds"
        if speed not in data.training_speeds_rpm:
            yield f"{given}, which dataset.training_speeds_rpm={data.training_speeds_rpm} has not; choose from these"
