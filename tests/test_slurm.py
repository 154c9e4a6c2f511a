"""What `hydra/launcher=slurm` refuses before any work; ``tests/faults/test_clusters.py`` has the real one."""

from __future__ import annotations

import importlib.util
import tomllib
from pathlib import Path

import pytest

from gran_bench.config.rules import ConfigError
from gran_bench.processes import MissingProgramError
from gran_bench.sweep import slurm
from gran_bench.sweep.slurm import PROGRAMS, SlurmLauncher

ROOT = Path(__file__).parents[1]


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """With submitit, which the check does not import."""
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)


@pytest.fixture
def programs(installed: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Slurm's programs as one script, which keeps the words it is given and does what ``answer`` says."""
    for name in PROGRAMS:
        path = tmp_path / name
        path.write_text(f'#!/bin/sh\necho "${{0##*/}}" "$@" > {tmp_path}/words\n. {tmp_path}/answer\n')
        path.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    (tmp_path / "answer").write_text("exit 0\n")
    return tmp_path


def test_a_missing_package_is_named_with_the_command_that_installs_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingProgramError, match=r"needs the package submitit.*; pip install 'gran-bench\[slurm\]'"):
        SlurmLauncher().check()


@pytest.mark.usefixtures("installed")
def test_a_machine_without_slurm_is_told_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(MissingProgramError, match=r"sbatch is not on this machine; .*hydra/launcher=local"):
        SlurmLauncher().check()


def test_what_slurm_would_refuse_is_refused_before_any_work(programs: Path):
    launcher = SlurmLauncher(partition="long", minutes=90, memory_gb=1.5, options={"account": "sand"})
    launcher.check()
    words = "--time=90 --partition=long --cpus-per-task=2 --mem=1536M --requeue --account=sand --wrap=true"
    assert (programs / "words").read_text() == f"sbatch --test-only {words}\n"
    (programs / "answer").write_text("echo 'sbatch: error: invalid partition specified: long' >&2; exit 1\n")
    with pytest.raises(ConfigError, match=r"partition=long, minutes=90.*: invalid partition specified: long; sinfo"):
        launcher.check()


@pytest.mark.parametrize(
    ("key", "value"), [("minutes", 0), ("cpus", 0), ("retries", -1), ("memory_gb", -2.0), ("n_jobs", 0)]
)
def test_an_impossible_key_is_named_with_its_value(key: str, value: float):
    with pytest.raises(ConfigError, match=rf"hydra\.launcher\.{key}={value:g} is impossible; choose"):
        SlurmLauncher(**{key: value})


def test_a_queue_that_does_not_answer_is_not_an_empty_one(programs: Path):
    (programs / "answer").write_text("printf '7 RUNNING\\n8_1 COMPLETED\\n'\n")
    assert slurm._states() == {"7": "RUNNING", "8_1": "COMPLETED"}
    (programs / "answer").write_text("exit 1\n")
    assert slurm._states() is None


def test_the_base_install_brings_neither_submitit_nor_ray():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    named = " ".join([*project["dependencies"], (ROOT / "requirements.lock").read_text("utf-8")]).lower().split()
    assert not [word for word in named if word.startswith(("submitit", "ray"))]
    extras = project["optional-dependencies"]
    assert [extras["slurm"][0].partition("~")[0], extras["ray"][0].partition("~")[0]] == ["submitit", "ray"]
