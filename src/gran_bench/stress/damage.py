"""Damaged data: flipped bits, files cut short, NaN among the frames. All is noticed and named, with a remedy."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

from gran_bench.dataset import DatasetError, Windows, ensure_cases, read_case, read_settled
from gran_bench.dataset.case_file import write_case
from gran_bench.dataset.generation import Job
from gran_bench.metrics.outside import count_failures
from gran_bench.state import Trajectory
from gran_bench.stress.expectation import Observation
from gran_bench.stress.experiment import Bench, Experiment
from gran_bench.stress.tiny import tiny_specs, tiny_trainer, tiny_training
from gran_bench.surrogate.build import build_model
from gran_bench.surrogate.checkpoint import CheckpointError, ModelCard, load_card, save_model
from gran_bench.trainer import CHECKPOINT

NAMED = (DatasetError, CheckpointError)
REMEDIES = ("delete", "again")  # words of which a message has one


def damaged_files(bench: Bench, file: str, how: str, tries: int = 40, seed: int = 0) -> Observation:
    """A whole file is damaged at random places, one at a time, and read.

    Args:
        file: ``case``, ``bed``, ``model`` (a trained one) or ``checkpoint`` (of a training).
        how: ``flip`` (a bit) or ``cut`` (the end off).
        tries: places.
        seed: of the places.
    """
    path, read = _whole_file(bench, file)
    content, whole = path.read_bytes(), _fingerprint(read(path))
    rng = np.random.default_rng(seed)
    noticed, unnoticed, unnamed, examples = 0, 0, 0, []
    for _ in range(tries):
        path.write_bytes(_damaged(content, how, int(rng.integers(len(content))), int(rng.integers(8))))
        try:
            unnoticed += _fingerprint(read(path)) != whole
        except NAMED as error:
            said = str(error)
            named = str(path) in said and any(word in said for word in REMEDIES)
            noticed, unnamed = noticed + named, unnamed + (not named)
        except Exception as error:
            unnamed += 1
            examples.append(f"{type(error).__name__}: {error}")
    path.write_bytes(content)
    return Observation(
        {"noticed": float(noticed), "unnoticed": float(unnoticed), "unnamed": float(unnamed)}, tuple(examples[:2])
    )


def damaged_file(bench: Bench, file: str, how: str, place: float = 0.5) -> Observation:
    """A file that is damaged at one place, and read.

    Args:
        file, how: as for :func:`damaged_files`.
        place: where, of its length.
    """
    path, read = _whole_file(bench, file)
    content = path.read_bytes()
    path.write_bytes(_damaged(content, how, int(place * len(content)), 3))
    return Observation({"unnoticed": float(len(_fingerprint(read(path))) > 0)})


def _damaged(content: bytes, how: str, place: int, bit: int) -> bytes:
    if how == "cut":
        return content[:place]
    if how != "flip":
        raise ValueError(f"with.how={how} is unknown; choose flip or cut")
    return content[:place] + bytes([content[place] ^ (1 << bit)]) + content[place + 1 :]


def _whole_file(bench: Bench, file: str) -> tuple[Path, Callable[[Path], Any]]:
    """A file of the kind in the bench's own folder, and what reads it."""
    if file in ("case", "bed"):
        spec = tiny_specs(seconds=0.3)[1]
        job = Job(spec, bench.folder, settles=True)
        job.run(lambda seconds: None)
        if file == "bed":
            return job.path, read_settled
        (path,) = ensure_cases([spec], bench.folder, workers=1, progress=False)
        return path, read_case
    if file == "model":
        return model_file(bench.folder), load_card
    if file == "checkpoint":
        trainer = tiny_trainer(bench.shared / "training", bench.folder)
        trainer.step = 7
        trainer.save()

        def resume(path: Path) -> Any:
            trainer.step = 0
            trainer.resume()
            return trainer.step, trainer.seconds, trainer.model.state_dict(), trainer.optimizer.state_dict()

        return bench.folder / CHECKPOINT, resume
    raise ValueError(f"with.file={file} is unknown; choose case, bed, model or checkpoint")


def model_file(folder: Path) -> Path:
    """An untrained model in a file of a folder; one that is there is replaced."""
    config, scene = tiny_training(folder / "data")
    torch.manual_seed(0)
    model = build_model(config.model, config.boundary, scene)
    card = ModelCard(asdict(config.model), asdict(config.boundary), asdict(config.scene), {"steps": 0})
    save_model(folder / "model.pt", model.state_dict(), card)
    return folder / "model.pt"


def _fingerprint(value: Any) -> str:
    """What a reader returned, as text that two readings of the same content share."""
    if isinstance(value, torch.Tensor):
        return f"{value.dtype} {value.cpu().numpy().tobytes().hex()}"
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape} {value.tobytes().hex()}"
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{_fingerprint(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, tuple | list):
        return "[" + ",".join(map(_fingerprint, value)) + "]"
    if hasattr(value, "__dataclass_fields__"):
        return _fingerprint({name: getattr(value, name) for name in value.__dataclass_fields__})
    return repr(value)


def nan_in_case(bench: Bench, frame: int, forged: bool = False) -> Observation:
    """A stored case that has a NaN at a frame.

    Args:
        frame: which.
        forged: whether its digest was made anew, as by a program that stores what a broken solver gave.
    """
    path, case = _case_with_nan(bench.folder, frame, forged)
    again = read_case(path)
    count = count_failures(again.trajectory, again.scene)
    return Observation(
        {"non_finite": float(count.non_finite_states), "frames": float(case)},
        (f"{count.non_finite_states} of {count.states} states not finite",) if count.non_finite_states else (),
    )


def nan_in_training(bench: Bench, frame: int) -> Observation:
    """Training on a case with a NaN at a frame.

    Args:
        frame: which.
    """
    trainer = tiny_trainer(bench.shared / "training", bench.folder)
    cases = [replace(case, trajectory=_poisoned(case.trajectory, frame)) for case in trainer.windows.cases]
    trainer.windows = Windows(cases, trainer.config.seed)
    trainer.run(progress=False)
    return Observation({"non_finite": 0.0, "frames": float(trainer.step)})


def _case_with_nan(folder: Path, frame: int, forged: bool) -> tuple[Path, int]:
    spec = tiny_specs(seconds=0.3)[1]
    (path,) = ensure_cases([spec], folder, workers=1, progress=False)
    if forged:
        case = read_case(path)
        broken = _poisoned(case.trajectory, frame)
        facts = {name: case.attributes[name] for name in ("time_step", "steps", "warnings", "wall_seconds")}
        target = folder / "forged" / path.name
        write_case(target, spec.key, case.scene, broken, case.settled, facts)
        return target, broken.frame_count
    copy = folder / "broken" / path.name
    copy.parent.mkdir(exist_ok=True)
    shutil.copy(path, copy)
    with h5py.File(copy, "r+") as file:
        file["position"][frame, 3, 1] = np.nan
        return copy, len(file["position"])


def _poisoned(trajectory: Trajectory, frame: int) -> Trajectory:
    position = np.array(trajectory.position)
    position[frame, len(position[frame]) // 2, 1] = np.nan
    return replace(trajectory, position=position)


DAMAGE = {
    "damaged_files": Experiment(damaged_files, {"noticed": "files", "unnoticed": "files", "unnamed": "errors"}),
    "damaged_file": Experiment(damaged_file, {"unnoticed": "files"}),
    "nan_in_case": Experiment(nan_in_case, {"non_finite": "states", "frames": "frames"}),
    "nan_in_training": Experiment(nan_in_training, {"non_finite": "states", "frames": "frames"}),
}
