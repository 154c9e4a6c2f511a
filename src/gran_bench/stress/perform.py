"""One stress case, carried out in this process."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gran_bench.config.rules import ConfigError
from gran_bench.shipped import SHIPPED, shipped_model
from gran_bench.stress.expectation import Failure, Outcome
from gran_bench.stress.experiment import Bench, Subject
from gran_bench.stress.registry import EXPERIMENTS
from gran_bench.surrogate.checkpoint import load_card, load_model

DIAMETER = 0.05  # m, of the spheres of every scene in the lists


@dataclass(frozen=True)
class Task:
    """A case and the model that it is for.

    Attributes:
        kind: of the experiment.
        parameters: of the experiment.
        checkpoint: model file, or empty.
        shared: folder of what cases share.
    """

    kind: str
    parameters: dict[str, Any]
    checkpoint: str
    shared: str


def perform(task: Task) -> Outcome:
    """Do it; any error is an outcome, never the end of the list."""
    shared = Path(task.shared)
    shared.mkdir(parents=True, exist_ok=True)
    try:
        subject = _subject(task.checkpoint) if task.checkpoint else None
        seen = EXPERIMENTS[task.kind].run(Bench(shared, subject), **task.parameters)
        return replace(seen, flags=tuple(_without(flag, shared) for flag in seen.flags))
    except Exception as error:
        return Failure(type(error).__name__, _without(str(error), shared))


def _without(text: str, folder: Path) -> str:
    """A message without the name of a folder that exists only while the list runs."""
    return text.replace(str(folder), "…")


def model_file(checkpoint: str) -> Path:
    """The file that a ``checkpoint`` key names."""
    return shipped_model() if checkpoint == SHIPPED else Path(checkpoint)


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
def _subject(checkpoint: str) -> Subject:
    path = Path(checkpoint)
    name, label = model_words(path)
    model, card = load_model(path)
    return Subject(label, name, model, card.scene["filling"]["diameter"])
