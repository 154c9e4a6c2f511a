"""Which source decides a result: the lists hold what they need, and an edit elsewhere leaves results valid."""

from __future__ import annotations

import ast
import shutil
from pathlib import Path

import pytest

import gran_bench
from gran_bench.config.registry import MODELS
from gran_bench.provenance import source_digest
from gran_bench.provenance.source_digest import (
    COMPARING,
    JUDGING,
    TRAINING,
    comparing_code,
    files_of,
    go_by,
    judging_code,
    model_code,
    taken_hashes,
    training_code,
)

PACKAGE = Path(gran_bench.__file__).parent
# They say which values are legal, where files lie, which data a run has, how a process ends and how far it is, and
# change no number.
NEUTRAL = (
    *("cache_folders", "files", "provenance", "processes", "progress", "config"),
    *("surrogate/checkpoint", "__init__"),
)
# In a run's key by the digest of its data.
DATA = ("dataset/case_spec", "dataset/imported", "dem/simulate")


@pytest.fixture
def edit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Appends a line to a file of a copy of the package; gives which hashes that changes."""
    copy = tmp_path / "gran_bench"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(gran_bench, "__file__", str(copy / "__init__.py"))

    def hashes() -> dict[str, str]:
        monkeypatch.setattr(source_digest, "_taken", {})
        found = {f"train {model}": training_code(model) for model in MODELS}
        found |= {f"model {model}": model_code(model) for model in MODELS}
        return found | {"judge": judging_code(), "compare": comparing_code()}

    def changes(file: str, line: str) -> set[str]:
        before, path = hashes(), copy / file
        path.write_text(path.read_text("utf-8") + f"\n{line}\n", "utf-8")
        after = hashes()
        return {name for name in after if after[name] != before[name]}

    return changes


CONVOLUTIONS = ("ccnn", "radial", "lu2021", "xu_shen2022")
TRAININGS = {f"train {model}" for model in MODELS}


@pytest.mark.parametrize(
    ("file", "changed"),
    [
        ("trainer/trainer.py", TRAININGS),
        ("losses/frame_ahead.py", TRAININGS),
        ("surrogate/contact/solver.py", {"train contact", "model contact", "compare"}),
        (
            "surrogate/convolution/cconv.py",
            {f"{what} {name}" for what in ("train", "model") for name in CONVOLUTIONS} | {"compare"},
        ),
        ("surrogate/graph/messages.py", {"train gns", "model gns", "compare"}),
        ("metrics/angle_of_repose.py", {"judge", "compare", "train emulator", "model emulator"}),
        ("emulator/network.py", {"train emulator", "model emulator", "compare"}),
        ("neighbors/cells.py", {*TRAININGS, "judge", "compare"}),
        ("dem/contact.py", {"compare"}),  # trainings and judgements know the DEM by its data
        ("benchmark/turns.py", {"compare"}),
        *((file, set()) for file in ("benchmark/page.py", "plots/style.py", "config/schema.py", "sweep/table.py")),
    ],
)
def test_an_edit_makes_anew_what_passes_through_it_and_nothing_else(edit, file, changed):
    assert edit(file, "EDITED = 3") == changed


def test_comments_and_docstrings_make_nothing_anew(edit):
    assert edit("trainer/trainer.py", "# a remark") == set()


def test_every_model_has_its_modules_and_a_new_module_of_surrogates_counts_for_all(edit):
    assert all(model.code for model in MODELS.values())
    (Path(gran_bench.__file__).parent / "surrogate/new.py").write_text("")
    assert edit("surrogate/new.py", "NEW = 1") == {*TRAININGS, "judge", "compare"}


@pytest.mark.parametrize(
    ("rooms", "elsewhere"),
    [*(((*TRAINING, *MODELS[model].code), DATA) for model in MODELS), (JUDGING, DATA), (COMPARING, DATA)],
    ids=[*(f"train {model}" for model in MODELS), "judge", "compare"],
)
def test_a_list_holds_all_that_its_files_import(rooms, elsewhere):
    files = set(files_of(rooms))
    for path in files:
        for node in ast.parse(path.read_text("utf-8")).body:  # at the top: what loads on demand has its own list
            if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("gran_bench"):
                continue
            for name in node.names:
                place = (node.module.removeprefix("gran_bench").lstrip(".")).replace(".", "/")
                below = [PACKAGE / place / f"{name.name}.py", PACKAGE / f"{place}.py"]
                found = next((one for one in below if one.exists()), None)
                if found is None:  # a name that a package hands on: one of the package's files has it
                    listed = place.startswith(NEUTRAL) or any(PACKAGE / place in one.parents for one in files)
                    assert listed, f"{path} imports {node.module}"
                    continue
                inside = found.relative_to(PACKAGE).with_suffix("").as_posix()
                if found not in files:
                    assert inside.startswith((*NEUTRAL, *elsewhere)), f"{path.name} imports {inside}; list it"


def test_a_room_that_is_not_there_is_an_error():
    with pytest.raises(FileNotFoundError, match="no_such_room"):
        files_of(["no_such_room.py"])


def test_a_process_goes_by_the_hashes_that_it_was_given(monkeypatch):
    monkeypatch.setattr(source_digest, "_taken", {})
    go_by({"judging": "0" * 12})
    assert judging_code() == "0" * 12
    assert training_code("contact") == taken_hashes()["training contact"] != "0" * 12
