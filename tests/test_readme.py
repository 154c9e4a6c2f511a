"""The README keeps its word: its commands compose, its targets exist, its Python runs, its links lead somewhere."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from gran_bench.compare.command import compare_command
from gran_bench.compose import Source, checked_config, described_jobs
from gran_bench.config import (
    BenchmarkConfig,
    CalibrateConfig,
    CoarseGrainingConfig,
    EvaluateConfig,
    GenerateConfig,
    StressConfig,
    TrainConfig,
)
from gran_bench.export.command import export_command
from gran_bench.import_case.command import import_command

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text("utf-8")
SCHEMAS = {
    "train": TrainConfig,
    "evaluate": EvaluateConfig,
    "generate": GenerateConfig,
    "benchmark": BenchmarkConfig,
    "coarse_graining": CoarseGrainingConfig,
    "calibrate": CalibrateConfig,
    "stress": StressConfig,
}
WITHOUT_CONFIG = {"export": export_command, "import_case": import_command}
PLAIN_BLOCKS = re.findall(r"^```\n(.*?)^```", README, re.DOTALL | re.MULTILINE)
COMMANDS = [line.partition("#")[0].strip() for block in PLAIN_BLOCKS for line in block.splitlines()]
SNIPPETS = re.findall(r"^```python\n(.*?)^```", README, re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("command", [command for command in COMMANDS if command.startswith("python -m gran_bench.")])
def test_a_command_composes_into_a_legal_config(command, tmp_path, capsys):
    _, _, module, *arguments = shlex.split(command)
    entry = module.removeprefix("gran_bench.")
    if entry == "verify":  # arguments, no config
        listed = subprocess.run([sys.executable, "-m", module, *arguments, "--list"], capture_output=True, check=True)
        assert b"chung-ooi-1" in listed.stdout
        return
    if entry == "report":
        assert all(argument.startswith("results/sweeps/") for argument in arguments)
        return
    if entry == "compare":
        assert compare_command([*arguments, "--out", str(tmp_path / "compared.png")]) == 0
        return
    if entry in WITHOUT_CONFIG:
        assert WITHOUT_CONFIG[entry](arguments) == 2
        assert re.match(rf"error: {arguments[0]}( is no file|: no run)", capsys.readouterr().err)
        return
    overrides = [argument for argument in arguments if not argument.startswith("-")]
    for _, composed in described_jobs(Source(entry), overrides, "-m" in arguments).jobs:
        checked_config(composed, SCHEMAS[entry])


@pytest.mark.parametrize("command", [command for command in COMMANDS if command.startswith("make ")])
def test_a_make_target_exists(command):
    done = subprocess.run(["make", "-n", *shlex.split(command)[1:]], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_no_command_escapes_these_tests():
    assert all(command.startswith(("python -m gran_bench.", "make ")) for command in COMMANDS if command)
    assert len(COMMANDS) >= 8
    assert len(SNIPPETS) == 1


@pytest.mark.slow
def test_the_python_of_the_readme_runs(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    exec(compile(SNIPPETS[0], "README.md", "exec"), {})
    assert "requirements" in capsys.readouterr().out


@pytest.mark.parametrize("page", ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "data_gen/README.md"])
def test_links_and_pictures_lead_somewhere(page):
    path = ROOT / page
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text("utf-8")):
        if "://" not in target:
            assert (path.parent / target).exists(), f"{page} links to {target}"
