"""A disk that is full in the middle of a file: a clear error, no partial file, and nothing lost that was finished."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from tiny import model_file, tiny_specs

from gran_bench.dataset import DatasetError, ensure_cases
from gran_bench.files import write_text
from gran_bench.surrogate.checkpoint import CheckpointError


def files(folder: Path) -> dict[Path, str]:
    """Digest of every file below a folder but the locks."""
    return {
        path: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and ".locks" not in path.parts
    }


def refused(full_at, size: int, folder: Path, write: Callable[[], object], error: type[Exception], says: str) -> None:
    """Write what does not fit beside, or over, what was finished before."""
    before = files(folder)
    with full_at(size), pytest.raises(error) as caught:
        write()
    assert re.search(says, str(caught.value))
    assert files(folder) == before


@pytest.mark.parametrize("size", [0, 100, 20_000])
def test_a_case_that_does_not_fit_leaves_the_one_that_is_there(full_at, tmp_path, size):
    first, second, _ = tiny_specs(seconds=0.3)
    ensure_cases([first], tmp_path, workers=1, progress=False)

    def write() -> None:
        ensure_cases([second], tmp_path, workers=1, progress=False)

    refused(full_at, size, tmp_path, write, DatasetError, "cannot be made.*free space")
    write()  # with space again, the same command makes it
    assert second.path(tmp_path).exists()


@pytest.mark.parametrize("size", [0, 3000])
def test_a_settled_bed_that_does_not_fit_leaves_nothing(full_at, tmp_path, size):
    spec = tiny_specs(seconds=0.3)[1]

    def write() -> None:
        ensure_cases([spec], tmp_path, workers=1, progress=False)

    refused(full_at, size, tmp_path, write, DatasetError, "cannot be made.*free space")
    assert files(tmp_path) == {}


FULL = "cannot be written.*File too large.*free space"


@pytest.mark.parametrize("size", [0, 5000])
def test_a_model_that_does_not_fit_leaves_the_older_one(full_at, tmp_path, size):
    model_file(tmp_path)
    refused(full_at, size, tmp_path, lambda: model_file(tmp_path), CheckpointError, FULL)


@pytest.mark.parametrize("size", [0, 5000])
def test_a_checkpoint_that_does_not_fit_leaves_the_older_one(full_at, trainer, tmp_path, size):
    trainer.save()
    trainer.step = 1
    refused(full_at, size, tmp_path, trainer.save, CheckpointError, FULL)


@pytest.mark.parametrize("size", [0, 5000])
def test_a_page_that_does_not_fit_leaves_the_older_one(full_at, tmp_path, size):
    page = tmp_path / "README.md"
    write_text(page, "older\n")
    refused(
        full_at, size, tmp_path, lambda: write_text(page, "newer\n" * 100_000), OSError, r"File too large.*README\.md"
    )
