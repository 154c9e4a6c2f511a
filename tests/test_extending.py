"""docs/extending.md keeps its word: its package registers what it says, its commands run, and a run is known by it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[1] / "docs" / "extending.md").read_text("utf-8")
BLOCK = re.compile(r"```(\w*)\n(.*?)```", re.DOTALL)
# The same commands in small.
SMALL = ["scene.filling.count=30", "scene.end_time=1.7", "trainer.steps=4", "dataset.replicas=2"]


def files_of_the_page() -> dict[str, str]:
    """Text of each file that the page names in the paragraph before a block, by its path."""
    found = {}
    for block in BLOCK.finditer(PAGE):
        named = re.findall(r"`([\w/]+\.(?:py|toml|yaml))`", PAGE[: block.start()].rpartition("```")[2])
        if named and block[1]:
            found[named[-1]] = block[2]
    return found


COMMANDS = next(text for kind, text in BLOCK.findall(PAGE) if not kind).splitlines()
SCRIPT = [text for kind, text in BLOCK.findall(PAGE) if kind == "python"][-1]


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A folder with the page's files, and its package as pip's editable installation leaves it."""
    place = tmp_path_factory.mktemp("grains")
    for path, text in files_of_the_page().items():
        (place / path).parent.mkdir(parents=True, exist_ok=True)
        (place / path).write_text(text, "utf-8")
    project = tomllib.loads((place / "pyproject.toml").read_text("utf-8"))["project"]
    metadata = place / "grains-0.1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: 0.1\n")
    points = "".join(
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in entries.items())
        for group, entries in project["entry-points"].items()
    )
    (metadata / "entry_points.txt").write_text(points)
    return place


def run(place: Path, *words: str, path: Path | None = None) -> subprocess.CompletedProcess:
    """A Python with the package on its path."""
    environment = os.environ | {"PYTHONPATH": str(path or place), "PYTHONSAFEPATH": "1"}
    command = [sys.executable, *words]
    return subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, check=False)


def said(place: Path, program: str) -> str:
    done = run(place, "-c", program)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_the_page_names_every_file_of_the_package():
    assert {f"grains/{name}.py" for name in ("__init__", "models", "field", "terms", "figures", "walls")} <= set(
        files_of_the_page()
    )
    assert len(COMMANDS) == 4


@pytest.mark.slow
def test_the_commands_of_the_page_run(place):
    model = Path()
    for command in COMMANDS:
        words = command.replace("MODEL", str(model)).split()[1:]
        small = SMALL if "train" in command else []
        done = run(place, *words, *small)
        assert done.returncode == 0, done.stderr
        if "short_drum" in command:
            summary_path = next((place / "results/runs").glob("*/summary.json"))
            model, summary = summary_path.with_name("model.pt"), json.loads(summary_path.read_text("utf-8"))
            shared = summary["judged"]["shared"]
            assert shared["errors"]["bed_height"]["floor"] > 0
            assert shared["figures"]["bed_height"]["dem_interval"] is not None
            assert "height of the bed" in done.stdout
            again = run(place, *words, *small)
            assert "finished before" in again.stderr
    assert list((place / "data").glob("*bowl*"))


TAKEN = """
from gran_bench.compose import checked_config, compose
from gran_bench.config import GenerateConfig, TrainConfig
for name, words in {commands}:
    checked_config(compose(name, words, "conf"), dict(train=TrainConfig, generate=GenerateConfig)[name])
    print(name)
"""


def test_the_commands_of_the_page_are_taken_as_they_are_written(place):
    split = [command.split()[2:] for command in COMMANDS if "--config-dir=conf" in command]
    commands = [(name.removeprefix("gran_bench."), words) for name, _, *words in split]
    assert said(place, TAKEN.format(commands=commands)).split() == ["generate", "train", "train"]


def test_the_python_of_the_page_runs(place):
    assert "height of the bed" in said(place, SCRIPT)


def test_loading_a_plugin_loads_no_pytorch(place):
    program = "import sys\nfrom gran_bench.config.registry import MODELS\n"
    program += "print('field' in MODELS, 'torch' in sys.modules)"
    assert said(place, program) == "True False"


KEYS = """
from gran_bench.compose import compose, checked_config
from gran_bench.config import TrainConfig
from gran_bench.config.identity import deciding_keys
from gran_bench.provenance.source_digest import training_code, judging_code
from gran_bench.run.identity import hash_of
config = checked_config(compose("train", {overrides}, "conf"), TrainConfig)
from gran_bench.config.choices import weighed_terms
print(hash_of(deciding_keys(config), training_code(config.model.name, weighed_terms(config.loss))), judging_code())
"""


def keys(place: Path, *overrides: str, path: Path | None = None) -> list[str]:
    done = run(place, "-c", KEYS.format(overrides=list(overrides)), path=path)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.slow
def test_a_run_is_known_by_the_plugins_that_take_part_and_by_no_other(place, tmp_path):
    house = "+experiment=smoke"
    with_plugin, without = keys(place, house), keys(place, house, path=tmp_path)
    assert with_plugin[0] == without[0]  # registered, unused
    assert with_plugin[1] != without[1]  # its metric is in every judgement
    trained, weighed = keys(place, house, "model=field"), keys(place, house, "+loss.height=0.5")
    source = place / "grains/field.py"
    text = source.read_text("utf-8")
    try:
        source.write_text(text + "\n# a remark\n")
        assert keys(place, house, "model=field") == trained
        source.write_text(text + "\nEDITED = 1\n")
        assert keys(place, house, "model=field")[0] != trained[0]
        assert keys(place, house, "+loss.height=0.5")[0] != weighed[0]
        assert keys(place, house)[0] == without[0]
    finally:
        source.write_text(text)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["model=field", "model.width=0"], "model.width=0 is impossible; choose a value ≥ 1"),
        (["model=field", "model.widht=9"], "did you mean model.width?"),
        (["model=field", "loss.spin=1"], "needs a model that predicts spin"),
        (["loss.height=0.5"], "write +loss.height=0.5"),
        (["+loss.hight=0.5"], "did you mean loss.height?"),
        (["+loss.height=-1"], "loss.height=-1 is impossible; choose a value ≥ 0"),
        (["scene=bowl", "scene.container.kind=bowel"], "did you mean bowl?"),
        (["scene=bowl"], "does not turn"),
        (["model=field", "~model.width", "model.width=9"], "leaves this key out; write +model.width=9"),
    ],
)
def test_what_a_plugin_adds_is_refused_as_the_houses_own(place, overrides, message):
    done = run(place, "-m", "gran_bench.train", "--config-dir=conf", "+experiment=smoke", *overrides)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_plugin_that_fails_is_named_in_one_sentence(place):
    source = place / "grains/terms.py"
    text = source.read_text("utf-8")
    try:
        source.write_text("import no_such_module\n")
        done = run(place, "-m", "gran_bench.generate", "scene=drum_small")
        assert done.returncode == 2
        assert done.stderr.count("\n") == 1
        assert "the plugin grains of the package grains (grains) cannot be loaded: ModuleNotFoundError" in done.stderr
    finally:
        source.write_text(text)


def test_a_wall_that_does_not_hold_its_filling_is_refused_before_any_work(place):
    source = place / "grains/walls.py"
    text = source.read_text("utf-8")
    try:
        source.write_text(text.replace("-rim, 0.25 * height", "-rim, 0.0"))  # into the slope
        done = run(place, "-m", "gran_bench.generate", "--config-dir=conf", "scene=bowl", "dataset.root=elsewhere")
        assert done.returncode == 2
        assert "let the Container of scene.container.kind=bowl have a room" in done.stderr
        assert not (place / "elsewhere").exists()
    finally:
        source.write_text(text)


def test_both_engines_agree_in_a_registered_wall(place):
    program = """
import numpy as np
from gran_bench import DemConfig, settle, simulate
from gran_bench.compose import checked_config, compose
from gran_bench.config import GenerateConfig
from gran_bench.scene import build_scene
composed = compose("generate", ["scene=bowl", "scene.filling.count=5"], "conf")
scene = build_scene(checked_config(composed, GenerateConfig).scene)
start = scene.fresh_filling(0)
runs = [simulate(scene, start, 0.05, dem=DemConfig(engine=engine)).trajectory for engine in ("numba", "numpy")]
print(np.abs(runs[0].position - runs[1].position).max() < 1e-9)
"""
    assert said(place, program) == "True"
