"""Which source decides a result: the modules that a training, or a judgement, imports, and nothing else of the package.

They are found by following imports at the top of files from where the numbers are made. A change elsewhere, such as a
figure, a table or another model, leaves finished runs finished; a change among them makes them anew. Comments,
docstrings and layout don't count.
"""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator, Mapping
from pathlib import Path

import gran_bench
from gran_bench.source_digest import source_digest

PACKAGE = "gran_bench"
# The module that a model's weights are computed in; `surrogate.build` imports it on demand.
MODEL_SOURCES = {"contact": "surrogate.contact", "ccnn": "surrogate.ccnn", "radial": "surrogate.ccnn"}
TRAINING = ("training_start", "trainer", "surrogate.build")
JUDGING = ("evaluation",)
# Time and error of a method that is compared; what its process loads on demand is named.
COMPARING = (
    *("dem.simulate", "scene.build", *sorted(set(MODEL_SOURCES.values())), "surrogate.checkpoint"),
    *(*JUDGING, "baselines"),
    *("comparison.worker", "comparison.turns", "comparison.errors"),
)
# They say which values are legal, where files lie or how a process ends, and change no number. What a config says is in
# a run's key by its values.
NEUTRAL = frozenset(
    {
        *("cache_folders", "atomic", "source_digest", "code_identity", "provenance", "stopping"),
        *("config", "config_rules", "config_check", "config_consistency", "config_identity"),
        *("dataset.progress", "dataset.workers"),
    }
)


# Hashes that this process has taken; they stay what they were when its modules were loaded, whatever is edited later.
_taken: dict[str, str] = {}


def training_code(model: str) -> str:
    """Hash (12 digits) of the source that decides the weights of a model.

    Args:
        model: its name, as in ``model.name``.
    """
    return _hash(f"training {model}", (*TRAINING, MODEL_SOURCES[model]))


def judging_code() -> str:
    """Hash (12 digits) of the source that decides what a judge says of given weights."""
    return _hash("judging", JUDGING)


def comparing_code() -> str:
    """Hash (12 digits) of the source that decides what a comparison measures of a given method."""
    return _hash("comparing", COMPARING)


def taken_hashes() -> dict[str, str]:
    """The hashes that this process has taken, for one that was forked from modules of the same moment."""
    return dict(_taken)


def take_over(hashes: Mapping[str, str]) -> None:
    """Go by hashes that another process took: it loaded the same modules, which may have been edited since."""
    _taken.update(hashes)


def modules_behind(*roots: str) -> set[str]:
    """Dotted names, below the package, of all modules that ``roots`` import at the top of their files, themselves too.

    A name that a package hands on counts as the module that it comes from. `NEUTRAL` modules are left out, and what
    only they import.
    """
    found: set[str] = set()
    waiting = list(roots)
    while waiting:
        module = waiting.pop()
        if module in found or module in NEUTRAL:
            continue
        found.add(module)
        waiting += [name for node in _tree(_file(module)).body for name in _imported(node)]
    return found


def _hash(name: str, roots: tuple[str, ...]) -> str:
    if name not in _taken:
        package = _package()
        files = [_file(module).relative_to(package).as_posix() for module in sorted(modules_behind(*roots))]
        _taken[name] = source_digest(files)[:12]
    return _taken[name]


def _imported(node: ast.stmt) -> Iterator[str]:
    """The modules of the package that a statement imports."""
    if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == PACKAGE:
        inside = node.module.removeprefix(PACKAGE).lstrip(".")
        for name in node.names:
            yield from _source_of(inside, name.name)


def _source_of(module: str, name: str) -> Iterator[str]:
    """The module behind ``from module import name``."""
    folder = _package() / module.replace(".", "/")
    if not folder.is_dir():
        yield module
        return
    below = f"{module}.{name}".lstrip(".")
    if _file(below).exists():
        yield below
        return
    if (folder / name).is_dir():
        for path in (folder / name).glob("*.py"):
            yield ".".join(path.relative_to(_package()).with_suffix("").parts)
        return
    for node in _tree(folder / "__init__.py").body:
        if isinstance(node, ast.ImportFrom) and any((entry.asname or entry.name) == name for entry in node.names):
            yield from _source_of((node.module or "").removeprefix(PACKAGE).lstrip("."), name)


def _package() -> Path:
    return Path(gran_bench.__file__).parent


def _file(module: str) -> Path:
    return _package() / f"{module.replace('.', '/')}.py"


@functools.cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text("utf-8"))
