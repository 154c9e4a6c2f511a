"""A hash of source code that comments, docstrings and layout don't change."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterable
from pathlib import Path

import gran_bench


def source_digest(rooms: Iterable[str]) -> str:
    """SHA-256 (64 hex digits) of the bare code of rooms, in the order given.

    Args:
        rooms: files (``scene.py``) and folders (``dem``) of the package; a folder counts with all below it.

    Raises:
        FileNotFoundError: there is no such room.
    """
    package, digest = Path(gran_bench.__file__).parent, hashlib.sha256()
    for room in rooms:
        place = package / room
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            name = path.relative_to(package).as_posix()
            digest.update(f"{name}\n{bare_code(path.read_text('utf-8'))}\n".encode())
    return digest.hexdigest()


def bare_code(source: str) -> str:
    """Python source without comments, docstrings and layout."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            node.body[0] = ast.Pass()
    return ast.unparse(tree)
