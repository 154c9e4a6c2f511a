"""One stress case, carried out in this process; as a module, a process that serves them."""

import functools
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from gran_bench.config.rules import ConfigError
from gran_bench.stress.beds import BEDS
from gran_bench.stress.expectation import Bench, Experiment, Failure, Observation, Outcome
from gran_bench.stress.impacts import IMPACTS
from gran_bench.surrogate.checkpoint import load_card, load_model
from gran_bench.workers import serve

_loaded = functools.lru_cache(maxsize=2)(load_model)
DIAMETER = 0.05  # m, of the spheres of every scene in the lists
# Every kind by the name that a list gives it; its function says what it does and takes.
EXPERIMENTS: dict[str, Experiment] = {**IMPACTS, **BEDS}


def perform(kind: str, parameters: Mapping[str, Any], checkpoint: str, shared: str) -> Outcome:
    """Carry out an experiment on a model file, or on none; any error is an outcome, without the shared folder."""
    Path(shared).mkdir(parents=True, exist_ok=True)
    try:
        model = _loaded(checkpoint)[0] if checkpoint else None
        seen = EXPERIMENTS[kind].run(Bench(Path(shared), model), **parameters)
        return replace(seen, flags=tuple(flag.replace(shared, "…") for flag in seen.flags))
    except Exception as error:
        return Failure(type(error).__name__, str(error).replace(shared, "…"))


def outcome_of(document: Mapping[str, Any]) -> Outcome:
    """The outcome that plain data (`asdict`) describe."""
    return Failure(**document) if "error" in document else Observation(**document | {"flags": (*document["flags"],)})


def model_words(path: Path) -> tuple[str, str]:
    """Name and label of a model file, for tables; `CheckpointError` of none, `ConfigError` of other spheres."""
    card, _ = load_card(path)
    diameter = card.scene["filling"]["diameter"]
    if abs(diameter - DIAMETER) > 1e-9:
        raise ConfigError(
            f"checkpoint={path} was made for spheres of {diameter:g} m, and the lists have {DIAMETER:g} m; "
            "give a model of such spheres, or a list of your own"
        )
    return card.model["name"], f"{card.model['name']} ({path.parent.name})"


if __name__ == "__main__":
    torch.set_num_threads(1)
    serve(lambda task: asdict(perform(**task)))
