"""The table of a finished run: every failure has a row in it, and the count of failures is the number of such rows."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from beds import flowing
from finished_runs import REPLICAS, SCENE, broken, summary_of

from gran_bench.metrics import Judgement, judge
from gran_bench.run.summary import description, flat_metrics, headline, read_summary, summary_table, write_summary


def failed_rows(summary: dict[str, Any]) -> int:
    return sum(
        "  fail" in line and not line.strip().startswith("failures") for line in summary_table(summary).split("\n")
    )


def test_a_good_run_meets_what_it_can_and_says_that_nothing_got_lost():
    summary = summary_of(flowing(SCENE, seed=3))
    text = summary_table(summary)
    assert "failures: 0 of 31 states not finite, 0 missing" in text
    assert headline(summary)["requirements failed"] == failed_rows(summary)


def test_spheres_outside_are_in_the_table_of_each_packing():
    escaping = flowing(SCENE, seed=3)
    escaping.position[5:, 0] *= 0.51 / np.linalg.norm(escaping.position[5:, 0, ::2], axis=1)[:, None]
    lines = summary_table(summary_of(flowing(SCENE, seed=3), escaping)).split("\n")
    counts = [line for line in lines if "reach into a wall" in line]
    assert len(counts) == 2
    assert "0 by > r" in counts[0]
    assert "26 by > r (1 sphere)" in counts[1]
    assert "deepest" in counts[1]


def test_a_rollout_that_broke_down_has_a_row_and_counts():
    run = broken(7)
    whole, failed = summary_of(run), summary_of(run, failed_frames=(None, 7))
    line = next(line for line in summary_table(failed).split("\n") if "rollout 30rpm_unseen" in line)
    assert "failed at frame 7" in line
    assert headline(failed)["requirements failed"] == headline(whole)["requirements failed"] + 1
    assert "24 of 31 states not finite (from 1.57 s)" in summary_table(failed)


@pytest.mark.parametrize("own", [True, False])
def test_the_count_of_failures_is_that_of_the_failed_rows(own: bool):
    summary = summary_of(broken(3), flowing(SCENE, seed=3), failed_frames=(3, None), own=own)
    assert headline(summary)["requirements failed"] == failed_rows(summary) > 0
    text = summary_table(summary)
    passed = sum(bool(re.match(r"  \S.* {2}pass\b", line)) for line in text.split("\n"))
    failed = failed_rows(summary)
    (last,) = re.findall(r"^(\d+) of (\d+) requirements NOT met \(met: (.*?)\)", text, re.MULTILINE)
    assert last[:2] == (str(failed), str(failed + passed))
    parts = re.findall(r"([a-z ]+) (\d+) of (\d+)", last[2])
    assert [name.strip() for name, *_ in parts] == [
        "shared packing", "unseen packing", "tells speeds apart", "rollouts"
    ]  # fmt: skip
    assert [sum(int(part[k]) for part in parts) for k in (1, 2)] == [passed, failed + passed]


def test_a_speed_that_is_not_told_apart_fails():
    run = flowing(SCENE, seed=3)
    assert (
        headline(summary_of(run, own=False))["requirements failed"]
        == headline(summary_of(run))["requirements failed"] + 1
    )


def test_a_floor_that_is_all_but_zero_gives_no_figure_of_many_digits():
    summary = summary_of(flowing(SCENE, seed=3))
    summary["judged"]["shared"]["errors"]["speed_w1"]["multiple_of_floor"] = 3.2e14
    assert "(× > 1000)" in summary_table(summary)


def test_what_is_undefined_is_absent_from_the_metrics_and_the_rest_is_a_number():
    metrics = flat_metrics(summary_of(broken(3)))
    assert "shared/error/speed_w1" not in metrics
    assert metrics["shared/failures/non_finite_states"] == 28
    assert all(isinstance(value, float) for value in metrics.values())


def test_where_the_energy_of_the_dem_goes_is_among_the_metrics():
    summary = summary_of(broken(3))
    name = next(iter(summary["rollouts"]))
    summary["rollouts"][name]["dem_energy"] = {"power_W": 2096.0, "unaccounted_W": -0.6}
    metrics = flat_metrics(summary)
    assert metrics[f"dem_energy/{name}/power_W"] == 2096.0
    assert metrics[f"dem_energy/{name}/unaccounted_W"] == -0.6


def test_a_summary_is_read_as_it_was_written_and_only_where_it_is(tmp_path: Path):
    summary = summary_of(flowing(SCENE, seed=3))
    assert read_summary(tmp_path) is None
    write_summary(tmp_path, summary)
    assert read_summary(tmp_path) == summary


def test_the_judgement_itself_shows_the_same_failures():
    judgement: Judgement = judge(broken(3), REPLICAS, SCENE)
    for line in judgement.failures.lines(judgement.dem_outside):
        assert line in str(judgement)


@pytest.mark.parametrize("shown", [summary_table, lambda summary: description(summary, Path("runs/x"), [], None)])
def test_a_training_that_the_clock_has_cut_says_so(shown: Callable[[dict[str, Any]], str]):
    summary = summary_of(flowing(SCENE, seed=3))
    plain = shown(summary)
    assert "cut" not in plain
    summary["training"] |= {"steps": 3398, "planned_steps": 4000, "learning_rate": 6.1e-5, "stopped_by": "time"}
    said = "he clock has cut the training: 3398 of 4000 updates in 1.0 minutes, the last at a learning rate of 6.1e-05"
    assert said in shown(summary)
    summary["training"] |= {"planned_steps": 3398}
    assert "cut" not in shown(summary)
    summary["training"] |= {"planned_steps": None}  # a budget of time
    assert "cut" not in shown(summary)


def test_one_failure_is_one_requirement_and_figures_that_no_requirement_is_about_are_told_apart():
    summary = summary_of(flowing(SCENE, seed=3))
    for row in summary["judged"]["shared"]["requirements"].values():
        row["verdict"] = "pass"
    for row in summary["judged"]["shared"]["figures"].values():
        row["inside_interval"] = True
    asked = len(summary["judged"]["shared"]["requirements"]) + 3
    met = f"shared packing {asked - 3} of {asked - 3}, tells speeds apart 1 of 1, rollouts 2 of 2"
    assert summary_table(summary).endswith(f"\nall {asked} requirements met (met: {met})")
    energy = summary["judged"]["shared"]["figures"]["rotational_energy_steady"]
    energy |= {"inside_interval": False, "value": 0.1, "dem_interval": [0.2, 0.3]}
    text = summary_table(summary)
    assert text.endswith(f"(met: {met}); 1 figure lies outside the DEM's interval")
    (row,) = [line for line in text.split("\n") if "rotational energy, steady" in line]
    assert row.endswith("0.1 J  0.2 J … 0.3 J")
    summary["judged"]["shared"]["requirements"]["all_finite"]["verdict"] = "fail"
    assert f"\n1 of {asked} requirements NOT met (met: shared packing {asked - 4} of" in summary_table(summary)


def test_the_table_says_what_the_dem_has_outside_what_was_not_timed_and_that_one_speed_is_told_from_none():
    text = summary_table(summary_of(flowing(SCENE, seed=3)))
    assert "(of the DEM, whose walls are soft: " in text
    assert "not timed" in text
    assert "the only speed, so there is none to be told from" in text
