"""A trained model as one small file: weights, and all that is needed to build the model around them."""

import hashlib
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gran_bench.config import BoundaryConfig, SceneConfig
from gran_bench.config.reading import read_config
from gran_bench.config.registry import MODELS
from gran_bench.config.rules import ConfigError, check_arguments, checked_value
from gran_bench.files import write_atomically
from gran_bench.scene import build_scene
from gran_bench.surrogate.step import Surrogate, build_model

MODEL = "model.pt"  # in the folder of a run
CHECKPOINT = "checkpoint.pt"  # there too: the state of its training


class CheckpointError(ValueError):
    """A file of weights that cannot be read or written; the message names it and the remedy."""


@dataclass(frozen=True)
class ModelCard:
    """What a model file says about itself; a rollout compares its scene and the drum's ``training_speeds_rpm``."""

    model: dict[str, Any]  # resolved keys, as are the next two
    boundary: dict[str, Any]
    scene: dict[str, Any]  # that the model was trained on
    origin: dict[str, Any]  # command, commit, hardware, data digest, training steps and seconds, speeds


def save_model(path: Path, weights: dict[str, Tensor], card: ModelCard) -> str:
    """Write a model file whole or not at all; returns the SHA-256 of its bytes."""
    write_tensors(path, {"weights": {name: value.cpu() for name, value in weights.items()}, **vars(card)})
    return file_digest(path)


def write_tensors(path: Path, content: dict[str, Any]) -> None:
    """Write tensors and plain values, whole or not at all.

    Raises:
        CheckpointError: the disk is full, or will not take the file; one that was there before is as it was.
    """
    try:
        write_atomically(path, lambda file: torch.save(content, file))
    except (OSError, RuntimeError) as error:  # torch hides the one behind the other
        reason = error if isinstance(error, OSError) else error.__context__ or error
        raise CheckpointError(
            f"{path} cannot be written ({getattr(reason, 'strerror', None) or reason}); free space and run the same "
            "command again, an older file of that name is as it was"
        ) from error


def read_tensors(path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """What `write_tensors` has written.

    Raises:
        ValueError: a byte of it is not as it was written.
        Exception: of any kind where it is no such file.
    """
    # torch reads past a flipped bit; the archive around the tensors has a checksum of each.
    with zipfile.ZipFile(path) as archive:
        damaged = archive.testzip()
    if damaged is not None:
        raise ValueError(f"{damaged} does not match its checksum")
    return torch.load(path, map_location=device, weights_only=True)


def load_card(path: Path) -> tuple[ModelCard, dict[str, Tensor]]:
    """Card and weights of a model file, without building the model.

    Raises:
        CheckpointError: no such file, not a model of this project, or damaged.
    """
    path = Path(checked_value(str, None, path, "path"))
    if not path.exists():
        raise CheckpointError(f"model file {path} does not exist; train one, or leave the key out: one is shipped")
    try:
        content = read_tensors(path)
        weights = content.pop("weights")
        return ModelCard(**content), weights
    except Exception as error:
        model = path / MODEL if path.is_dir() else path.with_name(MODEL)  # what may have been meant
        if model != path and model.exists():
            remedy = f"give {model}"
        elif path.name == CHECKPOINT:
            remedy = f"it is of a training that has not ended; the command that began it leaves {MODEL} beside it"
        else:
            remedy = "get or train it again"
        raise CheckpointError(
            f"{path} is not a whole gran-bench model file ({type(error).__name__}: {error}); {remedy}"
        ) from error


def load_model(path: str | Path, device: str = "cpu") -> tuple[Surrogate, ModelCard]:
    """Build the model of a file and give it its weights; it carries what its card says that it was trained for.

    Args:
        path: a ``model.pt``.
        device: torch device.

    Raises:
        CheckpointError: no such file, not a model of this project, or a device that PyTorch cannot use.
    """
    check_arguments(device=(device, str | torch.device))
    card, weights = load_card(path)
    try:
        scene = build_scene(read_config(SceneConfig, card.scene))
        if (name := card.model["name"]) not in MODELS:
            raise ConfigError(f"model {name} is not registered here: install the package that it is of")
        if not MODELS[name].particles:
            raise ConfigError(f"model {name} gives statistics and steps no particles; use gran_bench.load_emulator")
        schema = MODELS[name].config
        speeds = card.origin.get("training_speeds_rpm", ())
        model = build_model(read_config(schema, card.model), read_config(BoundaryConfig, card.boundary), scene, speeds)
        model.load_state_dict(weights)
    except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise CheckpointError(f"{path} describes no model that can be built ({reason}); train it again") from error
    try:
        return model.to(device).eval(), card
    except (AssertionError, RuntimeError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise CheckpointError(f"device={device} cannot be used ({reason}); choose cpu, or cuda with a GPU") from error


def file_digest(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def weights_digest(weights: Mapping[str, Tensor]) -> str:
    """SHA-256 of weights, their names and shapes, wherever and whenever they were written."""
    digest = hashlib.sha256()
    for name, value in sorted(weights.items()):
        digest.update(f"{name} {tuple(value.shape)} {value.dtype}".encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
