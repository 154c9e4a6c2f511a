"""The rules of the house: imports go one way, one room speaks to MLflow, names say the quantity, entries are thin."""

from __future__ import annotations

import ast
import graphlib
import importlib.metadata
import re
import tomllib
from collections.abc import Iterator
from dataclasses import is_dataclass
from pathlib import Path

import pytest
from config_reads import Read, keys_of, reads

from gran_bench import config as schemas
from gran_bench.config import (
    BenchmarkConfig,
    CalibrateConfig,
    CoarseGrainingConfig,
    EvaluateConfig,
    GenerateConfig,
    OptimConfig,
    StressConfig,
    TrainConfig,
    TrainerConfig,
    UiConfig,
)

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "gran_bench"
MODULES = sorted(path for path in SOURCE.rglob("*.py") if path.name != "__init__.py")

# A module may import from rooms before its own.
ROOMS = [
    *("cache_folders", "files", "config", "provenance", "processes", "workers", "progress"),
    *("state", "scene", "neighbors", "dem", "verification", "dataset", "surrogate", "losses"),
    *("metrics", "baselines", "trainer", "evaluation", "emulator", "plots", "tracking", "compose", "shipped", "run"),
    *("sweep", "export", "compare", "entry", "import_case", "benchmark", "coarse_graining", "stress", "report"),
]
ENTRIES = ["train", "generate", "verify", "evaluate", "calibrate", "ui"]


def room_of(path: Path) -> str:
    """``surrogate`` for ``src/gran_bench/surrogate/cconv.py``."""
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def imported_modules(path: Path) -> Iterator[str]:
    """Dotted names of what a file imports, also inside functions; ``from a import b`` gives ``a.b``."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            yield from (f"{node.module}.{name.name}" for name in node.names)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_imports_go_one_way(path):
    order = {room: i for i, room in enumerate(ROOMS)} | {entry: len(ROOMS) for entry in ENTRIES}
    room = room_of(path)
    assert room in order, f"{room} has no place in the order of rooms; add it to ROOMS and to ARCHITECTURE.md"
    for module in imported_modules(path):
        head, _, rest = module.partition(".")
        if head != "gran_bench" or rest in ("", "__version__"):
            continue
        other = rest.partition(".")[0]
        entry = path.name == "__main__.py"
        assert other == room or entry or order[other] < order[room], f"{room} imports {other}, which comes after it"


def test_no_modules_import_each_other_in_a_circle():
    """Inside functions and for types alike: a circle ties modules into one, however late it closes."""
    files = {".".join(path.relative_to(SOURCE.parent).with_suffix("").parts): path for path in SOURCE.rglob("*.py")}
    files = {name.removesuffix(".__init__"): path for name, path in files.items()}
    del files["gran_bench"]  # the public face, and the version

    def module(name: str) -> str:
        return name if name in files else name.rpartition(".")[0]

    imports = {name: {module(found) for found in imported_modules(path)} & {*files} for name, path in files.items()}
    graphlib.TopologicalSorter(imports).prepare()  # raises a CycleError that names the modules


def test_files_have_a_size_to_read_at_a_sitting():
    lines = {str(path.relative_to(SOURCE)): len(path.read_text("utf-8").splitlines()) for path in MODULES}
    odd = {file: n for file, n in lines.items() if not 20 <= n <= 400 and not file.endswith("__main__.py")}
    assert odd == {}


def test_only_tracking_imports_mlflow():
    importers = {
        room_of(path) for path in MODULES for module in imported_modules(path) if module.partition(".")[0] == "mlflow"
    }
    assert importers <= {"tracking"}


def test_names_say_what_a_file_is_about():
    vague = re.compile(r"utils?|helpers?|manager|misc|common", re.IGNORECASE)
    assert [str(path) for path in SOURCE.rglob("*") if vague.search(path.name.removesuffix(".py"))] == []


@pytest.mark.parametrize("path", sorted(SOURCE.rglob("__init__.py")), ids=lambda path: str(path.relative_to(SOURCE)))
def test_an_init_only_hands_names_on(path):
    for node in ast.parse(path.read_text("utf-8")).body:
        names = isinstance(node, ast.Import | ast.ImportFrom | ast.Assign)
        docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        # The package's own hands its names on when they are asked for.
        lazy = path.parent == SOURCE and getattr(node, "name", "") in ("__getattr__", "__dir__")
        assert names or docstring or lazy, f"{path}:{node.lineno} is logic"


@pytest.mark.parametrize("path", [*(SOURCE / f"{entry}.py" for entry in ENTRIES), *SOURCE.glob("*/__main__.py")])
def test_an_entry_is_thin(path):
    statements = [node for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.stmt)]
    assert len(statements) <= 25
    assert not any(isinstance(node, ast.For | ast.While | ast.ClassDef) for node in statements)


def test_data_gen_holds_no_logic():
    for path in (ROOT / "data_gen").glob("*.py"):
        statements = ast.parse(path.read_text("utf-8")).body
        assert not any(isinstance(node, ast.FunctionDef | ast.ClassDef) for node in statements), path


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_public_names_have_a_docstring(path):
    tree = ast.parse(path.read_text("utf-8"))
    assert ast.get_docstring(tree), f"{path.name} does not say what it is about"
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            assert ast.get_docstring(node), f"{path.name}: {node.name} has no docstring"


def test_the_wheel_lists_every_package():
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]["packages"]
    found = {"gran_bench.conf", "gran_bench.models.holdout30rpm"}
    for path in MODULES:
        found.add(".".join(("gran_bench", *path.parent.relative_to(SOURCE).parts)))
    assert sorted(found) == sorted(listed)


def test_the_lock_pins_exact_versions_of_everything_that_the_project_names():
    lines = (ROOT / "requirements.lock").read_text("utf-8").split()
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.]+", line) for line in lines), "names and versions alone"
    pins = {name.lower().replace("_", "-"): version for name, version in (line.split("==") for line in lines)}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = project["optional-dependencies"]
    for requirement in [*project["dependencies"], *extras["test"], *extras["lint"]]:
        assert re.match(r"[A-Za-z0-9-]+", requirement)[0].lower() in pins
    assert pins["torch"] == "2.13.0"
    assert pins["mlflow"] == "3.17.2"
    assert not [name for name in pins if name.startswith(("nvidia", "triton"))]


def test_this_environment_is_the_locked_one():
    for line in (ROOT / "requirements.lock").read_text("utf-8").split():
        name, version = line.split("==")
        assert importlib.metadata.version(name).partition("+")[0] == version


@pytest.fixture(scope="module")
def keys_that_are_read() -> set[Read]:
    """By any room but those that check a config."""
    sources = [path.read_text("utf-8") for path in MODULES if room_of(path) != "config"]
    classes = [schema for schema in vars(schemas).values() if isinstance(schema, type)]
    return reads(sources, filter(is_dataclass, classes))


@pytest.mark.parametrize(
    "schema",
    [
        *(TrainConfig, GenerateConfig, EvaluateConfig, BenchmarkConfig, StressConfig, UiConfig),
        *(CoarseGrainingConfig, CalibrateConfig),
    ],
)
def test_every_config_key_is_read_by_something(schema, keys_that_are_read):
    assert set(keys_of(schema)) - keys_that_are_read == set()


@pytest.mark.parametrize(
    ("source", "key", "is_read"),
    [
        ("def f(config: TrainConfig): return config.trainer.steps", "steps", True),
        ("def f(config: TrainConfig):\n    budget = config.trainer\n    return budget.steps", "steps", True),
        ("class A:\n    config: TrainConfig\n    def f(self): return self.config.trainer.steps", "steps", True),
        ("def f(config: TrainConfig, thing): return config.trainer, thing.steps", "steps", False),
        ("def f(config: OptimConfig): return config.steps", "steps", False),
        ("def f(config: TrainConfig): return asdict(config.trainer)  # steps", "steps", False),
        ("def f(config: TrainerConfig): config.steps = 3", "steps", False),
        ("def f(config: TrainerConfig, name): return getattr(config, name)", "steps", True),
    ],
)
def test_a_key_counts_as_read_where_its_section_is_known(source, key, is_read):
    found = reads([source], [TrainConfig, TrainerConfig, OptimConfig])
    assert (("TrainerConfig", key) in found) == is_read
