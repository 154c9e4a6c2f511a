"""Where a result comes from: the commit says whether what decides it was changed."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

import gran_bench
from gran_bench.provenance import commit


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with a package and a record, in the place of this one."""
    for name in ("src/gran_bench/__init__.py", "results/README.md"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text("committed")
    author = ["-c", "user.name=A", "-c", "user.email=a@b"]
    for words in (["init", "-q"], ["add", "."], [*author, "commit", "-qm", "all"]):
        subprocess.run(["git", "-C", str(tmp_path), *words], check=True)
    monkeypatch.setattr(gran_bench, "__file__", str(tmp_path / "src/gran_bench/__init__.py"))
    return tmp_path


def test_a_changed_source_marks_the_commit_and_a_changed_record_does_not(clone: Path):
    clean = commit()
    assert len(clean) == 12
    (clone / "results" / "README.md").write_text("a sweep writes its page while its runs go on")
    assert commit() == clean
    (clone / "src" / "gran_bench" / "__init__.py").write_text("changed")
    assert commit() == f"{clean}+"


def test_an_installed_wheel_has_its_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(gran_bench, "__file__", str(tmp_path / "site-packages" / "gran_bench" / "__init__.py"))
    assert commit() == f"version {gran_bench.__version__}"
