"""Which source decides a result, in written lists of rooms, and a hash of it that comments and layout don't change.

A room is a file, a folder with all below it or a pattern (``metrics/*.py``) of the package; one with a ``-`` before it
is taken out of those before it. A test holds the lists against imports. Of a plugin all source of its package counts.
"""

import ast
import hashlib
import importlib
from collections.abc import Iterable, Mapping
from pathlib import Path

import gran_bench
from gran_bench.config.registry import ADDED_TERMS, HOUSE, LOSS_TERMS, METRICS, MODELS
from gran_bench.config.rules import ConfigError

# What moves the DEM's particles: a change makes every case anew.
SOLVER = ("dem", "neighbors", "scene")
# States, walls, pairs, stored frames, and what all models share: what training and judging read. Of the DEM they know
# its data and its walls alone.
_READING = (
    *("state.py", "scene", "neighbors", "dem/outlet.py", "dem/seams.py", "dem/fast/wall_list.py", "dem/walls.py"),
    "dem/vectors.py",
    *("dataset/case_file.py", "dataset/scene_document.py", "dataset/windows.py", "dataset/mixture.py"),
    *(
        "surrogate",
        *(f"-surrogate/{name}" for name in ("checkpoint.py", "rollout.py", "contact", "convolution", "graph")),
    ),
)
# What decides the weights of a training, beside the model's modules.
TRAINING = (*_READING, "losses", "trainer")
# What a judge says of given weights, beside the model's modules. The DEM's runs are in its key by their names.
JUDGING = (
    *(*_READING, "dem/energy_balance.py", "dataset/generation.py"),
    *("surrogate/rollout.py", "metrics", "baselines.py", "evaluation"),
)
# What a benchmark measures of a method.
COMPARING = (
    *(*JUDGING, *SOLVER, "surrogate"),
    *("dataset/ensure.py", *(f"emulator/{name}.py" for name in ("network", "runs", "scan", "told"))),
    *("workers.py", *(f"benchmark/{name}.py" for name in ("contest", "errors", "jobs", "turns"))),
)

# Hashes that this process has taken; they stay what they were when its modules were loaded, whatever is edited later.
_taken: dict[str, str] = {}


def training_code(model: str, terms: Iterable[str] = ()) -> str:
    """Hash (12 digits) of the source that decides the weights of a model trained with some terms of the loss."""
    plugins = {MODELS.owner(model), *(LOSS_TERMS.owner(term) for term in ADDED_TERMS.intersection(terms))}
    return _hash(f"training {model}", (*TRAINING, *MODELS[model].code), plugins)


def judging_code() -> str:
    """Hash (12 digits) of the source that decides what a judge says of given rollouts, every metric's included."""
    return _hash("judging", JUDGING, METRICS.plugins())


def model_code(model: str) -> str:
    """Hash (12 digits) of a model's own modules: what given weights do."""
    return _hash(f"model {model}", MODELS[model].code, {MODELS.owner(model)})


def comparing_code() -> str:
    """Hash (12 digits) of the source that decides what a benchmark measures of a method."""
    return _hash("comparing", COMPARING, [*METRICS.plugins(), *MODELS.plugins()])


def taken_hashes() -> dict[str, str]:
    """The hashes that this process has taken, for one that was forked from modules of the same moment."""
    return dict(_taken)


def go_by(hashes: Mapping[str, str]) -> None:
    """Go by hashes that another process took: it loaded the same modules, which may have been edited since."""
    _taken.update(hashes)


def _hash(name: str, rooms: tuple[str, ...], packages: Iterable[str]) -> str:
    plugins = sorted({*packages} - {HOUSE})
    name = " with ".join([name, *plugins])
    if name not in _taken:
        sources = [source_digest(rooms), *map(_package_digest, plugins)]
        _taken[name] = (sources[0] if len(sources) == 1 else hashlib.sha256("".join(sources).encode()).hexdigest())[:12]
    return _taken[name]


def _package_digest(package: str) -> str:
    module = importlib.import_module(package)
    folders, file = getattr(module, "__path__", ()), getattr(module, "__file__", None)
    files = [path for folder in map(Path, folders) for path in sorted(folder.rglob("*.py"))] or [Path(file or "")]
    if not files[0].is_file():
        raise ConfigError(f"{package} registered something and has no source file to know it by; write a module")
    return _digest(package, [(path.name, path) for path in files])


def source_digest(rooms: Iterable[str]) -> str:
    """SHA-256 (64 hex digits) of the bare code of rooms: files, folders and patterns of the package."""
    package = Path(gran_bench.__file__).parent
    return _digest("", [(path.relative_to(package).as_posix(), path) for path in files_of(rooms)])


def _digest(name: str, files: Iterable[tuple[str, Path]]) -> str:
    texts = (f"{place}\n{bare_code(path.read_text('utf-8'))}\n" for place, path in files)
    return hashlib.sha256("".join([name, *texts]).encode()).hexdigest()


def files_of(rooms: Iterable[str]) -> list[Path]:
    """The source files of rooms, each once, in order; a `FileNotFoundError` where there is no such room."""
    package, found = Path(gran_bench.__file__).parent, set()
    for room in rooms:
        name = room.removeprefix("-")
        files = list((package / name).rglob("*.py")) or list(package.glob(name))
        if not files:
            raise FileNotFoundError(f"{package} has no {name}")
        found = found.difference(files) if room.startswith("-") else found.union(files)
    return sorted(found)


def bare_code(source: str) -> str:
    """Python source without comments, docstrings and layout."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            node.body[0] = ast.Pass()
    return ast.unparse(tree)
