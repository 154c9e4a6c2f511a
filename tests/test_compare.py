"""Runs side by side: how they are found, what differs, errors in floors, the picture, what is refused."""

from __future__ import annotations

import json
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path

import pytest
import stored_runs
from beds import flowing
from finished_runs import SCENE, broken, summary_of
from matplotlib.figure import Figure as Picture
from matplotlib.image import imread
from stored_runs import runs

from gran_bench.compare import figure
from gran_bench.compare.command import compare_command
from gran_bench.compare.figure import errors_in_floors
from gran_bench.compare.runs import UNSEEN, Figure
from gran_bench.tracking import open_run

template, config = stored_runs.template, stored_runs.config
SMALL, LARGE = "smoke+model.radius-0.06-11aa22bb", "smoke+model.radius-0.08-33cc44dd"
CONFIG = {
    "seed": 0,
    "scene": {"name": "drum_small", "filling": {"count": 300}},
    "model": {"name": "contact", "radius": 0.06, "memory": True},
    "trainer": {"steps": 100},
    "tracking": {"folder": "one"},
}


@pytest.fixture(scope="module")
def summaries() -> tuple[dict, dict]:
    """Of a whole run of both packings, and of one that broke down at frame 7."""
    good = summary_of(flowing(SCENE, seed=3), flowing(SCENE, seed=4))
    bad = summary_of(broken(7), flowing(SCENE, seed=4), failed_frames=(7, None), own=False)
    for summary in (good, bad):
        summary["training"] |= {"data_digest": "d1", "code_digest": "c1"}
        summary["nearest_case"]["35rpm"] = {"own_rpm": 35.0, "nearest_rpm": 35.0, "is_own": True}
        summary["nearest_case"]["35rpm"]["w1_m_s"] = {"35rpm": 0.0421}
        summary["rollouts"]["35rpm"] = summary["rollouts"]["30rpm"] | {"failed_frame": None}
    bad["training"]["data_digest"] = "d2"
    return good, bad


@pytest.fixture
def root(tmp_path: Path, summaries: tuple[dict, dict]) -> Path:
    """A results folder with two runs whose radius and training data differ."""
    for name, radius, summary in zip((SMALL, LARGE), (0.06, 0.08), summaries, strict=True):
        values = deepcopy(CONFIG)
        values["model"]["radius"] = radius
        values["tracking"]["folder"] = name
        write(tmp_path / "runs" / name, summary, values)
    return tmp_path


def write(folder: Path, summary: dict | None, values: dict | None) -> Path:
    folder.mkdir(parents=True)
    if summary is not None:
        (folder / "summary.json").write_text(json.dumps({"model": values["model"]} | summary if values else summary))
    if values is not None:
        (folder / "config.json").write_text(json.dumps(values))
    return folder


def row_of(text: str, name: str) -> list[str]:
    """What follows a name in its line of a table."""
    (line,) = [line for line in text.split("\n") if line.startswith(name)]
    return line.removeprefix(name).split()


def refusal(capsys: pytest.CaptureFixture, *arguments: str) -> str:
    assert compare_command(arguments) == 2
    out, error = capsys.readouterr()
    assert out == ""
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    return error


def test_only_what_differs_is_listed_and_every_headline_figure_has_its_floor(root, summaries, capsys):
    assert compare_command([SMALL, LARGE, "--root", str(root)]) == 0
    text = capsys.readouterr().out
    differ, figures = text.split("noise floor")
    assert row_of(differ, "model.radius") == ["0.06", "0.08"]
    assert row_of(differ, "training data") == ["d1", "d2"]
    for same in ("seed", "scene.", "trainer.", "tracking", "code digest", "model.memory"):
        assert same not in differ
    row = summaries[0]["judged"]["shared"]["errors"]["speed_w1"]
    floor, value, _, multiple, *_ = row_of(figures, "speeds, W1 a frame, m/s")
    assert (float(value), float(floor)) == pytest.approx((row["value"], row["floor"]), rel=0.01)
    assert float(multiple[:-1]) == pytest.approx(row["multiple_of_floor"], abs=0.01)
    assert row_of(figures, "states not finite or missing ")[1:] == ["0", "of", "31", "24", "of", "31"]
    assert row_of(figures, "rollouts broken down")[-6:] == ["of", "3;", "30rpm", "at", "frame", "7"]
    assert row_of(figures, "time of a frame (of the DEM), ms")[1:] == ["2", "(10)", "2", "(10)"]
    assert row_of(figures, "position 10 frames after a frame of the DEM, mm")[1:] == ["4", "4"]
    met = row_of(figures, "requirements met")
    assert int(met[1]) > int(met[4])
    picture = root / "comparisons" / "11aa22bb_33cc44dd.png"
    assert f"picture: {picture}" in text
    assert imread(picture).std() > 0.05


@pytest.mark.parametrize("word", [SMALL, "radius-0.06-11aa22bb", "radius-0.06", "11aa22bb", "smoke+model.radius-0.06"])
def test_a_run_is_found_by_each_of_its_names(root, word, capsys):
    assert compare_command([word, "33cc", "--root", str(root), "--out", str(root / "new" / "a.png")]) == 0
    assert capsys.readouterr().out.startswith("radius-0.06-11aa22bb: contact")
    assert (root / "new" / "a.png").exists()


def test_a_run_is_found_by_its_id_and_one_that_is_not_finished_by_its_command(template, config, summaries, capsys):
    other = write(template / "elsewhere" / "moved", summaries[0], None)
    for name, summary in (("smoke-55ee66ff", summaries[0]), ("smoke-77aa88bb", None)):
        folder = write(template / "runs" / name, summary, CONFIG)
        command = f"python -m gran_bench.train +experiment={name}"
        with open_run(config, name, name, {}, {"folder": f"results/runs/{folder.name}", "command": command}):
            pass
    ids = {run.info.run_name: run.info.run_id for run in runs(config)}
    arguments = [str(other), ids["smoke-55ee66ff"][:12], "--root", str(template)]
    assert compare_command(arguments) == 0
    assert "smoke-55ee66ff: contact, judged on drum_small, " in capsys.readouterr().out
    said = refusal(capsys, str(other), ids["smoke-77aa88bb"], "--root", str(template))
    assert "this run is not finished; to go on" in said
    assert "go on with it: python -m gran_bench.train +experiment=smoke-77aa88bb" in said


def test_a_folder_that_was_moved_elsewhere_needs_nothing_but_its_summary(root, tmp_path, summaries, capsys):
    alone = write(tmp_path / "usb" / "from-a-friend", summaries[1], None)
    assert compare_command([SMALL, str(alone), "--root", str(root)]) == 0
    text = capsys.readouterr().out
    assert "trainer.steps" not in text  # of one run alone nobody knows that it differs
    assert "judged on unnamed scene" in text
    assert "note: judged on different scenes or speeds" in text


def test_other_scenes_are_compared_all_the_same_and_said(root, summaries, capsys):
    summary = deepcopy(summaries[0]) | {"judged_rpm": 35.0}
    summary["judged"]["shared"]["errors"]["speed_w1"]["floor"] = 0.0123
    write(root / "evaluations" / "other", summary, CONFIG | {"scene": {"name": "drum"}})
    assert compare_command([SMALL, "other", "--root", str(root)]) == 0
    text = capsys.readouterr().out
    assert "note: judged on different scenes or speeds" in text
    assert row_of(text, "scene.name") == ["drum_small", "drum"]
    assert row_of(text, "scene.filling.count") == ["300", "–"]
    assert row_of(text, "speeds, W1 a frame, m/s")[1:3] == ["|", "0.0123"]


def test_another_speed_gives_what_needs_no_floor(root, capsys):
    assert compare_command([SMALL, LARGE, "--root", str(root), "--speed", "35"]) == 0
    text = capsys.readouterr().out
    assert row_of(text, "speeds, W1 to the one DEM run, m/s") == ["–", "0.0421", "0.0421"]
    assert "angle of repose" not in text
    assert "no picture: " in text
    assert "choose 30 or 35" in refusal(capsys, SMALL, LARGE, "--root", str(root), "--speed", "31")


def test_the_records_that_ship_stand_beside_each_other(tmp_path, capsys):
    assert compare_command(["holdout30rpm", "paper", "--root", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "holdout30rpm: contact, judged on drum, 3000 spheres, 30 rpm, held out" in text
    assert row_of(text, "model.name") == ["contact", "ccnn"]
    assert row_of(text, "requirements met")[1:4] == ["25", "of", "25"]
    names = ("shared packing", "unseen packing", "tells speeds apart", "rollouts")
    assert sum(int(row_of(text, f"of these, {name}")[1]) for name in names) == 25
    assert "undefined: angle of repose, over the series of paper: no straight surface in 335 of 401 states" in text


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "0 of at least two runs given"),
        ([SMALL], "1 of at least two runs given"),
        ([SMALL, "11aa22bb"], "this run is named more than once"),
        ([SMALL, "smoke"], f"the beginning of ROOT/runs/{SMALL}, ROOT/runs/{LARGE}; give more"),
        ([SMALL, "smoke+model.radios-0.08"], f"there are {LARGE}"),
        ([SMALL, "0.08"], f"there are {LARGE}"),
        ([SMALL, "abcdef"], "no run has this name, id or folder in ROOT; there are "),
        ([SMALL, LARGE, "--out", "a.jpg"], "--out a.jpg: the picture is a PNG"),
    ],
)
def test_what_cannot_be_compared_is_refused_in_a_line(root, words, said, capsys):
    assert said.replace("ROOT", str(root)) in refusal(capsys, *words, "--root", str(root))


def test_a_run_that_is_not_finished_or_not_whole_is_refused(root, capsys):
    folder = write(root / "runs" / "half-99", None, CONFIG)
    said = refusal(capsys, SMALL, "half", "--root", str(root))
    assert "not finished; to go on with it: repeat the command that began it" in said
    (folder / "summary.json").write_text('{"judged": ')
    assert "summary.json cannot be read" in refusal(capsys, SMALL, "half", "--root", str(root))
    (folder / "summary.json").write_text('{"judged": {}}')
    assert "no summary of a judged run" in refusal(capsys, SMALL, "half", "--root", str(root))


def test_a_picture_that_cannot_be_written_is_said_after_the_table(root, capsys):
    (root / "file").write_text("")
    assert compare_command([SMALL, LARGE, "--root", str(root), "--out", str(root / "file" / "a.png")]) == 1
    out, error = capsys.readouterr()
    assert "requirements met" in out
    assert "cannot be written" in error


def test_no_error_is_left_out_of_the_picture(tmp_path, monkeypatch):
    drawn = []

    @contextmanager
    def kept(path, width, height):
        drawn.append(Picture(figsize=(width, height), layout="constrained"))
        yield drawn[-1]

    monkeypatch.setattr(figure, "drawing", kept)
    compared = {
        "good": {"angle": Figure("1", floor="1", multiple=1.5), f"angle{UNSEEN}": Figure("1", floor="1", multiple=0.4)},
        "far": {"angle": Figure("9", floor="1", multiple=1e20), f"angle{UNSEEN}": Figure("?", floor="1")},
        "no floor": {"training": Figure("2")},
    }
    assert errors_in_floors(compared, "drum, 30 rpm", tmp_path / "a.png")
    (axes,) = drawn[0].axes
    lines = [line for line in axes.lines if len(line.get_xdata()) and line.get_marker() not in ("None", None)]
    low, high = axes.get_ylim()
    heights = [y for line in lines for y in line.get_ydata()]
    assert heights[:2] == [1.5, 0.4]
    assert len(heights) == 4
    assert all(low < y < high for y in heights)
    ticks = {label.get_text(): y for y, label in zip(axes.get_yticks(), axes.get_yticklabels(), strict=True)}
    assert heights[2:] == [ticks["> 1000"], ticks["undefined"]]
    assert ticks["the DEM itself: 1"] == 1.0
    assert "drum, 30 rpm" in axes.get_title("left") + axes.get_title()
    assert [text.get_text() for text in drawn[0].legends[0].get_texts()] == ["good", "far", "no floor"]
    assert not errors_in_floors({"no floor": compared["no floor"]}, "", tmp_path / "b.png")
