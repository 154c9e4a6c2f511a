"""A user without a home or a package folder to write: caches go to a temporary folder, and one line says so."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "src" / "gran_bench"

# Defines every kernel and loads what draws.
WORK = """
import sys
if "numba first" in sys.argv: import numba
import gran_bench.dem.simulate, gran_bench.plots.evaluation
import gran_bench.surrogate.contact.network, gran_bench.surrogate.convolution.ccnn
import matplotlib
from gran_bench.dem.fast.stretch import march
print(march.stats.cache_path)
print(matplotlib.get_cachedir())
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package that no user can write a cache into, not even root: a file takes the place of each cache."""
    copy = tmp_path / "site" / "gran_bench"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    for folder in [copy, *(path for path in copy.rglob("*") if path.is_dir())]:
        (folder / "__pycache__").write_text("")
    return copy.parent


def done(package: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess:
    """The work by a user whose home cannot be made."""
    temporary = Path(environment.get("TMPDIR", package.parent / "tmp"))
    temporary.mkdir(exist_ok=True)
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("XDG_", "NUMBA_", "MPL"))}
    own = {"HOME": str(package / "gran_bench" / "__init__.py" / "home"), "TMPDIR": str(temporary)}
    return subprocess.run(
        [sys.executable, "-c", WORK, *arguments],
        env=inherited | own | {"PYTHONPATH": str(package), "PYTHONDONTWRITEBYTECODE": "1"} | environment,
        cwd=temporary, capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [(), ("numba first",)])
def test_without_a_place_to_cache_a_temporary_one_is_used_and_said_in_one_line(package: Path, arguments: tuple):
    first = done(package, *arguments)
    assert first.returncode == 0, first.stderr
    folder = package.parent / "tmp" / f"gran-bench-cache-{os.getuid()}"
    assert first.stderr == (
        "no folder of this user's can be written to keep compiled kernels and a list of fonts in: "
        f"{folder} is used (NUMBA_CACHE_DIR and MPLCONFIGDIR would choose another)\n"
    )
    kernels, fonts = map(Path, first.stdout.split())
    assert kernels.parent == folder
    assert fonts == folder
    assert folder.stat().st_mode & 0o077 == 0, "nobody else may put code there"
    # The next command finds what this one has compiled.
    assert done(package).stdout == first.stdout


def test_a_folder_that_the_user_has_chosen_is_used_without_a_word(package: Path, tmp_path: Path):
    chosen = tmp_path / "chosen"
    told = done(package, NUMBA_CACHE_DIR=str(chosen), MPLCONFIGDIR=str(chosen))
    assert (told.returncode, told.stderr) == (0, "")
    assert all(Path(line).is_relative_to(chosen) for line in told.stdout.split())


def test_a_folder_that_anybody_could_write_is_not_trusted(package: Path):
    planted = package.parent / "tmp" / f"gran-bench-cache-{os.getuid()}"
    planted.mkdir(parents=True)
    planted.chmod(0o777)
    told = done(package)
    assert told.returncode == 0, told.stderr
    kernels, _ = map(Path, told.stdout.split())
    assert planted not in kernels.parents
    assert list(planted.iterdir()) == []


def test_who_has_places_of_his_own_hears_nothing(tmp_path: Path):
    told = done(PACKAGE.parent, HOME=str(tmp_path), TMPDIR=str(tmp_path), NUMBA_CACHE_DIR="", MPLCONFIGDIR="")
    assert (told.returncode, told.stderr) == (0, "")
