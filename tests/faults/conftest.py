"""What the tests of faults share: data that are made once, and trainers on them."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny import tiny_trainer

from gran_bench.trainer import Trainer


@pytest.fixture(scope="session")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose ``data`` all tests share."""
    return tmp_path_factory.mktemp("shared")


@pytest.fixture
def trainer(place: Path, tmp_path: Path) -> Trainer:
    """Of the smallest training, with its checkpoint in the test's folder."""
    return tiny_trainer(place / "training", tmp_path)
