"""Which source decides a result: all that is imported on the way to its numbers, and nothing else."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

import gran_bench
from gran_bench import code_identity
from gran_bench.code_identity import (
    COMPARING,
    JUDGING,
    MODEL_SOURCES,
    TRAINING,
    judging_code,
    modules_behind,
    training_code,
)
from gran_bench.config import MODEL_SCHEMAS
from gran_bench.source_digest import EQUAL_CODE, source_digest


@pytest.fixture
def edited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The hashes of a copy of the package, and what appends a line to a file of it and gives the hashes after that."""
    source = Path(gran_bench.__file__).parent
    copy = tmp_path / "gran_bench"
    shutil.copytree(source, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(gran_bench, "__file__", str(copy / "__init__.py"))

    def codes() -> tuple[dict[str, str], str]:
        code_identity._taken.clear()
        code_identity._tree.cache_clear()
        return {model: training_code(model) for model in MODEL_SOURCES}, judging_code()

    def edit(file: str, line: str) -> tuple[dict[str, str], str]:
        path = copy / file
        path.write_text(path.read_text("utf-8") + f"\n{line}\n", "utf-8")
        return codes()

    yield codes(), edit
    monkeypatch.undo()
    code_identity._taken.clear()
    code_identity._tree.cache_clear()


def test_code_that_was_shown_to_give_the_bits_of_older_code_goes_by_its_hash(edited):
    older, edit = edited
    solver = source_digest(("dem",))
    newer = edit("dem/contact.py", "FASTER = True")
    assert newer != older
    assert source_digest(("dem",)) != solver
    table = Path(gran_bench.__file__).parent / EQUAL_CODE
    table.write_text(json.dumps({"older": {source_digest(("dem",)): solver}, "shown": []}))
    assert source_digest(("dem",)) == solver
    # An edit that nobody has compared is new code again.
    edit("dem/contact.py", "FASTER = False")
    assert source_digest(("dem",)) != solver


def test_the_table_of_equal_code_says_how_each_of_its_lines_was_shown():
    table = json.loads((Path(gran_bench.__file__).parent / EQUAL_CODE).read_text("utf-8"))
    assert set(table) == {"older", "shown"}
    assert all(re.fullmatch("[0-9a-f]{64}", digest) for pair in table["older"].items() for digest in pair)
    assert not set(table["older"]) & set(table["older"].values()), "older code has its own name"
    for shown in table["shown"]:
        assert shown["command"].startswith("python benchmarks/equal_bits.py ")
        assert shown["commit"]
        assert shown["hardware"]
    assert set(table["older"]) == {digest for shown in table["shown"] for digest in shown["older"]}


def test_every_model_has_its_source():
    assert set(MODEL_SOURCES) == set(MODEL_SCHEMAS)


def test_what_computes_the_numbers_is_found_and_what_only_shows_them_is_not():
    training = modules_behind(*TRAINING, MODEL_SOURCES["contact"])
    assert {"trainer", "surrogate.contact", "surrogate.contact_memory", "dataset.windows"} <= training
    assert any(module.split(".")[0] == "losses" for module in training)
    assert not {"surrogate.ccnn", "evaluation", "report", "tracking.run", "config", "provenance", "plots"} & training
    judging = modules_behind(*JUDGING)
    assert {"evaluation", "rollout", "metrics.judge", "metrics.angle_of_repose", "baselines"} <= judging
    assert not {"trainer", "surrogate.contact", "report"} & judging


def test_what_runs_times_and_judges_a_compared_method_is_found_and_the_page_of_it_is_not():
    comparing = modules_behind(*COMPARING)
    assert {
        "comparison.jobs",
        "comparison.turns",
        "comparison.errors",
        "metrics.judge",
        "dem.engine_numba",
    } <= comparing
    assert {"rollout", "surrogate.checkpoint", "surrogate.contact"} <= comparing  # a worker loads them on demand
    assert not {"comparison.page", "comparison.sentences", "comparison.claims", "trainer"} & comparing


def test_a_changed_judge_or_clock_of_a_comparison_measures_anew(edited):
    _, edit = edited
    before = code_identity.comparing_code()
    for file, differs in (
        ("comparison/errors.py", True),
        ("comparison/worker.py", True),
        ("comparison/page.py", False),
    ):
        edit(file, "X = 1")
        after = code_identity.comparing_code()
        assert (after != before) == differs, file
        before = after


def test_a_changed_line_changes_what_depends_on_it_and_nothing_else(edited):
    (models, judging), edit = edited
    one, same_judging = edit("surrogate/contact_solver.py", "SWEEPS = 3")
    assert one["contact"] != models["contact"]
    assert (one["radial"], one["ccnn"], same_judging) == (models["radial"], models["ccnn"], judging)
    two, other_judging = edit("metrics/angle_of_repose.py", "WIDTH = 3")
    assert (two, other_judging != judging) == (one, True)
    three, _ = edit("trainer.py", "PACE = 3")
    assert all(three[model] != two[model] for model in models)


@pytest.mark.parametrize(
    ("file", "line"),
    [("trainer.py", "# a remark"), ("report.py", "X = 1"), ("plots/style.py", "X = 1"), ("config.py", "X = 1")],
)
def test_remarks_tables_and_figures_decide_nothing(edited, file, line):
    before, edit = edited
    assert edit(file, line) == before


def test_a_process_goes_by_the_hashes_that_it_was_given(monkeypatch):
    monkeypatch.setattr(code_identity, "_taken", {})
    code_identity.take_over({"judging": "0" * 12})
    assert judging_code() == "0" * 12
    assert training_code("contact") == code_identity.taken_hashes()["training contact"] != "0" * 12
