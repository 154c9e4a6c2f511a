"""Damaged data: flipped bits, files cut short, NaN among the frames. All is noticed and named, with a remedy."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from tiny import model_file, tiny_specs

from gran_bench.dataset import DatasetError, Windows, ensure_cases, read_case, read_settled
from gran_bench.dataset.case_file import write_case
from gran_bench.dataset.generation import Job
from gran_bench.metrics.outside import count_failures
from gran_bench.state import Trajectory
from gran_bench.surrogate.checkpoint import CheckpointError, load_card
from gran_bench.trainer import CHECKPOINT

SPEC = tiny_specs(seconds=0.3)[1]
Whole = tuple[Path, Callable[[Path], Any]]


@pytest.fixture
def case(tmp_path: Path) -> Path:
    (path,) = ensure_cases([SPEC], tmp_path, workers=1, progress=False)
    return path


@pytest.fixture
def whole(request: pytest.FixtureRequest, tmp_path: Path) -> Whole:
    """A whole file of the kind that a test asks for, and what reads it."""
    if request.param == "case":
        return request.getfixturevalue("case"), read_case
    if request.param == "bed":
        job = Job(SPEC, tmp_path, settles=True)
        job.run(lambda seconds: None)
        return job.path, read_settled
    if request.param == "model":
        return model_file(tmp_path), load_card
    trainer = request.getfixturevalue("trainer")
    trainer.step = 7
    trainer.save()

    def resume(path: Path) -> Any:
        trainer.step = 0
        trainer.resume()
        return trainer.step, trainer.seconds, trainer.model.state_dict(), trainer.optimizer.state_dict()

    return tmp_path / CHECKPOINT, resume


def damage(content: bytes, how: str, place: int, bit: int = 3) -> bytes:
    if how == "cut":
        return content[:place]
    return content[:place] + bytes([content[place] ^ (1 << bit)]) + content[place + 1 :]


def fingerprint(value: Any) -> str:
    """What a reader returned, as text that two readings of the same content share."""
    if isinstance(value, torch.Tensor):
        return f"{value.dtype} {value.cpu().numpy().tobytes().hex()}"
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape} {value.tobytes().hex()}"
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{fingerprint(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, tuple | list):
        return "[" + ",".join(map(fingerprint, value)) + "]"
    if hasattr(value, "__dataclass_fields__"):
        return fingerprint({name: getattr(value, name) for name in value.__dataclass_fields__})
    return repr(value)


@pytest.mark.parametrize("how", ["flip", "cut"])
@pytest.mark.parametrize("whole", ["case", "bed", "model", "checkpoint"], indirect=True)
def test_damage_anywhere_is_named_with_a_remedy_or_changes_nothing_that_is_read(whole: Whole, how: str):
    path, read = whole
    content, good = path.read_bytes(), fingerprint(read(path))
    rng, told = np.random.default_rng(0), []
    for _ in range(60):
        place = int(rng.integers(len(content)))
        path.write_bytes(damage(content, how, place, int(rng.integers(8))))
        try:
            assert fingerprint(read(path)) == good, f"{how} at byte {place} goes unnoticed"
        except (DatasetError, CheckpointError) as error:
            told.append(str(error))
    assert told
    assert [said for said in told if str(path) not in said or not ("delete" in said or "again" in said)] == []


DAMAGED = "is cut short or damaged.*delete it and run the same command again"


@pytest.mark.parametrize(("whole", "how"), [("case", "flip"), ("case", "cut"), ("bed", "cut")], indirect=["whole"])
def test_damage_in_the_middle_is_always_noticed(whole: Whole, how: str):
    path, read = whole
    content = path.read_bytes()
    path.write_bytes(damage(content, how, len(content) // 2))
    with pytest.raises(DatasetError, match=DAMAGED):
        read(path)


# ---- NaN among the frames ----------------------------------------------------------------------------------


def poisoned(trajectory: Trajectory, frame: int) -> Trajectory:
    position = np.array(trajectory.position)
    position[frame, len(position[frame]) // 2, 1] = np.nan
    return replace(trajectory, position=position)


def test_a_nan_that_is_put_into_a_stored_frame_is_damage(case: Path, tmp_path: Path):
    copy = tmp_path / "broken.h5"
    shutil.copy(case, copy)
    with h5py.File(copy, "r+") as file:
        file["position"][12, 3, 1] = np.nan
    with pytest.raises(DatasetError, match=DAMAGED):
        read_case(copy)


def test_a_nan_that_a_solver_stored_is_counted(case: Path, tmp_path: Path):
    good = read_case(case)
    facts = {name: good.attributes[name] for name in ("time_step", "steps", "warnings", "wall_seconds")}
    forged = tmp_path / "forged.h5"
    write_case(forged, SPEC.key, good.scene, poisoned(good.trajectory, 12), good.settled, facts)
    again = read_case(forged)
    count = count_failures(again.trajectory, again.scene)
    assert (count.non_finite_states, count.states) == (1, 31)


def test_training_refuses_a_frame_with_a_nan(trainer):
    cases = [replace(case, trajectory=poisoned(case.trajectory, 30)) for case in trainer.windows.cases]
    with pytest.raises(DatasetError, match="position that is not finite in 1 of its frames, first in frame 30"):
        Windows(cases, trainer.config.seed)
