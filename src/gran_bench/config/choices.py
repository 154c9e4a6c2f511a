"""Which loss, rollout, boundary and radius a model can use: the choices that are compared with each other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields

from gran_bench.config import BoundaryConfig, CconvModelConfig, ContactModelConfig, LossConfig, TrainConfig
from gran_bench.config.registry import MODELS
from gran_bench.config.rules import Section, raising, shown

PAIR_FADE = 0.1  # of a diameter: the last part of the contact network's reach, over which an answer fades

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


@raising
def check_radius(model: Section, diameter: float, period: float) -> Iterator[str]:
    """Hold a model's radius against the spheres that it is for.

    Args:
        model: what is trained; one that is not the house's has a `check` of its own.
        diameter: of the spheres, m.
        period: length of the periodic axis, m; 0 for none.

    Raises:
        ConfigError: a radius that reaches too little or too far.
    """
    smallest = (1.0 + PAIR_FADE) * diameter
    if isinstance(model, CconvModelConfig):
        if model.radius <= diameter:
            yield (
                f"model.radius={model.radius:g} reaches no neighbour; choose more than the particle diameter, "
                f"{diameter:g} m"
            )
    elif isinstance(model, ContactModelConfig):
        if model.radius < smallest * (1.0 - 1e-9):
            yield (
                f"model.radius={model.radius:g} leaves no room for a contact to fade; choose at least {smallest:g} m, "
                f"{1.0 + PAIR_FADE:g} particle diameters"
            )
        if period and 2.0 * model.radius > period:
            yield (
                f"model.radius={model.radius:g} sees a neighbour through both ends of the period, "
                f"scene.container.length={period:g}; choose at most {0.5 * period:g} m, or model=radial"
            )


@raising
def check_choices(config: TrainConfig) -> Iterator[str]:
    """Hold loss, rollout, boundary and radius against the model that is to be trained with them.

    Raises:
        ConfigError: names a dotted key, its value, what cannot use it and the remedy.
    """
    scene = config.scene
    period = scene.container.length if getattr(scene.container, "periodic_axis", False) else 0.0
    check_radius(config.model, scene.filling.diameter, period)
    if (check := getattr(config.model, "check", None)) is not None:
        check(scene)
    yield from (*_of_boundary(config), *_of_loss(config), *_of_rollout(config))


def _of_boundary(config: TrainConfig) -> Iterator[str]:
    model, boundary = config.model.name, config.boundary
    if MODELS[model].own_walls and boundary.kind != "own":
        yield (
            f"boundary.kind={boundary.kind} changes nothing for model={model}, which has walls of its own; leave "
            "boundary as it is (boundary=contact), or choose model=radial or model=ccnn"
        )
    if boundary.kind == "own" and not MODELS[model].own_walls:
        yield (
            f"boundary.kind=own is how the contact network sees walls, and model={model} does not; choose "
            "boundary=spheres, boundary=analytic or boundary=none"
        )
    for entry in fields(BoundaryConfig):
        value = getattr(boundary, entry.name)
        if entry.name != "kind" and entry.name not in BOUNDARY_KEYS[boundary.kind] and value != entry.default:
            users = " or ".join(f"boundary={kind}" for kind, keys in BOUNDARY_KEYS.items() if entry.name in keys)
            wanted = f"{users} with model=radial or model=ccnn" if boundary.kind == "own" else users
            yield (
                f"boundary.{entry.name}={shown(value)} changes nothing for boundary.kind={boundary.kind}; leave it at "
                f"{shown(entry.default)}, or choose {wanted}"
            )


def _of_loss(config: TrainConfig) -> Iterator[str]:
    loss, model, terms = config.loss, config.model.name, loss_terms()
    if not weighed_terms(loss):
        yield f"loss.{terms[0]}=0 and every other term is 0 too; give one of {', '.join(terms)} a weight"
    if loss.spin > 0 and not MODELS[model].spin:
        yield (
            f"loss.spin={loss.spin:g} needs a model that predicts spin, and model={model} does not; choose "
            "loss.spin=0 or model=contact"
        )
    if loss.momentum > 0 and MODELS[model].conserves_momentum:
        yield (
            f"loss.momentum={loss.momentum:g} has nothing to teach model={model}, whose pairs conserve momentum "
            "exactly; choose loss.momentum=0, or model=radial or model=ccnn"
        )
    for term in TERMS_OF_GRAVITY:
        if getattr(loss, term) > 0 and not any(config.scene.gravity):
            yield (
                f"loss.{term}={getattr(loss, term):g} is measured in units of gravity, and scene.gravity="
                f"{config.scene.gravity} has none; choose loss.{term}=0"
            )


def _of_rollout(config: TrainConfig) -> Iterator[str]:
    rollout, scene = config.rollout, config.scene
    available = round((scene.end_time - scene.start_time) / scene.frame_interval)
    for name in ("frames", "final_frames"):
        if (getattr(rollout, name) or 0) > available:
            yield f"rollout.{name}={getattr(rollout, name)} is longer than a case; choose at most {available} frames"
    if rollout.final_frames is None and rollout.growth == "linear":
        yield "rollout.growth=linear has nothing to grow to; give rollout.final_frames, or choose rollout.growth=jump"
    if rollout.final_frames is not None and rollout.final_frames < rollout.frames:
        yield (
            f"rollout.final_frames={rollout.final_frames} is fewer than rollout.frames={rollout.frames}; choose at "
            f"least {rollout.frames}, or rollout.final_frames=null to look equally far all the time"
        )
