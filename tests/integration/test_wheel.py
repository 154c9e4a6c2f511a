"""What a clone can do, an installed wheel can do from an empty folder."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# Four spheres that fall and turn for a moment.
TINY = ["scene.filling.count=4", "scene.filling.settled_speed=9", "scene.start_time=0.05", "scene.end_time=0.15"]
TINY += ["dem.engine=numpy", "dem.time_step=4e-4", "dataset.workers=1"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel of this tree, built without network in a copy, so that the tree stays clean."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("src", "conf", "results/holdout30rpm"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "wheel", "--no-index"]
    subprocess.run([*pip, "--no-deps", "--no-build-isolation", "-w", target, source], check=True, timeout=300)
    (built,) = target.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def python(wheel, tmp_path_factory) -> Path:
    """An environment that has the wheel, and for the rest looks into this one."""
    home = tmp_path_factory.mktemp("env")
    venv.create(home, with_pip=False)
    interpreter = home / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "--python", interpreter]
    subprocess.run([*pip, "install", "--no-index", "--no-deps", wheel], check=True, timeout=300)
    (site,) = home.rglob("site-packages")
    # Only a path: the editable install of this tree is not taken along.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", "utf-8")
    return interpreter


def run(python: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [python, "-m", *arguments]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300, check=False
    )


def test_the_wheel_has_every_module_and_every_config(wheel):
    with zipfile.ZipFile(wheel) as archive:
        packed = set(archive.namelist())
    for folder, place in ((ROOT / "src" / "gran_bench", "gran_bench"), (ROOT / "conf", "gran_bench/conf")):
        for pattern in ("*.py", "*.yaml", "*.pt"):
            for path in folder.rglob(pattern):
                assert f"{place}/{path.relative_to(folder).as_posix()}" in packed


def test_the_wheel_judges_the_model_that_it_ships(python, tmp_path):
    # The step is refused where the DEM would begin, after the model has been found, read and built.
    done = run(python, tmp_path, "gran_bench.evaluate", "dem.time_step=1e-2", "tracking=off")
    model, *_, error = done.stderr.splitlines()
    assert re.search(r"model contact: \d+ parameters from .*gran_bench/models/holdout30rpm/model\.pt", model), (
        done.stderr
    )
    assert str(ROOT) not in model
    assert "dem.time_step=0.01" in error


def test_the_wheel_runs_from_its_own_files(python, tmp_path):
    code = "import gran_bench, gran_bench.conf as c; print(gran_bench.__file__, *c.__path__)"
    found = subprocess.run([python, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert str(ROOT) not in found


def test_the_wheel_refuses_like_the_clone(python, tmp_path):
    done = run(python, tmp_path, "gran_bench.train", "model=cnn")
    assert done.returncode == 2
    models = ", ".join(sorted(path.stem for path in (ROOT / "conf" / "model").glob("*.yaml")))
    said = f"error: model=cnn: no such choice; did you mean ccnn? ({models}); "
    assert done.stderr == f"{said}own files are found with --config-dir=FOLDER\n"
    assert list(tmp_path.iterdir()) == []


def test_the_wheel_makes_data_and_trains_in_an_empty_folder(python, tmp_path):
    little = ["model.backend=torch", "model.iterations=1", "trainer.steps=2", "judge.speeds_rpm=[40]"]
    done = run(python, tmp_path, "gran_bench.train", "+experiment=smoke", *TINY, *little)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "results" / "mlflow.db").exists()
    assert list((tmp_path / "results").rglob("summary.json"))

    cases = {path: path.stat().st_mtime_ns for path in (tmp_path / "data").rglob("*.h5")}
    done = run(python, tmp_path, "gran_bench.generate", "scene=drum_small", "dataset=small", *TINY)
    assert done.returncode == 0, done.stderr
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "data").rglob("*.h5")} == cases, "all were there"


def test_the_wheel_verifies_its_solver(python, tmp_path):
    done = run(python, tmp_path, "gran_bench.verify", "--case", "chung-ooi-3", "--output", "page")
    assert done.returncode == 0, done.stderr
    assert "all within tolerance" in done.stdout
    assert (tmp_path / "page" / "verification.json").exists()
