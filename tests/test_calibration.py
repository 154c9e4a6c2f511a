"""Calibration of coarse spheres: at the training speeds alone, resumable, and honest about what it cost."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from test_coarse_graining import TINY

from gran_bench.coarse_graining import calibration
from gran_bench.coarse_graining.calibration import Trial, calibrate, search
from gran_bench.compose import checked_config, compose
from gran_bench.config import CalibrateConfig
from gran_bench.config.rules import ConfigError
from gran_bench.metrics.judgement import ErrorRow
from gran_bench.metrics.measured import Measured


def config(root: Path, *overrides: str) -> CalibrateConfig:
    given = [*TINY, "scene.coarse_graining=1.26", "dataset.training_speeds_rpm=[20,30]", "trials=3"]
    places = [f"dataset.root={root}/data", f"root={root}/results"]
    return checked_config(compose("calibrate", [*given, *places, *overrides]), CalibrateConfig)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        (
            "speeds_rpm=[20,40]",
            r"\[20.0, 40.0\] has 40 rpm, which dataset.holdout_speeds_rpm=\[40.0\] holds",
        ),
        ("speeds_rpm=[-40]", "which dataset.holdout_speeds_rpm=.* holds out for judging: no calibration may read it"),
        (
            "speeds_rpm=[25]",
            r"\[25.0\] has 25 rpm, which dataset.training_speeds_rpm=\[20.0, 30.0\] has not",
        ),
        ("scene.coarse_graining=1", "scene.coarse_graining=1 leaves nothing to calibrate; choose more, such as 2"),
        ("scene.rotation.speeds_rpm=[20,30] scene.rotation.times=[0.4,0.5]", "keeps its own motion"),
        ("trials=2", "trials=2 is impossible; choose a value ≥ 3"),
    ],
)
def test_a_calibration_that_would_see_too_much_or_nothing_is_refused(tmp_path, override, words):
    with pytest.raises(ConfigError, match=words):
        config(tmp_path, *override.split())


def test_a_search_finds_the_least_loss_within_its_trials_and_asks_for_no_pair_twice():
    asked = []

    def loss(pair):
        asked.append(pair)
        return 1.0 + 10.0 * abs(pair[0] - 0.22) + 20.0 * abs(pair[1] - 0.02)

    seen = {}
    search(lambda pair: seen.setdefault(pair, None) or loss(pair), (0.3, 0.0), 40)
    assert asked[0] == (0.3, 0.0)
    assert len(set(asked)) <= 40
    best = min(set(asked), key=lambda pair: loss(pair))
    assert best == (pytest.approx(0.22, abs=0.02), pytest.approx(0.02, abs=0.01))
    assert all(friction > 0 and rolling >= 0 for friction, rolling in asked)
    few = set()
    search(lambda pair: few.add(pair) or 1.0 - pair[0], (0.3, 0.0), 5)
    assert len(few) <= 5


def row(error: float | None, floor: float | None) -> ErrorRow:
    found = [Measured.undefined("deg", "none") if x is None else Measured(x, "deg") for x in (error, floor)]
    return ErrorRow("com_angle", "angle", "deg", *found)


def test_the_loss_is_the_mean_in_floors_of_what_counts_and_infinite_where_that_is_lost():
    def loss(*rows: ErrorRow, counted: str = "01") -> float:
        errors = {30.0: {str(k): one for k, one in enumerate(rows)}}
        return Trial(0.3, 0.0, errors, frozenset((30.0, key) for key in counted), 1.0).loss

    assert loss(row(2.0, 1.0), row(3.0, 0.5)) == pytest.approx(4.0)
    assert loss(row(2.0, 1.0), row(None, None), counted="0") == 2.0
    assert loss(row(2.0, 1.0), row(None, 0.5)) == math.inf


def test_a_calibration_reads_training_speeds_alone_goes_on_and_says_what_to_use(tmp_path, capsys):
    found = calibrate(config(tmp_path))
    said = capsys.readouterr().out
    cases = sorted(path.name for path in (tmp_path / "data").glob("*.h5"))
    assert len(cases) == 2 * 2 + 3 * 2  # two replicas and three trials at two speeds
    assert not [name for name in cases if "40rpm" in name]
    assert [trial["friction"] for trial in found["trials"]] == [0.3, 0.225, 0.3]
    assert [trial["rolling_friction"] for trial in found["trials"]] == [0.0, 0.02, 0.05]
    losses = [trial["loss_floors"] for trial in found["trials"]]  # null where a trial lost the angle of repose
    assert found["found"]["loss_floors"] == min(loss for loss in losses if loss is not None)
    assert found["before"] == found["trials"][0]
    assert said.rstrip().endswith(f"use: {found['overrides']}")
    assert f"took {found['dem_seconds']:.0f} s" in said
    kept = json.loads((tmp_path / "results" / "drum_small_coarse1.26.json").read_text("utf-8"))
    assert kept["trials"] == found["trials"]
    # Again, from the cases alone.
    stamps = {path: path.stat().st_mtime_ns for path in (tmp_path / "data").rglob("*.h5")}
    assert calibrate(config(tmp_path))["trials"] == found["trials"]
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "data").rglob("*.h5")} == stamps
    # What it says can be typed.
    typed = config(tmp_path, *found["overrides"].split()).scene
    assert typed.coarse_friction == found["found"]["friction"]
    assert typed.coarse_rolling_friction == found["found"]["rolling_friction"]


def test_a_dry_run_says_what_the_search_takes_and_makes_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(calibration, "summary_pace", lambda scene: 1.0)
    assert calibrate(config(tmp_path, "dry_run=true")) == {}
    said = capsys.readouterr().out
    assert "coarse-grained: 20 spheres of 63 mm for 40 of 50 mm" in said
    assert "search: at most 3 pairs of coefficients, each at 2 speeds" in said
    # 21 frames of two replicas and of three trials at two speeds, a second each.
    assert "judging 3.5 min" in said
    assert not any(tmp_path.iterdir())
