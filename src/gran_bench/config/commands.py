"""Keys of commands that neither train nor compare methods."""

from __future__ import annotations

from dataclasses import dataclass, field

from gran_bench.config.rules import Range, Section, at_least, key, one_of, positive
from gran_bench.config.schema import GenerateConfig, TrackingConfig


@dataclass
class CoarseGrainingConfig(GenerateConfig):
    """Everything that `python -m gran_bench.coarse_graining` reads."""

    factors: list[float] = key([1.26, 1.5, 2.0, 2.5], Range(1.0, open_low=True))  # where scene.coarse_graining is 1
    root: str = "results/coarse_graining"  # folder of the table, from where the command runs


@dataclass
class CalibrateConfig(GenerateConfig):
    """Everything that `python -m gran_bench.calibrate` reads."""

    speeds_rpm: list[float] = key([], Range(unit="rpm"))  # of the training speeds; empty: all of them
    trials: int = key(24, at_least(3))  # pairs of friction and rolling friction, at most
    root: str = "results/calibration"  # folder of what was found, from where the command runs


@dataclass
class StressConfig(Section):
    """Everything that `python -m gran_bench.stress` reads."""

    selection: str = key("full", one_of("full", "short"))
    cases: list[str] = field(default_factory=list)  # names of cases of that selection; empty: all
    case_list: str | None = None  # YAML file of cases; null: the list in the package
    checkpoint: str = "shipped"  # model file; `shipped`: the one in the package
    also: list[str] = field(default_factory=list)  # further model files
    workers: int = key(2, at_least(1))  # cases at a time
    patience: float = key(900.0, positive("s"))  # that a case may take
    output: str = "results/stress"  # folder of the page
    dry_run: bool = False  # true: say what the command will do and take, and make nothing


@dataclass
class UiConfig(Section):
    """Everything that `python -m gran_bench.ui` reads."""

    port: int = key(5000, Range(1, 65535))  # of this machine
    shipped: bool = True  # the first start puts the project's own records into the store
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
