"""What a run is called and what determines it, known before any of its work is done.

PyTorch is loaded only where the run starts from weights of another.
"""

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from gran_bench.config import EmulatorConfig, TrainConfig
from gran_bench.config.choices import weighed_terms
from gran_bench.config.identity import deciding_keys
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import CaseSpec, Split, dataset_digest, split_cases
from gran_bench.dataset.case_spec import key_hash
from gran_bench.emulator.schedules import Judged, judged_schedules, training_cases
from gran_bench.evaluation.plan import Plan
from gran_bench.provenance.source_digest import judging_code, model_code, training_code
from gran_bench.run.further_scenes import further_cases
from gran_bench.scene import Scene, build_scene
from gran_bench.shipped import shipped_scene


@dataclass(frozen=True)
class RunIdentity:
    """A run by what determines it, as hashes."""

    folder: Path  # of its files
    key: str  # of what determines the result of its training: deciding config keys, training data, training code
    judged_by: str  # of what determines its judgement: judge's keys, the DEM's runs it is held against, judging code
    data_digest: str  # of the training data


def identify(config: TrainConfig) -> RunIdentity:
    """The identity of the run that a checked config describes; a `DatasetError` where a training case is not there."""
    if isinstance(config.model, EmulatorConfig):
        plan = emulator_plan(config)
        digest, judged = hash_of([key_hash(spec.key) for spec in plan.training]), plan.judged_by
    else:
        digest = dataset_digest(spec.path(config.dataset.root) for spec in splits(config).training)
        judged = judged_by(judging_plan(config))
    key = key_of(config, digest)
    runs = Path(config.tracking.root) / "runs"
    folder = runs / f"{config.tracking.folder or config.experiment}-{key[:8]}"
    if not folder.exists():  # perhaps another command began the run under another name: it goes on there
        folder = next(iter(sorted(runs.glob(f"*-{key[:8]}"))), folder)
    return RunIdentity(folder, key, judged, digest)


def key_of(config: TrainConfig, data_digest: str) -> str:
    """Hash of what determines the result of a training on given data."""
    keys = deciding_keys(config)
    if config.trainer.start_from is not None:
        from gran_bench.run.start_from import start_of

        keys["trainer"]["start_from"] = start_of(config).digest  # however they were named
    return hash_of(keys, data_digest, training_code(config.model.name, weighed_terms(config.loss)))


def splits(config: TrainConfig) -> Split:
    """The cases that a config trains on, those of further scenes last, chooses by and holds out."""
    split = split_cases(build_scene(config.scene), config.dem, config.dataset)
    return replace(split, training=[*split.training, *further_cases(config)])


def needed_cases(config: TrainConfig) -> list[CaseSpec]:
    """Every case that training and judging read; the emulator keeps statistics alone, and makes them itself."""
    if isinstance(config.model, EmulatorConfig):
        return []
    return [*splits(config).all, *judging_plan(config).cases]


@dataclass(frozen=True)
class EmulatorPlan:
    """The runs of the DEM that an emulator learns from, and what it is judged on."""

    scene: Scene
    training: list[CaseSpec]
    judged: list[Judged]
    judged_by: str  # as of `RunIdentity`

    @property
    def replicas(self) -> list[CaseSpec]:
        """Every run of the DEM that judging needs."""
        return [spec for judged in self.judged for spec in judged.replicas]


def emulator_plan(config: TrainConfig) -> EmulatorPlan:
    """What an emulator learns from and is judged on.

    Raises:
        ConfigError: a scene of ``judge.scenes`` that differs from the emulator's in more than its motion.
        DatasetError: a judged motion among those of training.
    """
    scene, schedules, shipped = build_scene(config.scene), config.model.schedules, {}
    for name in config.judge.scenes:
        other = shipped_scene(name)
        if replace(other, name=scene.name, rotation=scene.rotation) != scene:
            raise ConfigError(
                f"judge.scenes={config.judge.scenes}: {name} differs from scene {scene.name} in more than its motion; "
                "leave it out"
            )
        shipped[name] = other.rotation
    training = training_cases(scene, config.dem, config.dataset, schedules, shipped)
    judged = judged_schedules(scene, config.dem, config.dataset, config.judge, schedules, shipped)
    cases = [key_hash(spec.key) for each in judged for spec in each.replicas]
    by = hash_of(asdict(config.judge), cases, judging_code(), model_code(config.model.name))
    return EmulatorPlan(scene, training, judged, by)


def judging_plan(config: TrainConfig) -> Plan:
    """What the trained model will be judged on."""
    return Plan(build_scene(config.scene), config.dem, config.dataset, config.judge)


def judged_by(plan: Plan) -> str:
    """Hash of what a model is judged on and with: the config keys, every run of the DEM, the code of the judge."""
    return hash_of(asdict(plan.judge), [key_hash(spec.key) for spec in plan.cases], judging_code())


def wants_more(config: TrainConfig, training: dict[str, Any]) -> bool:
    """Whether a training that its time cap stopped, as ``training.json`` says, has a larger cap now."""
    minutes = config.trainer.minutes
    if config.trainer.budget == "time" or training["stopped_by"] != "time":
        return False
    return minutes is None or 60.0 * minutes > training["seconds"]


def hash_of(*values: Any) -> str:
    """12 hex digits of the SHA-256 of plain values."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]
