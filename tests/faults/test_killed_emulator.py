"""kill -9 while an emulator's runs are made or while it trains: the same command ends with the same weights."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

COMMAND = [
    *(sys.executable, "-m", "gran_bench.train", "+experiment=emulator"),
    *("scene=drum_small", "dataset=small", "judge=quick", "scene.filling.count=60", "scene.end_time=1.8"),
    *("model.schedules.runs=8", "model.schedules.twins=4", "model.schedules.constants=2", "model.width=8"),
    *("model.modes=4", "model.batch=4", "trainer.steps=60", "trainer.checkpoint_steps=2", "tracking.folder=resume"),
]
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
PATIENCE = 400.0  # s, of a test that would otherwise wait for ever


def start(folder: Path) -> subprocess.Popen[str]:
    folder.mkdir(exist_ok=True)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(COMMAND, cwd=folder, env=ENVIRONMENT, **pipes)


def finish(folder: Path) -> dict[str, torch.Tensor]:
    process = start(folder)
    output, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, output
    (path,) = folder.glob("results/runs/resume-*/model.pt")
    return torch.load(path, weights_only=True)["weights"]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, torch.Tensor]:
    return finish(tmp_path_factory.mktemp("undisturbed"))


@pytest.mark.parametrize("pattern", ["data/statistics/*.npz", "results/runs/resume-*/checkpoint.pt"])
def test_kill_9_in_the_data_or_the_training_and_again(tmp_path: Path, undisturbed, pattern: str):
    process, began = start(tmp_path), time.monotonic()
    while not list(tmp_path.glob(pattern)):
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() - began < PATIENCE, f"{pattern} never came"
        time.sleep(0.005)
    process.kill()
    process.communicate()
    again = finish(tmp_path)
    assert again.keys() == undisturbed.keys()
    assert all(torch.equal(again[name], undisturbed[name]) for name in again)
    assert not list((tmp_path / "data").rglob("*.tmp"))
