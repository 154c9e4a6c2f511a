"""One stress case, carried out in this process; as a module, a process that serves them."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from gran_bench.config.rules import ConfigError
from gran_bench.stress.beds import BEDS
from gran_bench.stress.expectation import Failure, Observation, Outcome
from gran_bench.stress.experiment import Bench, Experiment
from gran_bench.stress.impacts import IMPACTS
from gran_bench.stress.rollouts import ROLLOUTS
from gran_bench.stress.steps import STEPS
from gran_bench.surrogate.checkpoint import load_card, load_model
from gran_bench.surrogate.step import Surrogate
from gran_bench.workers import serve

DIAMETER = 0.05  # m, of the spheres of every scene in the lists
# Every kind by the name that a list gives it; its function says what it does and takes.
EXPERIMENTS: dict[str, Experiment] = {**IMPACTS, **BEDS, **STEPS, **ROLLOUTS}


def perform(kind: str, parameters: Mapping[str, Any], checkpoint: str, shared: str) -> Outcome:
    """Carry out an experiment on a model file, or on none; any error is an outcome, never the end of the list.

    Messages do not name the folder of what cases share, for it exists only while the list runs.
    """
    Path(shared).mkdir(parents=True, exist_ok=True)
    try:
        model = _model(checkpoint) if checkpoint else None
        seen = EXPERIMENTS[kind].run(Bench(Path(shared), model), **parameters)
        return replace(seen, flags=tuple(flag.replace(shared, "…") for flag in seen.flags))
    except Exception as error:
        return Failure(type(error).__name__, str(error).replace(shared, "…"))


def outcome_of(document: Mapping[str, Any]) -> Outcome:
    """The outcome that plain data (`asdict`) describe."""
    if "error" in document:
        return Failure(**document)
    return Observation(**document | {"flags": tuple(document["flags"])})


def model_words(path: Path) -> tuple[str, str]:
    """Name (``contact``, …) and label of a model file, for tables.

    Raises:
        CheckpointError: no such file, or no model.
        ConfigError: a model of spheres of another size than the lists have.
    """
    card, _ = load_card(path)
    diameter = card.scene["filling"]["diameter"]
    if abs(diameter - DIAMETER) > 1e-9:
        raise ConfigError(
            f"checkpoint={path} was made for spheres of {diameter:g} m, and the lists have {DIAMETER:g} m; "
            "give a model of such spheres, or a list of your own"
        )
    return card.model["name"], f"{card.model['name']} ({path.parent.name})"


@functools.lru_cache(maxsize=2)
def _model(checkpoint: str) -> Surrogate:
    return load_model(checkpoint)[0]


if __name__ == "__main__":
    torch.set_num_threads(1)
    serve(lambda task: asdict(perform(**task)))
