"""Which values each config key may take by itself; `config_consistency` says which fit together."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

from gran_bench.config import (
    BenchmarkConfig,
    BoundaryConfig,
    BoxConfig,
    CconvModelConfig,
    ContactModelConfig,
    ContainerConfig,
    DatasetConfig,
    DemConfig,
    EvaluateConfig,
    FillingConfig,
    GenerateConfig,
    HopperConfig,
    JudgeConfig,
    LossConfig,
    MaterialConfig,
    MixedConfig,
    OptimConfig,
    ProfileConfig,
    RolloutConfig,
    RotationConfig,
    SceneConfig,
    SizesConfig,
    StressConfig,
    TrackingConfig,
    TrainConfig,
    TrainerConfig,
    UiConfig,
)


class ConfigError(ValueError):
    """A config that no run can have; the message names the key, the value and the remedy in one line."""


@dataclass(frozen=True)
class Range:
    """An interval of numbers; ``open_low`` and ``open_high`` exclude the ends. Never holds nan or an infinity."""

    low: float = -math.inf
    high: float = math.inf
    open_low: bool = False
    open_high: bool = False
    unit: str = ""

    def holds(self, value: float) -> bool:
        """Whether ``value`` is a finite number of the interval."""
        above = value > self.low if self.open_low else value >= self.low
        below = value < self.high if self.open_high else value <= self.high
        return math.isfinite(value) and above and below

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        if math.isinf(self.high):
            if math.isinf(self.low):
                return f"a finite value{unit and ' in' + unit}"
            return f"a finite value {'>' if self.open_low else '≥'} {self.low:g}{unit}"
        left, right = "(" if self.open_low else "[", ")" if self.open_high else "]"
        return f"a value in {left}{self.low:g}, {self.high:g}{right}{unit}"


@dataclass(frozen=True)
class OneOf:
    """An enumeration of words."""

    words: tuple[str, ...]

    def holds(self, value: str) -> bool:
        """Whether ``value`` is one of the words."""
        return value in self.words

    def __str__(self) -> str:
        return " or ".join(self.words)


@dataclass(frozen=True)
class Text:
    """Any word but the empty one."""

    def holds(self, value: str) -> bool:
        """Whether ``value`` says anything."""
        return bool(value.strip())

    def __str__(self) -> str:
        return "a word"


@dataclass(frozen=True)
class Switch:
    """true or false: the type is the whole rule."""

    def holds(self, value: bool) -> bool:
        """Always: the type was checked on reading."""
        return isinstance(value, bool)

    def __str__(self) -> str:
        return "true or false"


Rule = Range | OneOf | Text | Switch


def positive(unit: str = "") -> Range:
    """> 0, in ``unit``."""
    return Range(0.0, open_low=True, unit=unit)


def at_least(low: float, unit: str = "") -> Range:
    """≥ ``low``, in ``unit``."""
    return Range(low, unit=unit)


FRACTION = Range(0.0, 1.0)
BACKEND = OneOf(("fused", "torch"))
FRAME_WEIGHTS = OneOf(("uniform", "discounted", "inverse", "rising"))

# The rule of a list holds for each of its elements; null, where the schema allows it, needs none.
RULES: dict[type, dict[str, Rule]] = {
    MaterialConfig: {
        "youngs_modulus": positive("Pa"),
        "poisson_ratio": Range(-1.0, 0.5, open_low=True, open_high=True),
        "density": positive("kg/m³"),
        "restitution": Range(0.0, 1.0, open_low=True),
        "friction": at_least(0),
        "rolling_friction": at_least(0),
    },
    ContainerConfig: {
        "kind": OneOf(("drum", "none")),
        "diameter": positive("m"),
        "length": positive("m"),
        "periodic_axis": Switch(),
    },
    BoxConfig: {
        "kind": OneOf(("box",)),
        "width": positive("m"),
        "length": positive("m"),
        "height": positive("m"),
    },
    HopperConfig: {
        "kind": OneOf(("hopper",)),
        "diameter": positive("m"),
        "height": positive("m"),
        "half_angle_deg": Range(0.0, 90.0, open_low=True, open_high=True, unit="degrees"),
        "orifice": positive("m"),
        "outlet_depth": positive("m"),
    },
    SizesConfig: {
        "kind": OneOf(("one", "listed", "uniform", "lognormal")),
        "factors": positive(),
        "fractions": FRACTION,
        "spread": Range(0.0, 1.0, open_high=True),
    },
    MixedConfig: {
        "restitution": Range(0.0, 1.0, open_low=True),
        "friction": at_least(0),
        "rolling_friction": at_least(0),
    },
    FillingConfig: {
        "count": at_least(0),
        "diameter": positive("m"),
        "lattice_spacing": at_least(1, "diameters"),
        "jitter": at_least(0, "diameters"),
        "settled_speed": positive("m/s"),
        "longest_settling": positive("s"),
        "settles": Switch(),
        "second_fraction": FRACTION,
        "positions": Range(unit="m"),
        "velocities": Range(unit="m/s"),
        "spins": Range(unit="rad/s"),
        "expansion": Range(unit="1/s"),
    },
    RotationConfig: {"times": Range(unit="s"), "speeds_rpm": Range(unit="rpm")},
    SceneConfig: {
        "name": Text(),
        "gravity": Range(unit="m/s²"),
        "start_time": at_least(0, "s"),
        "end_time": positive("s"),
        "frame_interval": positive("s"),
    },
    DemConfig: {
        "engine": OneOf(("numba", "numpy")),
        "time_step": positive("s"),
        "skin": positive("m"),
        "threads": at_least(1),
        "precision": OneOf(("float64", "float32")),
        "slip": OneOf(("contact_point", "full_radius")),
        "allow_unsafe_step": Switch(),
    },
    DatasetConfig: {
        "root": Text(),
        "training_speeds_rpm": at_least(0, "rpm"),
        "validation_speeds_rpm": at_least(0, "rpm"),
        "holdout_speeds_rpm": at_least(0, "rpm"),
        "packing_seed": at_least(0),
        "unseen_packing_seed": at_least(0),
        "replicas": at_least(2),  # a floor is a mean over pairs of replicas
        "workers": at_least(1),
    },
    ContactModelConfig: {
        "name": OneOf(("contact",)),
        "iterations": at_least(1),
        "hidden": at_least(1),
        "channels": at_least(1),
        "radius": positive("m"),
        "wall_reach": positive("m"),
        "memory": Switch(),
        "velocity": OneOf(("mean", "instantaneous")),
        "backend": BACKEND,
    },
    CconvModelConfig: {
        "name": OneOf(("ccnn", "radial")),
        "kernel": OneOf(("lattice", "radial")),
        "kernel_size": at_least(2),
        "width": at_least(2),
        "layers": at_least(1),
        "radius": positive("m"),
        "constant_input": Switch(),
        "residual": Switch(),
        "output_scale": positive("m per frame²"),
        "update": OneOf(("mean", "trapezoid")),
        "backend": BACKEND,
    },
    BoundaryConfig: {
        "kind": OneOf(("none", "spheres", "analytic", "own")),
        "spacing": positive("diameters"),
        "normal": Switch(),
        "velocity": Switch(),
    },
    LossConfig: {
        "position_l2": at_least(0),
        "position_mse": at_least(0),
        "huber": at_least(0),
        "velocity": at_least(0),
        "acceleration": at_least(0),
        "spin": at_least(0),
        "overlap": at_least(0),
        "momentum": at_least(0),
        "cell_displacement": at_least(0),
        "center_of_mass": at_least(0),
        "energy": at_least(0),
        "speed_distribution": at_least(0),
        "frame_weights": FRAME_WEIGHTS,
        "spin_frame_weights": FRAME_WEIGHTS,
        "discount": Range(0.0, 1.0, open_low=True),
    },
    RolloutConfig: {
        "frames": at_least(1),
        "final_frames": at_least(1),
        "final_from": FRACTION,
        "growth": OneOf(("jump", "linear")),
        "gradient_through_time": Switch(),
        "noise": at_least(0, "m"),
        "independent_noise": Switch(),
        "mirror": Switch(),
    },
    OptimConfig: {
        "learning_rate": positive(),
        "final_learning_rate": positive(),
        "schedule": OneOf(("steps", "cosine", "constant")),
        "decay_steps": at_least(1),
        "warmup_steps": at_least(0),
        "accumulate": at_least(1),
        "gradient_clip": positive(),
        "weight_average": Range(0.0, 1.0, open_high=True),
    },
    TrainerConfig: {
        "budget": OneOf(("steps", "time")),
        "steps": at_least(1),
        "minutes": positive("minutes"),
        "checkpoint_every": positive("s"),
        "checkpoint_steps": at_least(1),
        "log_every": at_least(1),
        "startup_fraction": FRACTION,
        "startup_seconds": positive("s"),
    },
    JudgeConfig: {
        "speeds_rpm": at_least(0, "rpm"),
        "unseen_packing": Switch(),
        "short_horizon_starts": at_least(1),
        "gif": Switch(),
    },
    TrackingConfig: {
        "experiment": Text(),
        "root": Text(),
        "folder": Text(),
        "sweep": Text(),
        "parent": Text(),
        "enabled": Switch(),
    },
    TrainConfig: {
        "experiment": Text(),
        "seed": at_least(0),
        "device": OneOf(("auto", "cpu", "cuda")),
        "threads": at_least(1),
    },
    GenerateConfig: {},
    EvaluateConfig: {"checkpoint": Text(), "device": OneOf(("auto", "cpu", "cuda"))},
    ProfileConfig: {
        "name": Text(),
        "rounds": at_least(1),
        "judged_rounds": at_least(1),
        "step_multiples": positive("automatic steps"),
        "single_multiples": positive("automatic steps"),
        "soft_moduli": positive("Pa"),
        "soft_multiples": positive("automatic steps"),
        "numpy_frames": at_least(0),
        "stiffness": positive("Pa"),
        "counts": at_least(1),
        "study_frames": at_least(1),
        "study_rounds": at_least(1),
    },
    BenchmarkConfig: {"models": Text(), "seed": at_least(0), "measure": Switch(), "root": Text()},
    UiConfig: {"port": Range(1, 65535)},
    StressConfig: {
        "selection": OneOf(("full", "short")),
        "cases": Text(),
        "case_list": Text(),
        "checkpoint": Text(),
        "also": Text(),
        "workers": at_least(1),
        "patience": positive("s"),
        "output": Text(),
    },
}


def hold_values(config: Any, path: str = "") -> None:
    """Hold every value of a config, or of a section of it, against its own rule.

    Args:
        config: a dataclass of ``gran_bench.config``.
        path: dotted, of the section, with a dot at its end.

    Raises:
        ConfigError: names the dotted key, the value and what is legal.
    """
    rules = RULES.get(type(config), {})
    for entry in fields(config):
        key, value = path + entry.name, getattr(config, entry.name)
        if is_dataclass(value):
            hold_values(value, f"{key}.")
        elif isinstance(value, list):
            _hold_list(rules[entry.name], key, value)
        elif value is not None and entry.name in rules:
            _hold(rules[entry.name], key, value)


def _hold_list(rule: Rule, key: str, values: list) -> None:
    for i, element in enumerate(values):
        if isinstance(element, list):
            _hold_list(rule, f"{key}[{i}]", element)
        else:
            _hold(rule, f"{key}[{i}]", element)


def _hold(rule: Rule, key: str, value: Any) -> None:
    if not rule.holds(value):
        raise ConfigError(f"{key}={value} is impossible; choose {rule}")
