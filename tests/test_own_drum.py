"""docs/your_own_drum.md keeps its word: its three files are legal, its figures follow, its commands run, in small."""

from __future__ import annotations

import gzip
import json
import math
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from test_import_case import dump

from gran_bench import settle, simulate
from gran_bench.compose import checked_config, compose
from gran_bench.config import TrainConfig
from gran_bench.import_case.command import named_scene
from gran_bench.scene import build_scene

DOCS = Path(__file__).parents[1] / "docs"
PAGE = (DOCS / "your_own_drum.md").read_text("utf-8")
BLOCK = re.compile(r"```(\w*)\n(.*?)```", re.DOTALL)
PLAIN = [re.sub(r"\\\n\s*", "", text) for kind, text in BLOCK.findall(PAGE) if not kind]
COMMANDS = [line for text in PLAIN for line in text.splitlines()]
# The same files in small: fewer beads, frames and updates.
SMALL = {"count: 1500": "count: 60", "steps: 2000": "steps: 4"}
SMALL |= {"trainer.steps=3000": "trainer.steps=8", "trainer.steps=200": "trainer.steps=4"}
SHORT = "end_time: 1.7\nframe_interval: "
DUMPED = 1.7  # s, end of the dumps; 2 s on the page


def small(text: str) -> str:
    for large, little in SMALL.items():
        text = text.replace(large, little)
    return text.replace("frame_interval: ", SHORT).replace("scene.end_time=2", f"scene.end_time={DUMPED}")


def files_of_the_page() -> dict[str, str]:
    """Text of each file that the page names in the paragraph before a block, by its path."""
    found = {}
    for block in BLOCK.finditer(PAGE):
        if block[1] == "yaml":
            found[re.findall(r"`(conf/[\w/]+\.yaml)`", PAGE[: block.start()])[-1]] = block[2]
    return found


def folder_with(place: Path, changed=lambda text: text) -> Path:
    for path, text in files_of_the_page().items():
        (place / path).parent.mkdir(parents=True, exist_ok=True)
        (place / path).write_text(changed(text), "utf-8")
    return place


def words_of(command: str) -> list[str]:
    return command.split()[1:]


def test_the_page_has_three_files_and_every_command_is_ours():
    assert [path.split("/")[1] for path in files_of_the_page()] == ["scene", "dataset", "experiment"]
    assert all(command.startswith("python -m gran_bench.") for command in COMMANDS)
    assert all(large in PAGE for large in SMALL)


def test_the_page_leads_somewhere_and_its_pictures_are_small():
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", PAGE)
    assert 1 <= len(pictures) <= 2
    assert all((DOCS / picture).stat().st_size < 200_000 for picture in pictures)
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", PAGE):
        assert "://" in target or (DOCS / target).exists(), target


def test_the_commands_describe_the_drum_that_the_page_tells_of(tmp_path):
    folder_with(tmp_path)
    for command in COMMANDS:
        _, entry, *words = words_of(command)
        if entry == "gran_bench.train":
            assert words.pop(0) == "--config-dir=conf"
            config = checked_config(compose("train", words, str(tmp_path / "conf")), TrainConfig)
            scene, filling = build_scene(config.scene), config.scene.filling
            bed = filling.count * math.pi / 6.0 * filling.diameter**3 / 0.6  # with its gaps
            assert bed / (math.pi * scene.drum_radius**2 * scene.period) == pytest.approx(0.17, abs=0.005)
            assert scene.period == pytest.approx(7.0 * filling.diameter)
            fall_time = math.sqrt(filling.diameter / scene.gravity_strength)
            assert scene.frame_interval / fall_time == pytest.approx(0.14, abs=0.005)
            assert (config.dataset.training_speeds_rpm, config.dataset.holdout_speeds_rpm) == ([10.0, 30.0], [20.0])


@pytest.mark.slow
def test_every_command_of_the_page_runs_in_small(tmp_path):
    folder_with(tmp_path, small)
    scene = named_scene(str(tmp_path / "conf/scene/glass_drum.yaml"))
    scene = replace(scene, end_time=DUMPED)
    bed = settle(scene, seed=0)
    starts = {"lammps_10": 0, "lammps_30": 0, "lammps_20": 0, "nudged1_20": 1, "nudged2_20": 2}
    for name, nudge in starts.items():
        start, rpm = replace(bed, position=bed.position + 1e-10 * nudge), float(name[-2:])
        text = dump(simulate(scene.at_speed(rpm), start, DUMPED).trajectory, step=5e-5)
        (tmp_path / f"{name}.dump.gz").write_bytes(gzip.compress(text.encode()))
    environment = os.environ | {"PYTHONSAFEPATH": "1"}
    said, runs = {}, {}
    for command in COMMANDS:
        for name, run in runs.items():
            command = command.replace(name, run)
        done = subprocess.run(
            [sys.executable, *words_of(small(command))],
            cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"{command}\n{done.stderr}"
        said[command] = done.stdout + done.stderr
        finished = sorted((tmp_path / "results/runs").glob("*/summary.json"), key=os.path.getmtime)
        runs = dict(zip(("FIRST", "SECOND"), (path.parent.name for path in finished), strict=False))
    summaries = [json.loads(path.read_text("utf-8")) for path in finished]
    assert [summary["training"]["steps"] for summary in summaries] == [4, 8, 4]
    assert summaries[1]["training"]["parent_run"] == runs["FIRST"]
    assert [summary["judged_rpm"] for summary in summaries] == [20.0] * 3
    assert "takes about" in said[COMMANDS[0]]
    assert list(tmp_path.glob("*.vtkhdf"))
    assert list(tmp_path.glob("*.xyz"))
    assert summaries[2]["judged"]["shared"]["replicas"] == 2
