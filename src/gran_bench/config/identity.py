"""Which config keys decide the weights of a trained model: they give a run its key, and its folder a name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from gran_bench.config import TrainConfig
from gran_bench.config.registry import ADDED_TERMS, MODELS

# Sections and dotted keys that say where, when, how often or against what, and leave every bit of the weights as it is.
# ``device`` is not among them: a GPU adds in another order. Nor is ``threads``: with a budget of time they decide how
# far a training gets.
UNDECIDING = frozenset(
    {
        *("experiment", "judge", "tracking"),
        *("dataset.root", "dataset.files", "dataset.workers"),
        *("dataset.holdout_speeds_rpm", "dataset.unseen_packing_seed", "dataset.replicas"),
        *("trainer.minutes", "trainer.checkpoint_every", "trainer.checkpoint_steps", "trainer.log_every"),
    }
)

# Keys that others switch off, and when they do: the weights are then the same for all their values.
SWITCHED_OFF: dict[str, Callable[[TrainConfig], bool]] = {
    "loss.frame_weights": lambda config: _one_frame(config),
    "loss.spin_frame_weights": lambda config: _one_frame(config) or config.loss.spin == 0,
    "loss.discount": lambda config: "discounted" not in _weights_looked_at(config),
    "rollout.gradient_through_time": lambda config: _one_frame(config),
    "rollout.final_from": lambda config: config.rollout.final_frames in (None, config.rollout.frames),
    "rollout.growth": lambda config: config.rollout.final_frames in (None, config.rollout.frames),
    "rollout.independent_noise": lambda config: config.rollout.noise == 0,
    "optim.decay_steps": lambda config: config.optim.schedule != "steps",
    "optim.final_learning_rate": lambda config: config.optim.schedule == "constant",
    "trainer.startup_seconds": lambda config: config.trainer.startup_fraction == 0,
}


def deciding_keys(config: TrainConfig) -> dict[str, Any]:
    """The config as nested plain values, without what does not decide the trained weights.

    A model with walls of its own looks at no ``boundary``, and a plugin's term without weight is as if its package were
    not installed. A cap of minutes only says when to
    pause; a budget of minutes sets the pace of the schedule.
    """
    values = asdict(config)
    undeciding = UNDECIDING | ({"boundary"} if MODELS[config.model.name].own_walls else set())
    undeciding |= {f"loss.{term}" for term in ADDED_TERMS if values["loss"].get(term) == 0}
    for key in undeciding - ({"trainer.minutes"} if config.trainer.budget == "time" else set()):
        section, _, name = key.rpartition(".")
        del (values[section] if section else values)[name]
    return values


def telling_keys(config: TrainConfig) -> dict[str, Any]:
    """`deciding_keys` without those that others switch off: configs that share them train the same weights."""
    values = deciding_keys(config)
    for key, is_off in SWITCHED_OFF.items():
        section, _, name = key.rpartition(".")
        if is_off(config):
            del values[section][name]
    return values


def _one_frame(config: TrainConfig) -> bool:
    return max(config.rollout.frames, config.rollout.final_frames or 1) == 1


def _weights_looked_at(config: TrainConfig) -> set[str]:
    """The kinds of frame weights that a training looks at."""
    if _one_frame(config):
        return set()
    return {config.loss.frame_weights} | ({config.loss.spin_frame_weights} if config.loss.spin > 0 else set())
