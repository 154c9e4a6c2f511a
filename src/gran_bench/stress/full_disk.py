"""A disk that is full in the middle of a file: a clear error, no partial file, and nothing lost that was finished.

The kernel refuses to let a file grow beyond a limit, at any byte that we choose; that is what a full disk does, and
needs neither a disk nor a privilege.
"""

from __future__ import annotations

import hashlib
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from gran_bench.dataset import ensure_cases
from gran_bench.files import write_text
from gran_bench.stress.damage import model_file
from gran_bench.stress.expectation import Observation
from gran_bench.stress.experiment import Bench, Experiment
from gran_bench.stress.tiny import tiny_specs, tiny_trainer


@contextmanager
def full_at(size: int) -> Iterator[None]:
    """While the block runs, no file of this process grows beyond ``size`` bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def full_disk(bench: Bench, writes: str, sizes: list[int]) -> Observation:
    """Something is written to a disk that is full after so many bytes, beside what was finished before.

    Args:
        writes: ``case`` (a second one), ``bed``, ``model`` (over an older one), ``checkpoint`` (over an older one) or
            ``page`` (over an older one).
        sizes: bytes that still fit, one attempt each.
    """
    partial, lost, quiet, told = 0, 0, 0, []
    for size in sizes:
        folder = bench.folder / str(size)
        folder.mkdir()
        write = _prepared(bench, writes, folder)
        before = _files(folder)
        try:
            with full_at(size):
                write()
            quiet += 1
        except Exception as error:
            told.append(f"{type(error).__name__}: {error}".replace(str(folder), str(bench.folder)))
        after = _files(folder)
        lost += sum(after.get(path) != digest for path, digest in before.items())
        partial += sum(path not in before for path in after)
    return Observation(
        {"partial": float(partial), "lost": float(lost), "quiet": float(quiet)}, tuple(dict.fromkeys(told))
    )


def _prepared(bench: Bench, writes: str, folder: Path) -> Callable[[], object]:
    """What is to be written, with what was there before in its place."""
    if writes in ("case", "bed"):
        first, second, _ = tiny_specs(seconds=0.3)
        if writes == "case":
            ensure_cases([first], folder, workers=1, progress=False)
        return lambda: ensure_cases([second], folder, workers=1, progress=False)
    if writes == "model":
        model_file(folder)
        return lambda: model_file(folder)
    if writes == "checkpoint":
        trainer = tiny_trainer(bench.shared / "training", folder)
        trainer.save()
        trainer.step = 1
        return trainer.save
    if writes == "page":
        write_text(folder / "README.md", "older\n")
        return lambda: write_text(folder / "README.md", "newer\n" * 100_000)
    raise ValueError(f"with.writes={writes} is unknown; choose case, bed, model, checkpoint or page")


def _files(folder: Path) -> dict[Path, str]:
    """Digest of every file below a folder but the locks."""
    return {
        path: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and ".locks" not in path.parts
    }


FULL_DISK = {
    "full_disk": Experiment(full_disk, {"partial": "files", "lost": "files", "quiet": "attempts"}),
}
