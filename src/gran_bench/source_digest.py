"""A hash of source code that comments, docstrings and layout don't change, nor a rewriting that changes no result.

``equal_code.json`` names code that was shown to give the bits of older code (`benchmarks/equal_bits.py`, which writes
it): it goes by the older hash. So a faster solver leaves data, runs and records valid. Code that is not in the table,
such as an edit that nobody has compared, has a hash of its own.
"""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Iterable
from pathlib import Path

import gran_bench

EQUAL_CODE = "equal_code.json"


def source_digest(rooms: Iterable[str]) -> str:
    """SHA-256 (64 hex digits) of the bare code of rooms, in the order given, or of older code that gives the same bits.

    Args:
        rooms: files (``scene.py``) and folders (``dem``) of the package; a folder counts with all below it.

    Raises:
        FileNotFoundError: there is no such room.
    """
    package = Path(gran_bench.__file__).parent
    paths = [
        path
        for room in rooms
        for path in (sorted((package / room).rglob("*.py")) if (package / room).is_dir() else [package / room])
    ]
    return digest_of((path.relative_to(package).as_posix(), path.read_text("utf-8")) for path in paths)


def digest_of(sources: Iterable[tuple[str, str]]) -> str:
    """The same of files by their path below the package and their source, from wherever they come."""
    digest = hashlib.sha256()
    for name, source in sources:
        digest.update(f"{name}\n{bare_code(source)}\n".encode())
    table = Path(gran_bench.__file__).parent / EQUAL_CODE
    own = digest.hexdigest()
    return json.loads(table.read_text("utf-8"))["older"].get(own, own)


def bare_code(source: str) -> str:
    """Python source without comments, docstrings and layout."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            node.body[0] = ast.Pass()
    return ast.unparse(tree)
