"""Which loss, rollout, boundary and radius a model can use: the choices that are compared with each other."""

from collections.abc import Iterator
from dataclasses import fields

from gran_bench.config import (
    BoundaryConfig,
    CconvModelConfig,
    ContactModelConfig,
    EmulatorConfig,
    GnsConfig,
    LossConfig,
    TrainConfig,
)
from gran_bench.config.convolution import ConvolutionConfig, Lu2021Config, XuShen2022Config
from gran_bench.config.emulator import MOST_SCHEDULES
from gran_bench.config.registry import MODELS
from gran_bench.config.rules import Section, raising, shown

PAIR_FADE = 0.1  # of a diameter: the last part of a contact's reach, over which an answer fades

# What of `boundary` each kind looks at.
BOUNDARY_KEYS = {
    "spheres": ("spacing", "normal", "velocity"),
    "analytic": ("normal", "velocity"),
    "none": (),
    "own": (),
}
TERMS_OF_GRAVITY = ("energy", "speed_distribution")


def loss_terms() -> list[str]:
    """Keys of ``loss`` that are weights of a term."""
    return [entry.name for entry in fields(LossConfig) if entry.type == "float" and entry.name != "discount"]


def weighed_terms(loss: LossConfig) -> list[str]:
    """The terms that have a weight."""
    return [term for term in loss_terms() if getattr(loss, term) > 0]


def given_or(absolute: float | None, share: float, unit: float) -> float:
    """A length or a time: the absolute value where it is given, else a share of a unit, such as a diameter."""
    return share * unit if absolute is None else absolute


@raising
def check_radius(model: Section, diameter: float, period: float) -> Iterator[str]:
    """Refuse, as a `ConfigError`, a radius that reaches too little or too far; a plugin's model has a `check`.

    Args:
        diameter: of the spheres, m.
        period: length of the periodic axis, m; 0 for none.
    """
    if not isinstance(model, ConvolutionConfig | ContactModelConfig | GnsConfig):
        return
    radius = given_or(model.radius_m, model.radius_diameters, diameter)
    unit = diameter if model.radius_m is None else 1.0
    key, of = ("radius_diameters", "diameters") if model.radius_m is None else ("radius_m", "m")
    given = f"model.{key}={getattr(model, key):g}"
    if isinstance(model, ConvolutionConfig) and radius <= diameter:
        yield f"{given} reaches no neighbour; choose more than {diameter / unit:g} {of}, the size of a particle"
    if isinstance(model, ContactModelConfig | GnsConfig):
        least = (1.0 + PAIR_FADE) * diameter
        if radius < least * (1.0 - 1e-9):
            yield f"{given} leaves no room for a contact to fade; choose at least {least / unit:g} {of}"
        if period and 2.0 * radius > period:
            ends = f"both ends of the period, scene.container.length={period:g}"
            remedy = f"choose at most {0.5 * period / unit:g} {of}, or model=radial"
            yield f"{given} sees a neighbour through {ends}; {remedy}"


@raising
def check_static(model: Section, boundary: BoundaryConfig) -> Iterator[str]:
    """Refuse, as a `ConfigError`, walls that move for a model whose boundary is static: points without a velocity."""
    if not isinstance(model, Lu2021Config | XuShen2022Config):
        return
    if boundary.kind not in ("spheres", "none"):
        yield f"boundary.kind={boundary.kind}: the walls of model={model.name} are static points; choose spheres"
    if boundary.kind == "spheres" and boundary.velocity:
        given = f"boundary.velocity=true: model={model.name} has a static boundary, whose points carry no velocity"
        yield f"{given}; choose boundary=spheres_normal, or model=ccnn"


@raising
def check_choices(config: TrainConfig) -> Iterator[str]:
    """Refuse, as a `ConfigError`, loss, rollout, boundary and radius that the model to be trained cannot use."""
    scene = config.scene
    period = scene.container.length if getattr(scene.container, "periodic_axis", False) else 0.0
    check_radius(config.model, scene.coarse_graining * scene.filling.diameter, period)
    if (check := getattr(config.model, "check", None)) is not None:
        check(scene)
    model, boundary, kind = config.model.name, config.boundary, config.boundary.kind
    if MODELS[model].own_walls and kind != "own":
        remedy = "leave boundary as it is (boundary=contact), or choose model=radial or model=ccnn"
        yield f"boundary.kind={kind} changes nothing for model={model}, which has walls of its own; {remedy}"
    if kind == "own" and not MODELS[model].own_walls:
        remedy = "choose boundary=spheres, boundary=analytic or boundary=none"
        yield f"boundary.kind=own is how the contact network sees walls, and model={model} does not; {remedy}"
    for entry in fields(BoundaryConfig):
        name, value, usual = entry.name, getattr(boundary, entry.name), entry.default
        if name != "kind" and name not in BOUNDARY_KEYS[kind] and value != usual:
            users = " or ".join(f"boundary={one}" for one, keys in BOUNDARY_KEYS.items() if name in keys)
            remedy = f"leave it at {shown(usual)}, or choose {users}"
            remedy += " with model=radial or model=ccnn" if kind == "own" else ""
            yield f"boundary.{name}={shown(value)} changes nothing for boundary.kind={kind}; {remedy}"
    check_static(config.model, boundary)
    loss, model, terms, gravity = config.loss, config.model.name, loss_terms(), config.scene.gravity
    if not weighed_terms(loss):
        yield f"loss.{terms[0]}=0 and every other term is 0 too; give one of {', '.join(terms)} a weight"
    if loss.spin > 0 and not MODELS[model].spin:
        given, remedy = f"loss.spin={loss.spin:g}", "choose loss.spin=0 or model=contact"
        yield f"{given} needs a model that predicts spin, and model={model} does not; {remedy}"
    if loss.momentum > 0 and MODELS[model].conserves_momentum:
        given = f"loss.momentum={loss.momentum:g} has nothing to teach model={model}"
        yield f"{given}, which conserves momentum exactly; choose loss.momentum=0, or model=radial or model=ccnn"
    if loss.momentum > 0 and isinstance(config.model, CconvModelConfig) and config.model.pair_branch != "plain":
        given = f"loss.momentum={loss.momentum:g} has nothing to teach model.pair_branch={config.model.pair_branch}"
        yield f"{given}, which conserves momentum exactly; choose loss.momentum=0, or model.pair_branch=plain"
    if loss.momentum > 0 and isinstance(config.model, GnsConfig):
        given = f"loss.momentum={loss.momentum:g} needs the accelerations of pairs alone"
        yield f"{given}, and model={model} tells only those with walls; choose loss.momentum=0, or model=radial"
    for term in TERMS_OF_GRAVITY:
        if getattr(loss, term) > 0 and not any(gravity):
            given = f"loss.{term}={getattr(loss, term):g} is measured in units of gravity"
            yield f"{given}, and scene.gravity={gravity} has none; choose loss.{term}=0"
    trainer = config.trainer
    if not MODELS[model].particles and trainer.start_from is not None:
        yield f"trainer.start_from={trainer.start_from}: model={model} starts from random weights alone; leave it null"
    if isinstance(emulator := config.model, EmulatorConfig):
        if min(emulator.batch, emulator.schedules.runs) < emulator.committee:
            given = f"model.batch={emulator.batch} and model.schedules.runs={emulator.schedules.runs}"
            yield f"{given} must both be at least model.committee={emulator.committee}, a series for each"
        if emulator.schedules.slowest_rpm >= emulator.schedules.fastest_rpm:
            given = f"model.schedules.slowest_rpm={emulator.schedules.slowest_rpm:g}"
            yield f"{given} must lie below model.schedules.fastest_rpm={emulator.schedules.fastest_rpm:g}"
        if emulator.schedules.twins > emulator.schedules.runs:
            given = f"model.schedules.twins={emulator.schedules.twins}"
            yield f"{given} are more than model.schedules.runs={emulator.schedules.runs}; choose at most that"
        if (count := emulator.schedules.runs + emulator.schedules.stopping) > MOST_SCHEDULES:
            given = f"model.schedules.runs and model.schedules.stopping together are {count}"
            yield f"{given}; choose at most {MOST_SCHEDULES}, because the schedules after these are judged"
    if not MODELS[model].particles and config.dataset.files:
        yield f"dataset.files={config.dataset.files}: model={model} learns from runs of this DEM; leave it empty"
    if trainer.startup_fraction > 0 and trainer.startup_seconds is None and not any(gravity):
        why = "fall times, and scene.gravity is 0; give trainer.startup_seconds"
        yield f"trainer.startup_fall_times={trainer.startup_fall_times:g} {why}"
    if config.rollout.rotation and not MODELS[model].gravity_outside:
        yield f"rollout.rotation=true turns gravity too, which is for networks that see none, and not for model={model}"
    check_mixture(config)
    rollout, scene, first, last = config.rollout, config.scene, config.rollout.frames, config.rollout.final_frames
    available = round((scene.end_time - scene.start_time) / scene.frame_interval)
    for name, frames in (("frames", first), ("final_frames", last or 0)):
        if frames > available:
            yield f"rollout.{name}={frames} is longer than a case; choose at most {available} frames"
    if last is None and rollout.growth == "linear":
        yield "rollout.growth=linear has nothing to grow to; give rollout.final_frames, or choose rollout.growth=jump"
    if last is not None and last < first:
        remedy = f"choose at least {first}, or rollout.final_frames=null to look equally far all the time"
        yield f"rollout.final_frames={last} is fewer than rollout.frames={first}; {remedy}"


@raising
def check_mixture(config: TrainConfig) -> Iterator[str]:
    """Refuse, as a `ConfigError`, further scenes that a training cannot use, and shares that do not fit them."""
    mixture, data, place = config.trainer.mixture, config.dataset, "trainer.mixture"
    scenes, rows, until = mixture.scenes, mixture.shares, mixture.until
    given = f"{place}.scenes={shown(scenes)}"
    if not scenes and (mixture.speeds_rpm or rows or until):
        yield f"{given} has no further scene, and {place}.speeds_rpm, shares and until are of some; leave them at []"
    if scenes and data.files:
        why = f"is for cases that this DEM makes, and dataset.files={shown(data.files)} has others"
        yield f"{given} {why}; leave it at []"
    if len({config.scene.name, *scenes}) <= len(scenes):
        yield f"{given} has a scene twice, or the run's own scene.name={config.scene.name}; name each other one once"
    hidden = {abs(speed) for speed in (*data.validation_speeds_rpm, *data.holdout_speeds_rpm)}
    for speed in mixture.speeds_rpm:
        if abs(speed) in hidden:
            yield f"{place}.speeds_rpm={mixture.speeds_rpm} has {speed:g} rpm, which is held out; leave it out"
    if any(len(row) != len(scenes) + 1 or not any(row) for row in rows):
        why = f"does not give {len(scenes) + 1} numbers, not all 0, for {config.scene.name} and each further scene"
        yield f"{place}.shares={shown(rows)} has a row that {why}"
    if sorted(set(until)) != until or len(until) != max(len(rows) - 1, 0):
        why = f"does not give {max(len(rows) - 1, 0)} rising numbers, the end of each stage but the last"
        yield f"{place}.until={until} {why}, for {place}.shares={shown(rows)}"
