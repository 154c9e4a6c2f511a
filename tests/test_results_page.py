"""The pages of the results: between marks stands what the committed records say; the sentences are people's."""

from __future__ import annotations

import importlib
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import benchmark_records
import pytest
from beds import flowing
from finished_runs import SCENE, broken, lost, run, summary_of

from gran_bench.files import write_part
from gran_bench.report.command import PAGE, drum_table, failures_table, renew_pages, report_command, scenes_table
from gran_bench.report.result_page import ResultPageError, write_page
from gran_bench.stress.page import early_ends
from gran_bench.sweep.runs import write_runs
from gran_bench.sweep.sweep_report import reaches

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results"
PAGES = ["README.md", *(f"{name}/README.md" for name in ("benchmark", "dem_speed", "holdout30rpm", "paper", "stress"))]
PAGES += ["sweeps/README.md", "verification/README.md"]
found = benchmark_records.found


def tracked() -> list[str]:
    words = ["git", "-C", str(ROOT), "ls-files", "results", "docs", "data_gen"]
    return subprocess.run(words, capture_output=True, encoding="utf-8", check=False).stdout.splitlines()


def read_part(path: Path, part: str) -> str:
    """What stands between the marks of a part of a page; empty where there is none."""
    return path.read_text("utf-8").partition(f"<!-- {part} -->\n")[2].partition("<!-- end -->\n")[0].strip()


# ---- the committed pages ---------------------------------------------------------------------------------


def test_every_table_is_what_its_committed_record_says(tmp_path: Path):
    for path in tracked():
        if path.startswith("results/"):
            (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / path, tmp_path / path)
    copy = tmp_path / "results"
    if not copy.exists():
        pytest.skip("no repository")
    renewed = {path.relative_to(copy).as_posix() for path in renew_pages(copy)}
    assert renewed == set(PAGES) - {"dem_speed/README.md"}  # that one is made of timings alone, by benchmarks/
    for page in renewed:
        fresh, kept = (copy / page).read_text("utf-8"), (RESULTS / page).read_text("utf-8")
        assert fresh == kept, f"run python -m gran_bench.report and commit results/{page}"


def test_there_are_twelve_pages_at_most():
    """The twelfth, docs/scale.md, is for who has more spheres or jobs than one machine carries."""
    pages = [path for path in tracked() if path.endswith(".md")]
    assert len(pages) <= 12
    assert {f"results/{page}" for page in PAGES} <= set(pages) or not pages


def test_the_front_page_is_short_and_begins_with_the_answer():
    lines = (RESULTS / PAGE).read_text("utf-8").splitlines()
    assert len(lines) <= 60
    assert re.search(r"\d", lines[2])


@pytest.mark.parametrize("page", PAGES)
def test_every_link_and_figure_is_there(page):
    links = re.findall(r"\]\(([^)#]+)[^)]*\)", (RESULTS / page).read_text("utf-8"))
    assert links
    assert [link for link in links if not ((RESULTS / page).parent / link).exists()] == []


@pytest.mark.parametrize("page", PAGES)
def test_every_record_says_its_command_its_commit_and_its_day(page):
    if page == PAGE:  # its tables name the day, and link to the pages that have the rest
        assert re.search(r"\| \d{4}-\d\d-\d\d \|", (RESULTS / page).read_text("utf-8"))
        return
    text = (RESULTS / page).read_text("utf-8")
    parts = re.findall(r"<!-- (.+) -->\n(?=.)", text.replace("<!-- end -->", ""))
    assert parts
    for part in set(parts) - {"what matters", "overview"}:  # both sum up other parts
        assert re.search(r"`[^`]+`, commit `[^`]+`, \d{4}-\d\d-\d\d", read_part(RESULTS / page, part)), part


# ---- marks -----------------------------------------------------------------------------------------------


def test_only_what_stands_between_marks_is_renewed(tmp_path: Path):
    page = tmp_path / "README.md"
    write_part(page, "drum", "| old |", "Title", "The drum")
    assert page.read_text() == "# Title\n\n## The drum\n\n<!-- drum -->\n| old |\n<!-- end -->\n"
    page.write_text("# Mine\n\nMy words.\n\n<!-- drum -->\n| old |\n<!-- end -->\n\nMore words.\n")
    write_part(page, "drum", "| new |\n", "Title", "The drum")
    assert page.read_text() == "# Mine\n\nMy words.\n\n<!-- drum -->\n| new |\n<!-- end -->\n\nMore words.\n"
    write_part(page, "other", "text", heading="Other")
    assert page.read_text().endswith("More words.\n\n## Other\n\n<!-- other -->\ntext\n<!-- end -->\n")
    assert read_part(page, "drum") == "| new |"
    assert read_part(page, "none") == ""


# ---- the command -----------------------------------------------------------------------------------------


def test_the_report_renews_what_is_there_and_says_what_cannot_be_read(tmp_path: Path, capsys):
    assert report_command(["--root", str(tmp_path)]) == 2
    (tmp_path / "paper").mkdir()
    shutil.copy(RESULTS / "paper/summary.json", tmp_path / "paper")
    assert report_command(["--root", str(tmp_path)]) == 0
    assert "| `ccnn` ([paper](paper/README.md))" in read_part(tmp_path / PAGE, "drum")
    assert "16 requirements" in read_part(tmp_path / PAGE, "failures")
    (tmp_path / "paper/summary.json").write_text("{")
    assert report_command(["--root", str(tmp_path)]) == 1
    assert "error:" in capsys.readouterr().err


def test_a_run_of_ones_own_becomes_a_page_whose_words_stay(tmp_path: Path):
    target = tmp_path / "mine"
    page = write_page(RESULTS / "holdout30rpm", target, "Mine")
    assert page.read_text("utf-8").startswith("# Mine\n\n<!-- judgement -->\n`contact`, 8,072 parameters")
    assert (target / "model.pt").exists()
    assert (target / "figures/flow.gif").exists()
    page.write_text(page.read_text("utf-8").replace("# Mine\n", "# Mine\n\nMy words.\n").replace("8,072", "no"))
    text = write_page(RESULTS / "holdout30rpm", target, "Other").read_text("utf-8")
    assert text.startswith("# Mine\n\nMy words.\n")
    assert "8,072 parameters" in text
    with pytest.raises(ResultPageError, match="not finished"):
        write_page(tmp_path, target, "Mine")


# ---- tables ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fails", [False, True])
def test_every_table_says_what_failed(tmp_path: Path, found: dict, fails: bool):
    for folder in ("holdout30rpm", "benchmark/quick/drum", "sweeps/sweep_radius"):
        (tmp_path / folder).mkdir(parents=True)
    rollout = broken(20) if fails else flowing(SCENE, seed=3)
    summary = summary_of(rollout, flowing(SCENE, seed=4), failed_frames=(20 if fails else None, None))
    made = {"command": "train", "commit": "abc", "day": "2026-11-30", "hardware": "two cores"}
    summary |= {"provenance": made, "training": summary["training"] | made}
    (tmp_path / "holdout30rpm/summary.json").write_text(json.dumps(summary))
    (tmp_path / "benchmark/quick/drum/benchmark.json").write_text(json.dumps(found))
    write_runs(tmp_path / "sweeps/sweep_radius", [run("0.08", 0, 1.0), run("0.1", 0, 2.0), lost("0.2", 0)])
    drum, scenes = "\n".join(drum_table(tmp_path)), "\n".join(scenes_table(tmp_path))
    assert re.search(r"\| net \| 0\.6 \| 0\.6 \|.*\|  \|", drum)
    assert "DEM 0.2 ms: 0.9 s, 1 floors | net: 0.6 s, 1.8 floors | the surrogate is 1.5 times as fast |" in scenes
    failed = "\n".join(failures_table(tmp_path))
    assert "| 1 of 4 methods in 1 scenes: DEM 5 ms (1) |" in failed
    assert "| 1 of 3 runs; 0 broke down in a rollout |" in failed
    assert ("[holdout30rpm](holdout30rpm/README.md) | 2026-11-30 | 0 requirements |" in failed) == (not fails)


def test_rollouts_that_ended_early_are_listed_with_their_time():
    def case(name: str, model: str, survived: float) -> dict[str, str]:
        quantities = json.dumps({"time_to_failure": survived, "horizon": 4.0})
        return {"part": "surrogate", "case": name, "model": model, "quantities": quantities}

    rows = [case("500 rpm", "net", 0.03), case("30 rpm", "net", 4.0), case("untrained", "", 0.1)]
    assert early_ends(rows) == [("500 rpm", "net", 0.03, 4.0), ("untrained", "", 0.1, 4.0)]


def test_the_time_of_a_frame_counts_only_where_the_network_has_other_work():
    def figures(axis: str) -> set[str]:
        runs = [replace(one, choices={axis: one.run}) for one in (run("0.08", 0, 1.0), run("0.1", 0, 4.0))]
        return {reach.figure for reach in reaches(runs)}

    for axis in ("model", "model.radius", "boundary", "+model.radius"):
        assert "a frame, ms" in figures(axis)
    for axis in ("loss", "rollout", "optim.learning_rate", "trainer.minutes"):
        assert figures(axis) == {"angle error, floors", "speed W1, floors", "position error, 10 frames, mm"}


def test_the_tables_beside_lammps_are_those_of_their_csv(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    part = importlib.import_module("drum_flow_page").part
    for name in ("drum_flow", "drum_flow_1e8"):
        kept = read_part(RESULTS / "verification/README.md", name)
        assert part(RESULTS / "verification" / f"{name}.csv") == kept, "run benchmarks/drum_flow.py --kept"
