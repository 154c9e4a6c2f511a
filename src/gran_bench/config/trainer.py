"""Config keys of a training: its budget, its checkpoints, and the scenes that its windows are of."""

from __future__ import annotations  # the types of keys are read as words

from dataclasses import dataclass, field

from gran_bench.config.rules import Name, Range, Section, at_least, key, one_of, positive


@dataclass
class MixtureConfig(Section, place="trainer.mixture"):
    """Further scenes whose windows a training sees, made of the run's own spheres, and which share each scene has."""

    scenes: list[str] = key([], Name())  # shipped ones, in diameters and frames of the run's scene
    speeds_rpm: list[float] = key([], Range(unit="rpm"))  # of those with a drum; empty: dataset.training_speeds_rpm
    shares: list[list[float]] = key([], at_least(0))  # of windows: the run's scene, each further one; a row a stage
    until: list[float] = key([], Range(0.0, 1.0))  # share of the budget at which each stage but the last ends


@dataclass
class TrainerConfig(Section, place="trainer"):
    """Budgets, checkpoints, validation."""

    budget: str = key("steps", one_of("steps", "time"))  # what the schedule runs through, and what ends it
    steps: int = key(1000, at_least(1))  # optimiser updates, at most
    minutes: float | None = key(None, positive("minutes"))  # across resumes; a cap, or the budget of budget=time
    checkpoint_every: float = key(30.0, positive("s"))  # between checkpoints
    checkpoint_steps: int | None = key(None, at_least(1))  # or every so many updates
    log_every: int = key(20, at_least(1))  # updates between logged losses
    startup_fraction: float = key(0.0, Range(0.0, 1.0))  # share of windows drawn from the start-up
    startup_fall_times: float = key(14.0, positive("√(d/g)"))  # of rotation that count as start-up
    startup_seconds: float | None = key(None, positive("s"))  # null: by startup_fall_times
    start_from: str | None = None  # run or model file whose weights it starts from; null: random ones
    mixture: MixtureConfig = field(default_factory=MixtureConfig)
