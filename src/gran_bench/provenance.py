"""Where a result comes from: command, commit, hardware, versions. Every result file carries this."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import psutil

import gran_bench

# Whatever decides a figure: the libraries whose numerics a run goes through.
LIBRARIES = ("numpy", "scipy", "numba", "torch")
# The rooms that a trained model and its rollout depend on.
RESULT_ROOMS = ("state.py", "scene.py", "neighbors.py", "dem", "dataset", "surrogate", "losses.py", "rollout.py")


def hardware() -> str:
    """One line: processor, cores, memory, accelerator."""
    processor = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                processor = line.split(":", 1)[1].strip()
                break
    except OSError:
        pass
    memory = psutil.virtual_memory().total / 2**30
    return f"{processor}, {os.cpu_count()} cores, {memory:.0f} GiB, {_accelerator()}"


def _accelerator() -> str:
    import torch

    return torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"


def commit() -> str:
    """The checked-out commit, with ``+`` where the tree has changes; the version for an installed wheel."""
    folder = Path(gran_bench.__file__).resolve().parents[2]
    if not (folder / ".git").exists():
        return f"version {gran_bench.__version__}"

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=False)
        return done.stdout.strip()

    head = git("rev-parse", "--short=12", "HEAD") or "no commit"
    return head + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")


def command() -> str:
    """The command line as a user would type it."""
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    program = f"python -m {spec.name}" if spec is not None else f"python {Path(sys.argv[0]).name}"
    return " ".join([program, *sys.argv[1:]])


def code_digest() -> str:
    """SHA-256 (12 digits) of the source of the rooms that a result depends on."""
    root, digest = Path(gran_bench.__file__).parent, hashlib.sha256()
    for room in RESULT_ROOMS:
        place = root / room
        files = sorted(place.rglob("*.py")) if place.is_dir() else [place] if place.exists() else []
        for file in files:
            digest.update(file.relative_to(root).as_posix().encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def provenance() -> dict[str, str]:
    """Command, commit, hardware, Python and library versions, code digest."""
    versions = {}
    for library in LIBRARIES:
        try:
            versions[library] = version(library)
        except PackageNotFoundError:
            versions[library] = "missing"
    return {
        "command": command(),
        "commit": commit(),
        "code_digest": code_digest(),
        "hardware": hardware(),
        "python": platform.python_version(),
        "versions": ", ".join(f"{name} {number}" for name, number in versions.items()),
    }
