"""What a run is called and what determines it, known before any of its work is done.

PyTorch is loaded only where the run starts from weights of another.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gran_bench.config import TrainConfig
from gran_bench.config.choices import weighed_terms
from gran_bench.config.identity import deciding_keys
from gran_bench.dataset import Split, dataset_digest, split_cases
from gran_bench.dataset.case_spec import key_hash
from gran_bench.evaluation.plan import Plan
from gran_bench.provenance.source_digest import judging_code, training_code
from gran_bench.scene import build_scene


@dataclass(frozen=True)
class RunIdentity:
    """A run by what determines it, as hashes."""

    folder: Path  # of its files
    key: str  # of what determines the result of its training: deciding config keys, training data, training code
    judged_by: str  # of what determines its judgement: judge's keys, the DEM's runs it is held against, judging code
    data_digest: str  # of the training data


def identify(config: TrainConfig) -> RunIdentity:
    """The identity of the run that a checked config describes; a `DatasetError` where a training case is not there."""
    digest = dataset_digest(spec.path(config.dataset.root) for spec in splits(config).training)
    key = key_of(config, digest)
    runs = Path(config.tracking.root) / "runs"
    folder = runs / f"{config.tracking.folder or config.experiment}-{key[:8]}"
    if not folder.exists():  # perhaps another command began the run under another name: it goes on there
        folder = next(iter(sorted(runs.glob(f"*-{key[:8]}"))), folder)
    return RunIdentity(folder, key, judged_by(judging_plan(config)), digest)


def key_of(config: TrainConfig, data_digest: str) -> str:
    """Hash of what determines the result of a training on given data."""
    keys = deciding_keys(config)
    if config.trainer.start_from is not None:
        from gran_bench.run.start_from import start_of

        keys["trainer"]["start_from"] = start_of(config).digest  # however they were named
    return hash_of(keys, data_digest, training_code(config.model.name, weighed_terms(config.loss)))


def splits(config: TrainConfig) -> Split:
    """The cases that a config trains on, chooses by and holds out."""
    return split_cases(build_scene(config.scene), config.dem, config.dataset)


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
