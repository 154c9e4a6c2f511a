"""A trained model as one small file: weights, and all that is needed to build the model around them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gran_bench.atomic import write_atomically
from gran_bench.config import MODEL_SCHEMAS, BoundaryConfig, SceneConfig
from gran_bench.config_check import read_config
from gran_bench.scene import build_scene
from gran_bench.surrogate.build import build_model
from gran_bench.surrogate.step import Surrogate


class CheckpointError(ValueError):
    """A file that is not a model of this project; the message names it and the remedy."""


@dataclass(frozen=True)
class ModelCard:
    """What a model file says about itself.

    Attributes:
        model: resolved ``model`` keys.
        boundary: resolved ``boundary`` keys.
        scene: resolved ``scene`` keys that the model was trained on.
        origin: provenance: command, commit, hardware, data digest, training steps and seconds.
    """

    model: dict[str, Any]
    boundary: dict[str, Any]
    scene: dict[str, Any]
    origin: dict[str, Any]


def save_model(path: Path, weights: dict[str, Tensor], card: ModelCard) -> str:
    """Write a model file whole or not at all; returns the SHA-256 of its bytes."""
    content = {"weights": {name: value.cpu() for name, value in weights.items()}, **vars(card)}
    write_atomically(path, lambda file: torch.save(content, file))
    return file_digest(path)


def load_card(path: Path) -> tuple[ModelCard, dict[str, Tensor]]:
    """Card and weights of a model file, without building the model.

    Raises:
        CheckpointError: no such file, or not a model of this project.
    """
    if not Path(path).exists():
        raise CheckpointError(f"model file {path} does not exist; train one, or leave the key out: one is shipped")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        weights = content.pop("weights")
        return ModelCard(**content), weights
    except Exception as error:
        raise CheckpointError(
            f"{path} is not a whole gran-bench model file ({type(error).__name__}: {error}); get or train it again"
        ) from error


def load_model(path: str | Path, device: str = "cpu") -> tuple[Surrogate, ModelCard]:
    """Build the model of a file and give it its weights.

    Args:
        path: a ``model.pt``.
        device: torch device.

    Raises:
        CheckpointError: no such file, or not a model of this project.
    """
    card, weights = load_card(Path(path))
    scene = build_scene(read_config(SceneConfig, card.scene))
    schema = MODEL_SCHEMAS[card.model["name"]]
    model = build_model(read_config(schema, card.model), read_config(BoundaryConfig, card.boundary), scene)
    model.load_state_dict(weights)
    return model.to(device).eval(), card


def file_digest(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
