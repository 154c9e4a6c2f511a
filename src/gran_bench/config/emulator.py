"""Config keys of the statistics emulator, and of the runs of the DEM that it learns from."""

from __future__ import annotations  # the types of keys are read as words

from dataclasses import dataclass, field

from gran_bench.config.registry import register_model
from gran_bench.config.rules import Range, Section, at_least, key, one_of, positive

MOST_SCHEDULES = 1000  # of training; judging has the seeds from this one on


@dataclass
class SchedulesConfig(Section, place="model.schedules"):
    """The runs of the DEM that the emulator learns from: random schedules of the drum's speed, several beds."""

    runs: int = key(140, Range(2, MOST_SCHEDULES))  # of different schedules
    twins: int = key(20, at_least(2))  # of these, run again from a nudged start: how far runs scatter
    stopping: int = key(20, Range(0, MOST_SCHEDULES))  # further runs, whose drum stops often
    constants: int = key(6, at_least(2))  # of the runs at constant speeds, spread over the range
    slowest_rpm: float = key(15.0, positive("rpm"))
    fastest_rpm: float = key(42.0, positive("rpm"))
    filling_spread: float = key(0.2, Range(0.0, 1.0, open_high=True))  # ± share of filling.count in a run of five
    friction_spread: float = key(0.4, Range(0.0, 1.0, open_high=True))  # ± share of material.friction in these


@register_model(
    "emulator",
    build="gran_bench.emulator.network:Emulator",
    particles=False,
    code=("emulator", "metrics", "dataset/generation.py", "dataset/ensure.py"),
)
@dataclass
class EmulatorConfig(Section, place="model"):
    """The statistics emulator: a learned linear recurrence from the wall's speed to the figures of each frame."""

    name: str = key("emulator", one_of("emulator"))
    width: int = key(48, at_least(2))
    modes: int = key(24, at_least(1))  # decaying oscillations of each layer
    blocks: int = key(2, at_least(1))  # layers
    stride: int = key(4, at_least(1))  # frames between two steps of a recurrence; as many of them interleave
    committee: int = key(3, at_least(1))  # recurrences that learn from other series, whose mean is taken
    batch: int = key(24, at_least(1))  # series whose gradients are computed together, shared out to the committee
    weight_decay: float = key(0.1, Range(0.0))  # times the rate: share by which an update shrinks matrices
    members: int = key(20, at_least(2))  # of the ensemble that is judged
    schedules: SchedulesConfig = field(default_factory=SchedulesConfig)
