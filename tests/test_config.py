"""The schema is strict: what cannot be is refused in one line that names the key, the value and the remedy."""

from __future__ import annotations

import math
import re
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import pytest
import yaml

import gran_bench.conf
from gran_bench import config as schemas
from gran_bench.compose import checked_config, compose
from gran_bench.config import (
    BenchmarkConfig,
    BoundaryConfig,
    CalibrateConfig,
    CconvModelConfig,
    CoarseGrainingConfig,
    ContactModelConfig,
    EvaluateConfig,
    GenerateConfig,
    SceneConfig,
    TrainConfig,
    UiConfig,
)
from gran_bench.config import choices as config_choices
from gran_bench.config import consistency as config_consistency
from gran_bench.config.reading import dotted_keys, nearest_key, read_config, validate
from gran_bench.config.registry import MODELS
from gran_bench.config.rules import ConfigError, Name, OneOf, Range, Section
from gran_bench.dem.initial_checks import check_initial_state
from gran_bench.metrics.position_error import HORIZONS
from gran_bench.scene import build_scene
from gran_bench.state import StateError
from gran_bench.surrogate.convolution import boundary

WEIGHTLESS = "scene.gravity=[0,0,0] scene.filling.settled_speed=1e-3 scene.filling.longest_settling=20"
CONF = Path(gran_bench.conf.__path__[0])
GROUPS = [path for path in sorted(CONF.iterdir()) if path.is_dir() and path.name not in ("hydra", "__pycache__")]
RECIPES = sorted(path.stem for path in (CONF / "experiment").glob("*.yaml"))
SCENES = sorted(path.stem for path in (CONF / "scene").glob("*.yaml"))


def train_config(*overrides: str) -> TrainConfig:
    return checked_config(compose("train", overrides), TrainConfig)


# ---- what ships ------------------------------------------------------------------------------------------


def test_the_commands_compose_without_any_choice():
    assert train_config().model.name == "contact"
    assert checked_config(compose("generate", []), GenerateConfig).scene.name == "drum"
    assert checked_config(compose("ui", []), UiConfig).port == 5000


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("model", sorted(MODELS))
def test_one_word_swaps_the_model_of_every_recipe(recipe, model):
    if not MODELS[model].particles and train_config(f"+experiment={recipe}").dataset.training_packings:
        with pytest.raises(ConfigError, match=r"scene\.container\.kind=.* learns from drums at many speeds"):
            train_config(f"+experiment={recipe}", f"model={model}")
        return
    config = train_config(f"+experiment={recipe}", f"model={model}")
    assert config.experiment == recipe
    assert config.model.name == model
    assert isinstance(config.model, MODELS[model].config)


@pytest.mark.parametrize("group", [g.name for g in GROUPS if g.name not in ("experiment", "scene", "profile")])
def test_every_choice_of_every_group_composes(group):
    for path in sorted((CONF / group).glob("*.yaml")):
        # A speed must belong to one split: the judge's choices need the data set that has their speeds.
        with_it = ["dataset=small"] if path.stem == "quick" and group == "judge" else []
        with_it += ["judge=quick"] if path.stem == "small" and group == "dataset" else []
        with_it += ["scene=hopper"] if path.stem == "packings" else []  # a drum has speeds instead
        # Contact and graph networks have walls of their own, and no pair accelerations.
        if group == "boundary":
            with_it.append(f"model={path.stem if (CONF / 'model' / path.name).exists() else 'ccnn'}")
        with_it += ["model=ccnn"] if path.stem == "with_momentum" else []
        train_config(f"{group}={path.stem}", *with_it)


@pytest.mark.parametrize("profile", [path.stem for path in (CONF / "profile").glob("*.yaml")])
def test_every_profile_of_the_benchmark_composes_and_carries_its_name(profile):
    composed = compose("benchmark", [f"profile={profile}"])
    assert checked_config(composed, BenchmarkConfig).profile.name == profile


@pytest.mark.parametrize("scene", SCENES)
def test_a_shipped_scene_carries_its_file_name_and_has_room_for_its_spheres(scene):
    built = build_scene(checked_config(compose("generate", [f"scene={scene}"]), GenerateConfig).scene)
    assert built.name == scene
    state = built.fresh_filling(seed=0)
    assert state.count == built.filling.count
    check_initial_state(built, state)


def test_spheres_placed_into_each_other_are_refused_with_the_config():
    overrides = ["scene=collision", "scene.filling.positions=[[0,0,0],[0.01,0,0]]"]
    with pytest.raises(StateError, match="particles 0 and 1 overlap by 20%"):
        checked_config(compose("generate", overrides), GenerateConfig)


@pytest.mark.parametrize("scene", SCENES)
def test_a_shipped_scene_trains_a_surrogate_or_says_politely_why_it_does_not(scene):
    built = build_scene(checked_config(compose("generate", [f"scene={scene}"]), GenerateConfig).scene)
    if built.takes_speeds:
        assert train_config(f"scene={scene}").scene.name == scene
    else:
        with pytest.raises(ConfigError, match=r"scene\.\S+=.* nothing to train on|no data set to train on"):
            train_config(f"scene={scene}")


def test_the_papers_training_is_the_papers():
    config = train_config("+experiment=paper")
    model = config.model
    assert (model.name, model.kernel, model.width, model.layers) == ("ccnn", "lattice", 64, 3)
    assert (config.boundary.kind, config.boundary.normal, config.boundary.velocity) == ("spheres", True, True)
    loss = config.loss
    assert (loss.position_l2, loss.position_mse, loss.velocity, loss.spin, loss.overlap) == (1, 0, 0, 0, 0)
    assert loss.frame_weights == "uniform"
    assert (config.rollout.frames, config.rollout.final_frames) == (3, None)
    assert (config.rollout.noise_diameters, config.rollout.mirror) == (0.0, False)
    optim = config.optim
    assert (optim.learning_rate, optim.final_learning_rate, optim.schedule) == (1e-4, 2e-6, "steps")
    assert (optim.accumulate, optim.warmup_steps, optim.gradient_clip, optim.weight_average) == (5, 0, None, 0.0)
    assert config.trainer.startup_fraction == 0.0


def test_the_main_job_never_trains_on_30_rpm():
    dataset = train_config("+experiment=holdout30rpm").dataset
    assert dataset.training_speeds_rpm == [20.0, 25.0, 35.0, 40.0, 50.0, 60.0]
    assert dataset.holdout_speeds_rpm == [30.0]


def test_the_small_drum_is_filled_as_high_as_the_drum_and_its_speeds_are_below_critical():
    drum, small = (build_scene(train_config(f"scene={name}").scene) for name in ("drum", "drum_small"))

    def solid_fraction(scene):
        return scene.filling.count * scene.filling.diameter**3 / (6 * scene.drum_radius**2 * scene.length)

    assert solid_fraction(small) == pytest.approx(solid_fraction(drum), rel=0.01)
    dataset = train_config("+experiment=smoke").dataset
    assert max(dataset.training_speeds_rpm + dataset.holdout_speeds_rpm) < small.critical_speed_rpm


def leaf_lines(path: Path) -> list[str]:
    """The lines of a YAML file that give a key its value, without those of Hydra's defaults and block texts."""
    lines, skipping = [], None
    for line in path.read_text("utf-8").splitlines():
        indent = len(line) - len(line.lstrip())
        if skipping is not None and (not line.strip() or indent > skipping or line.lstrip().startswith("-")):
            continue
        skipping = None
        if re.match(r"\s*(defaults:\s*$|\w+: \|)", line):
            skipping = indent
        elif re.match(r"\s*[\w./]+: *[^#\s]", line):
            lines.append(line)
    return lines


@pytest.mark.parametrize("path", sorted(CONF.rglob("*.yaml")), ids=lambda path: str(path.relative_to(CONF)))
def test_every_key_has_a_comment_and_every_file_says_what_it_chooses(path):
    text = path.read_text("utf-8")
    assert text.startswith("#")
    assert [line for line in leaf_lines(path) if not re.search(r"  # \S", line)] == []
    assert yaml.safe_load(text)


def test_the_yaml_gives_every_key_of_the_schema_so_that_nothing_is_hidden():
    def absent(section, values, path=""):
        for entry in fields(section):
            value = getattr(section, entry.name)
            if entry.name not in values:
                yield path + entry.name
            elif is_dataclass(value) and values[entry.name] is not None:
                yield from absent(value, values[entry.name], f"{path}{entry.name}.")

    for model in MODELS:
        composed = compose("train", [f"model={model}"])
        assert list(absent(checked_config(composed, TrainConfig), composed)) == []
    assert list(absent(GenerateConfig(), compose("generate", []))) == []
    assert list(absent(BenchmarkConfig(), compose("benchmark", []))) == []
    assert list(absent(CoarseGrainingConfig(), compose("coarse_graining", []))) == []
    assert list(absent(CalibrateConfig(), compose("calibrate", []))) == []


def test_every_number_of_the_schema_has_bounds():
    for schema in {value for value in vars(schemas).values() if isinstance(value, type) and issubclass(value, Section)}:
        for entry in fields(schema) if is_dataclass(schema) else ():
            if "int" in str(entry.type) or "float" in str(entry.type):
                assert isinstance(entry.metadata.get("rule"), Range), f"{schema.__name__}.{entry.name}"
            else:
                assert isinstance(entry.metadata.get("rule"), OneOf | Name | None), f"{schema.__name__}.{entry.name}"


# ---- what is refused -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("scene.material.restitution=1.2", ["scene.material.restitution=1.2", "(0, 1]"]),
        ("scene.material.restitution=0", ["scene.material.restitution=0", "(0, 1]"]),
        ("scene.material.poisson_ratio=0.5", ["scene.material.poisson_ratio=0.5", "(-1, 0.5)"]),
        ("scene.filling.diameter=-0.05", ["scene.filling.diameter=-0.05", "> 0 m"]),
        ("scene.filling.count=0", ["scene.filling.count=0", "≥ 1"]),
        ("scene.rotation.speeds_rpm=[nan]", ["scene.rotation.speeds_rpm[0]=nan", "finite", "rpm"]),
        ("scene.rotation.speeds_rpm=[30,40]", ["scene.rotation.speeds_rpm", "scene.rotation.times=[1.5]"]),
        ("scene.end_time=1", ["scene.end_time=1", "scene.start_time=1.5"]),
        ("scene.frame_interval=0.03", ["scene.frame_interval=0.03", "whole frames"]),
        ("scene.filling.jitter=0.2", ["scene.filling.jitter=0.2", "at most 0.06"]),
        ("scene.filling.diameter=2", ["scene.filling.diameter=2", "scene.container.diameter=1"]),
        ("scene.gravity=[0,0]", ["scene.gravity=[0.0, 0.0]", "three"]),
        (
            "scene.gravity=[0,0,0]",
            ["settled_froude=0.001428", "scene.gravity is 0; give scene.filling.settled_speed"],
        ),
        (WEIGHTLESS, ["trainer.startup_fall_times=14", "scene.gravity is 0", "give trainer.startup_seconds"]),
        ("dataset.training_speeds_rpm=[20,.nan]", ["dataset.training_speeds_rpm[1]"]),
        ("dataset.training_speeds_rpm=[30]", ["dataset.holdout_speeds_rpm=[30.0]", "30 rpm", "training"]),
        ("dataset.training_speeds_rpm=[]", ["dataset.training_speeds_rpm=[]", "at least one"]),
        ("dataset.holdout_speeds_rpm=[]", ["dataset.holdout_speeds_rpm=[]", "one speed"]),
        ("dataset.unseen_packing_seed=0", ["dataset.unseen_packing_seed=0", "another"]),
        ("dataset.replicas=1", ["dataset.replicas=1", "≥ 2"]),
        ("judge.speeds_rpm=[31]", ["judge.speeds_rpm=[31.0]", "30.0"]),
        ("model.radius_m=0.04", ["model.radius_m=0.04", "0.055 m"]),
        ("model.radius_diameters=1.09", ["model.radius_diameters=1.09", "at least 1.1 diameters"]),
        ("scene=drum_slice model.radius_m=0.11", ["model.radius_m=0.11", "container.length=0.2", "at most 0.1 m"]),
        ("model=radial model.radius_diameters=1", ["model.radius_diameters=1", "more than 1 diameters"]),
        ("model.hidden=8", ["model.hidden=8", "16 and 4", "model.backend=torch"]),
        ("model.channels=8", ["model.channels=8", "16 and 4", "model.backend=torch"]),
        ("model.backend=cuda", ["model.backend=cuda", "fused or torch"]),
        ("boundary=none", ["boundary.kind=none", "model=contact", "model=ccnn"]),
        ("boundary.normal=false", ["boundary.normal=false", "boundary.kind=own", "model=ccnn"]),
        ("boundary=spheres", ["boundary.kind=spheres", "model=contact", "boundary=contact", "model=radial"]),
        ("model=radial boundary=contact", ["boundary.kind=own", "model=radial", "boundary=spheres"]),
        ("model=ccnn boundary=none boundary.velocity=false", ["boundary.velocity=false", "boundary.kind=none", "true"]),
        (
            "model=ccnn boundary=analytic boundary.spacing=1",
            ["boundary.spacing=1", "leave it at 0.5", "boundary=spheres"],
        ),
        ("model=ccnn boundary.spacing=0", ["boundary.spacing=0", "> 0 diameters"]),
        ("loss.huber=-1", ["loss.huber=-1", "≥ 0"]),
        ("loss=with_momentum", ["loss.momentum=0.1", "model=contact", "loss.momentum=0", "model=radial"]),
        (f"loss=with_energy {WEIGHTLESS}", ["loss.energy=0.5", "scene.gravity=[0.0, 0.0, 0.0]"]),
        (f"loss.speed_distribution=1 {WEIGHTLESS}", ["loss.speed_distribution=1", "scene.gravity"]),
        ("loss.frame_weights=linear", ["loss.frame_weights=linear", "uniform or discounted or inverse or rising"]),
        ("rollout.growth=linear rollout.final_frames=null", ["rollout.growth=linear", "rollout.final_frames"]),
        ("rollout.growth=fixed", ["rollout.growth=fixed", "jump or linear"]),
        ("rollout.frames=8", ["rollout.final_frames=5", "rollout.frames=8", "at least 8", "final_frames=null"]),
        ("rollout=frames12 scene.end_time=1.6", ["rollout.frames=12", "at most 10 frames"]),
        ("rollout.final_frames=500", ["rollout.final_frames=500", "at most 400 frames"]),
        ("dataset.packing_seed=1", ["dataset.unseen_packing_seed=1", "dataset.packing_seed", "another"]),
        ("scene.end_time=1.55 rollout=paper", ["scene.end_time=1.55", "5 frames", "10 frames"]),
        ("loss=paper loss.position_l2=0", ["loss.position_l2=0", "weight"]),
        ("model=ccnn loss.spin=0.2", ["loss.spin=0.2", "model=contact"]),
        ("model=ccnn model.width=63", ["model.width=63", "even"]),
        ("model=ccnn model.kernel=radial", ["model.kernel=radial", "model=radial"]),
        ("rollout.frames=500", ["rollout.frames=500", "400"]),
        ("trainer=paper trainer.budget=time", ["trainer.budget=time", "trainer.minutes"]),
        ("optim.final_learning_rate=1", ["optim.final_learning_rate=1", "optim.learning_rate"]),
        ("model=emulator model.batch=2 model.committee=3", ["model.batch=2", "model.committee=3"]),
        ("model=emulator model.schedules.slowest_rpm=50", ["slowest_rpm=50", "below model.schedules.fastest_rpm=42"]),
        ("model=emulator model.schedules.twins=200", ["model.schedules.twins=200", "at most"]),
        ("model=emulator model.schedules.stopping=900", ["together are 1040", "at most 1000"]),
        ("model=emulator trainer.start_from=x", ["trainer.start_from=x", "model=emulator", "null"]),
        ("seed=abc", ["seed=abc", "whole number"]),
        ("seed=1.5", ["seed=1.5", "whole number"]),
        ("seed=true", ["seed=true", "whole number"]),
        ("seed=null", ["seed=null", "whole number"]),
        ("trainer.minutes=soon", ["trainer.minutes=soon", "a number"]),
        ("rollout.mirror=1", ["rollout.mirror=1", "true or false"]),
        ("dataset.training_speeds_rpm=20", ["dataset.training_speeds_rpm=20", "[20]"]),
        ("tracking.root=''", ["tracking.root=", "a word"]),
        ("+sede=1", ["sede=1", "did you mean seed?"]),
        ("+scene.materail.friction=0.4", ["scene.materail", "did you mean scene.material?"]),
        ("+restitution=0.4", ["restitution=0.4", "did you mean scene.material.restitution?"]),
        ("+qwertzuiop=1", ["qwertzuiop=1", "experiment, seed"]),
        ("+model.width=3", ["model.width=3", "ccnn or radial"]),
    ],
)
def test_an_impossible_value_is_refused_in_one_line(override, words):
    with pytest.raises(ConfigError) as refusal:
        train_config(*override.split())
    message = str(refusal.value)
    assert [word for word in words if word not in message] == [], message
    assert "\n" not in message


def test_what_the_config_says_of_rooms_further_on_is_what_they_say():
    assert {kind for kind in config_choices.BOUNDARY_KEYS if kind != "own"} == set(boundary.KINDS)
    assert max(HORIZONS) == config_consistency.LONGEST_HORIZON


def test_sizes_that_the_fused_kernel_lacks_are_fine_in_torch():
    assert train_config("model.backend=torch", "model.hidden=8", "model.channels=2").model.hidden == 8


@pytest.mark.parametrize(("name", "schema"), [("train", TrainConfig), ("evaluate", EvaluateConfig)])
def test_a_gpu_that_is_not_there_is_refused(name, schema, monkeypatch):
    composed = compose(name, ["device=cuda"])
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ConfigError, match=r"device=cuda needs a CUDA device.*device=cpu"):
        checked_config(composed, schema)
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    assert checked_config(composed, schema).device == "cuda"


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 0.0, -1.0])
def test_a_range_holds_no_value_outside_it_and_none_that_is_not_finite(value):
    assert not Range(0.0, open_low=True).holds(value)


@pytest.mark.parametrize("name", ["ccnn2", None, 3])
def test_a_model_is_chosen_by_a_known_name(name):
    with pytest.raises(ConfigError, match=r"model\.name"):
        read_config(TrainConfig, {"scene": {"name": "drum"}, "model": {"name": name}})


def test_a_value_that_must_be_chosen_is_named_when_it_is_missing():
    with pytest.raises(ConfigError, match=r"scene\.name is missing"):
        read_config(TrainConfig, {"scene": {}})


def test_a_section_is_no_value():
    with pytest.raises(ConfigError, match=r"scene\.filling=3 is no section"):
        read_config(TrainConfig, {"scene": {"name": "drum", "filling": 3}})


# ---- what is read ----------------------------------------------------------------------------------------


def test_what_is_not_given_has_the_default_of_the_schema():
    config = read_config(
        TrainConfig, {"scene": {"name": "mine"}, "model": {"name": "ccnn", "width": 8}, "boundary": {"normal": False}}
    )
    assert config.model == CconvModelConfig(width=8)
    assert config.boundary == BoundaryConfig(kind="spheres", normal=False)
    assert config.scene == SceneConfig(name="mine")
    assert read_config(ContactModelConfig, {"iterations": 4}) == ContactModelConfig(iterations=4)


def test_a_whole_number_is_a_number_and_null_is_allowed_where_the_schema_says_so():
    config = train_config("trainer.minutes=30", "dem.time_step=null", "+scene.wall_material.friction=0.9")
    assert (config.trainer.minutes, type(config.trainer.minutes)) == (30.0, float)
    assert config.dem.time_step is None
    assert config.scene.wall_material.friction == 0.9


def test_a_wall_material_takes_from_the_particles_what_it_leaves_out():
    scene = train_config("scene.material.density=1000", "+scene.wall_material.friction=0.9").scene
    assert scene.wall_material == replace(scene.material, friction=0.9)
    with pytest.raises(ConfigError, match=r"scene\.wall_material\.frction=0\.9: no such key"):
        train_config("+scene.wall_material.frction=0.9")


def test_a_config_built_in_python_is_held_against_the_same_rules():
    config = TrainConfig(scene=SceneConfig(name="drum"))
    validate(config)
    with pytest.raises(ConfigError, match=r"scene\.material\.friction=-0\.1"):
        config.scene.material.friction = -0.1
    config.dataset.training_speeds_rpm.append(math.inf)
    with pytest.raises(ConfigError, match=r"dataset\.training_speeds_rpm\[6\]=inf is impossible"):
        validate(config)


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("sede", "seed"),
        ("model.widht", "model.width"),
        ("modle", "model"),
        ("scene.fill.count", "scene.filling.count"),
        ("optim.lr", None),
        ("zzz", None),
    ],
)
def test_the_nearest_key_is_the_one_that_was_meant(typed, meant):
    assert nearest_key(typed, list(dotted_keys(TrainConfig))) == meant
