"""Comparing methods: who is on the frontier, who is the rival, what pays, what a spread promises, what a page says."""

from __future__ import annotations

import copy
import json
import math
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gran_bench.comparison import command, turns
from gran_bench.comparison.claims import (
    Entry,
    best_in_time,
    break_even,
    crossing,
    equal_accuracy,
    fastest_rival,
    frontier,
    not_told_apart,
    paid_back,
    speed_up,
)
from gran_bench.comparison.command import model_files
from gran_bench.comparison.contest import Contest, largest_allowed_step
from gran_bench.comparison.crew import ask
from gran_bench.comparison.errors import noise_bound
from gran_bench.comparison.method import Method
from gran_bench.comparison.page import PAGE, page_text, table_of
from gran_bench.comparison.pooling import pooled_judgement
from gran_bench.comparison.results import (
    FORMAT,
    RESULTS,
    ResultsError,
    entries,
    judged_anew,
    read_all,
    read_results,
    share_waited,
    untimed,
)
from gran_bench.comparison.sentences import verdicts, winner
from gran_bench.comparison.spread import spread
from gran_bench.comparison.suitability import why_unfit
from gran_bench.config import BenchmarkConfig
from gran_bench.config_rules import ConfigError
from gran_bench.dem.simulate import TimeStepError, choose_time_step
from gran_bench.entry import checked_config, compose
from gran_bench.shipped import shipped_model, shipped_scene
from gran_bench.surrogate.checkpoint import load_card

COMMITTED = Path(__file__).parents[1] / "results" / "benchmark"


def entry(name: str, seconds: float, floors: float | None, kind: str = "dem", **spent: float) -> Entry:
    return Entry(name, kind, seconds, 0.9 * seconds, 1.1 * seconds, floors, **spent)


def benchmark_config(*overrides: str) -> BenchmarkConfig:
    return checked_config(compose("benchmark", overrides), BenchmarkConfig)


# ---- claims ----------------------------------------------------------------------------------------------


def test_the_frontier_holds_those_that_nothing_beats():
    fast, exact, beaten = entry("fast", 1.0, 9.0), entry("exact", 5.0, 1.0), entry("beaten", 6.0, 1.0)
    twin, slower_twin = entry("twin", 1.0, 9.0), entry("slower twin", 1.5, 9.0)
    failed = entry("failed", 0.1, None)
    assert frontier([exact, beaten, failed, fast, slower_twin, twin]) == [fast, twin, exact]
    assert frontier([failed]) == []


def test_the_frontier_is_what_its_definition_says_of_any_cloud():
    rng = np.random.default_rng(3)
    cloud = [entry(str(k), *map(float, rng.integers(1, 12, 2))) for k in range(60)]
    front = set(frontier(cloud))
    for one in cloud:
        dominated = any(
            (other.seconds, other.floors) != (one.seconds, one.floors)
            and other.seconds <= one.seconds
            and other.floors <= one.floors
            for other in cloud
        )
        assert (one in front) != dominated


def test_the_rival_is_the_fastest_dem_that_is_as_exact_and_noise_counts_as_exact():
    soft, coarse, fine = entry("soft", 0.2, 1.2), entry("coarse", 0.1, 5.0), entry("fine", 1.0, 0.9)
    everyone = [soft, coarse, fine, entry("surrogate", 0.01, 0.5, "surrogate"), entry("failed", 0.01, None)]
    assert fastest_rival(everyone, 1.0, accepted=1.3) == soft
    assert fastest_rival(everyone, 1.0, accepted=1.0) == fine
    assert fastest_rival(everyone, 6.0, accepted=1.3) == coarse
    assert fastest_rival(everyone, 0.5, accepted=0.6) is None
    assert best_in_time(everyone, 0.3) == soft
    assert best_in_time(everyone, 0.05) is None


def test_break_even_divides_what_was_spent_by_what_is_saved():
    surrogate = entry("surrogate", 0.6, 1.8, "surrogate", data_seconds=40.0, training_seconds=860.0)
    assert break_even(surrogate, entry("DEM", 0.9, 1.0)) == pytest.approx(900.0 / 0.3)
    assert break_even(surrogate, entry("DEM", 0.4, 1.0)) == math.inf
    assert break_even(entry("free", 0.1, 9.0), entry("DEM", 0.5, 1.0)) == 0.0


def test_where_the_times_overlap_nobody_knows_whether_anything_is_paid_back():
    surrogate = entry("surrogate", 0.6, 1.8, "surrogate", training_seconds=860.0)
    for seconds in (0.59, 0.6, 0.61):
        assert math.isnan(break_even(surrogate, entry("DEM", seconds, 1.0)))


def uncertain(one: Entry, low: float, high: float) -> Entry:
    return replace(one, floors_low=low, floors_high=high)


def test_a_dem_is_as_exact_unless_the_intervals_of_the_errors_say_that_it_is_worse():
    net = uncertain(entry("net", 0.5, 1.8, "surrogate", training_seconds=100.0), 1.5, 2.1)
    fine, coarse = entry("fine", 2.0, 1.0), uncertain(entry("coarse", 0.1, 1.9), 1.6, 2.2)
    beside = equal_accuracy(net, [net, fine, coarse], accepted=1.3)
    assert (beside.rival, beside.lenient, beside.faster) == (fine, coarse, "undecided")
    assert math.isnan(paid_back(beside))
    worse = uncertain(entry("worse", 0.1, 2.4), 2.2, 2.6)
    beside = equal_accuracy(net, [net, fine, worse], accepted=1.3)
    assert (beside.lenient, beside.faster) == (fine, "entry")
    assert paid_back(beside) == pytest.approx(100.0 / 1.5)
    assert equal_accuracy(net, [net, fine, worse], accepted=2.3).faster == "undecided"
    assert equal_accuracy(net, [net, worse], accepted=1.3).faster == "alone"
    assert equal_accuracy(net, [net, coarse], accepted=1.3).faster == "undecided"
    assert equal_accuracy(net, [net, replace(coarse, floors=1.7)], accepted=1.3).faster == "rival"
    assert equal_accuracy(net, [net, entry("near", 0.52, 1.0)], accepted=1.3).faster == "neither"


def test_methods_whose_times_overlap_the_first_are_not_told_apart_from_it():
    first, near, far = entry("first", 1.0, 1.0), entry("near", 1.1, 1.0), entry("far", 1.3, 1.0)
    assert not_told_apart(first, [far, near, first]) == [first, near]


def test_a_speed_up_decides_where_its_range_leaves_one():
    assert not speed_up(entry("a", 1.0, 1.0), entry("b", 1.1, 1.0)).decides
    ratio = speed_up(entry("a", 1.0, 1.0), entry("b", 3.0, 1.0))
    assert (ratio.middle, ratio.low, ratio.high) == pytest.approx((3.0, 2.7 / 1.1, 3.3 / 0.9))
    assert ratio.decides


def test_a_cost_crosses_a_level_on_a_straight_line_in_logarithms():
    moduli = [1e7, 1e9, 1e11]
    costs = [0.1 * (modulus / 1e7) ** 0.4 for modulus in moduli]
    assert crossing(moduli, costs, 1.0) == pytest.approx(1e7 * 10 ** (1 / 0.4))
    assert crossing(moduli, costs, 0.05) == 1e7
    assert crossing(moduli, costs, 100.0) is None


# ---- spread ----------------------------------------------------------------------------------------------


def test_a_spread_has_the_median_the_range_and_what_to_expect_of_another_benchmark():
    found = spread([1.0, 1.2, 0.9, 1.1, 1.0])
    assert (found.median, found.low, found.high) == pytest.approx((1.0, 0.9, 1.2))
    assert found.expected_low < 0.95
    assert found.expected_high == pytest.approx(1.0 / found.expected_low)
    single = spread([2.0])
    assert (single.median, single.expected_low) == (2.0, None)
    with pytest.raises(ValueError, match="two or more"):
        single.overlaps(found)
    for wrong in ([], [0.0, 1.0]):
        with pytest.raises(ValueError, match="positive"):
            spread(wrong)


def test_the_median_of_another_benchmark_lies_where_it_is_expected():
    rng = np.random.default_rng(0)
    hits = []
    for _ in range(2000):
        found, other = (spread(list(np.exp(rng.normal(0.0, 0.1, 5)))) for _ in range(2))
        hits.append(found.expected_low <= other.median <= found.expected_high)
    assert 0.93 < np.mean(hits) < 0.98


# ---- turns -----------------------------------------------------------------------------------------------


@pytest.fixture
def worker_that():
    """Starts processes that do what a line of Python says once they are asked."""
    started = []

    def start(does: str) -> subprocess.Popen:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        complaints = tempfile.TemporaryFile()  # noqa: SIM115 (lives as long as its worker)
        code = f"import sys, time; sys.stdin.readline(); {does}"
        started.append(subprocess.Popen([sys.executable, "-S", "-c", code], stderr=complaints, **pipes))
        started[-1].complaints = complaints
        return started[-1]

    yield start
    for worker in started:
        worker.kill()
        worker.communicate()
        worker.complaints.close()


def test_a_method_that_never_returns_is_a_failed_run_and_its_process_is_ended(worker_that):
    worker = worker_that("time.sleep(60)")
    assert ask(worker, {"round": 0}, patience=0.2) == {"died": "no end within 0.2 s"}
    assert worker.wait(10) < 0


@pytest.mark.parametrize(
    ("does", "words"),
    [
        ("print('{\"wall_sec', end='')", "ended with status 0"),
        ("print('{\"wall_sec', end='', flush=True); sys.exit('out of memory')", "out of memory"),
        ("print('{\"wall_sec')", "no line of JSON"),
        ("sys.stdout.flush(); import os; os.kill(os.getpid(), 9)", "signal 9"),
    ],
)
def test_a_part_of_an_answer_is_a_failed_run(worker_that, does, words):
    assert words in ask(worker_that(does), {"round": 0})["died"]


def test_an_answer_in_time_is_taken(worker_that):
    assert ask(worker_that("print('{\"ready\": true}')"), {"job": {}}) == {"ready": True}


class Echo:
    """A run that gives no frames and notes the nudges that it was started from."""

    def __init__(self) -> None:
        self.nudges: list[int] = []

    def __call__(self, worker: object, request: dict) -> dict:
        self.nudges += [request["nudge_seed"]] if "keep" in request else []
        turn = {"wall_seconds": 1.0, "cpu_seconds": 1.0, "peak_bytes": 1, "own_bytes": 1}
        return turn if "keep" in request else {"ready": True}


def test_two_seeds_give_rounds_that_start_from_nudges_of_their_own(tmp_path, monkeypatch):
    nudges = {}
    for seed in (0, 1):
        monkeypatch.setattr(turns, "ask", echo := Echo())
        method = Method("net", "surrogate", {}, 1.0)
        turns.take_turns([method], 3, seed, tmp_path, [f"seed {seed}"], frame_interval=0.1)
        nudges[seed] = echo.nudges
    assert nudges[0] == [1001, 1002, 1003]
    assert not set(nudges[0]) & set(nudges[1])


def test_rounds_are_kept_for_the_code_the_libraries_and_the_seed_that_they_were_measured_with(monkeypatch):
    before = command.measured_under(seed=0)
    assert command.measured_under(seed=0) == before
    assert command.measured_under(seed=1) != before
    for name in ("comparing_code", "library_versions", "hardware"):
        with monkeypatch.context() as changed:
            changed.setattr(command, name, lambda: "other")
            assert command.measured_under(seed=0) != before


# ---- the DEM's own accuracy ------------------------------------------------------------------------------


def test_noise_is_the_bound_of_a_mean_over_runs_and_needs_three_replicas():
    own = [0.8, 1.0, 1.2]
    # t of Student with 2 degrees of freedom, 95 % two-sided: 4.303; s = 0.2.
    assert noise_bound(own, 1) == pytest.approx(1.0 + 4.303 * 0.2 * math.sqrt(1 / 3 + 1), rel=1e-3)
    assert noise_bound(own, 5) == pytest.approx(1.0 + 4.303 * 0.2 * math.sqrt(1 / 3 + 1 / 5), rel=1e-3)
    assert noise_bound([1.0, 1.0], 5) is None


def test_the_mean_of_further_runs_of_the_dem_is_within_the_noise():
    def distance(one: np.ndarray, others: np.ndarray) -> np.ndarray:
        return np.linalg.norm(one - others, axis=-1)

    rng, within = np.random.default_rng(0), []
    for _ in range(1000):
        replicas, runs = rng.standard_normal((2, 5, 8))
        own = [distance(replicas[k], np.delete(replicas, k, axis=0)).mean() for k in range(5)]
        error = np.mean([distance(run, replicas).mean() for run in runs])
        within.append(error <= noise_bound(own, 5))
    assert 0.9 < np.mean(within) <= 1.0


class Replicas:
    """What a kept result is told anew with: floors, errors of the replicas, and the noise."""

    ranked = ()
    own = {"speed_w1": [0.9, 1.0, 1.1]}  # noqa: RUF012

    def __init__(self, floor: float = 0.02) -> None:
        self._floor = floor

    def floors(self) -> dict[str, float]:
        return {"speed_w1": self._floor}

    def noise(self, runs: int) -> float:
        return 1.0 + 1.0 / runs


def test_kept_results_are_told_anew_without_measuring(found):
    errors = {"speed_w1": {"floor": 0.02, "value": 0.02, "unit": "m/s", "multiple_of_floor": 1.0}}
    found["methods"][0]["judgement"] = {"velocity_kind": "instantaneous", "errors": errors}
    anew = judged_anew(found, Replicas(), 3, 5)
    assert anew["reference"]["accepted"] == anew["reference"]["noise"] == 1.2
    assert anew["methods"] == found["methods"]
    assert "older rule" in page_text({"quick/drum": found})
    assert "older rule" not in page_text({"quick/drum": anew})
    with pytest.raises(ResultsError, match="other replicas"):
        judged_anew(found, Replicas(floor=0.03), 3, 5)


def test_results_that_were_never_measured_cannot_be_told_anew(tmp_path):
    with pytest.raises(ResultsError, match="measure=true"):
        read_results(tmp_path / RESULTS)


def test_too_few_replicas_leave_the_winner_unknown(found):
    found["reference"] |= {"replicas": 2, "noise": None, "accepted": None, "judged_runs": 5}
    text = page_text({"quick/drum": found})
    assert "Noise: undefined, 2 replicas do not give the DEM's own accuracy; three or more do" in text
    assert "Who wins is not known" in text
    assert "At equal accuracy the rival is DEM 0.2 ms" in text


# ---- several rounds --------------------------------------------------------------------------------------


def judgement(angle: float | None, outside: int, states: int = 401, first: float | None = None) -> dict:
    """What a judge says of one round."""
    error = {"value": angle, "multiple_of_floor": angle, "note": "" if angle else "no straight surface"}
    passes = angle is not None and angle <= 3.0
    return {
        "velocity_kind": "instantaneous",
        "replicas": 5,
        "accepted": passes,
        "errors": {"surface_angle": error},
        "figures": {"energy": {"value": angle, "inside_interval": passes}},
        "requirements": {"steady": {"value": angle, "bound": 3.0, "verdict": "pass" if passes else "fail"}},
        "failures": {"states": states, "outside_spheres": outside, "first_non_finite": first},
    }


def test_rounds_are_pooled_as_means_and_what_fails_in_any_of_them_stays():
    found = pooled_judgement([judgement(1.0, 0), judgement(5.0, 7, states=30, first=0.3), judgement(3.0, 2)])
    assert found["errors"]["surface_angle"]["multiple_of_floor"] == pytest.approx(3.0)
    assert found["requirements"]["steady"]["verdict"] == "fail"
    assert not found["accepted"]
    assert found["failures"] == {"states": 30, "outside_spheres": 7, "first_non_finite": 0.3}
    energy = found["figures"]["energy"]
    assert (energy["value"], energy["inside_interval"], energy["rounds_inside"]) == (pytest.approx(3.0), False, 2)
    assert (found["rounds"], found["pooled"]["failures"]) == (3, "worst round, each count")


def test_a_figure_that_one_round_lacks_is_undefined_in_all():
    found = pooled_judgement([judgement(1.0, 0), judgement(None, 0)])
    assert found["errors"]["surface_angle"]["note"] == "no straight surface"
    for table in ("errors", "figures", "requirements"):
        assert [row["value"] for row in found[table].values()] == [None]


# ---- who is compared -------------------------------------------------------------------------------------


def test_the_largest_allowed_step_is_allowed_and_the_next_is_not():
    scene = shipped_scene("drum").at_speed(30.0)
    step = largest_allowed_step(scene)
    assert choose_time_step(scene, step)[0] == step
    with pytest.raises(TimeStepError):
        choose_time_step(scene, scene.frame_interval / (round(scene.frame_interval / step) - 1))


@pytest.mark.parametrize(
    ("scene", "reason"),
    [
        (shipped_scene("drum").at_speed(30.0), ""),
        (shipped_scene("drum_long").at_speed(30.0), ""),
        (shipped_scene("drum_ramp"), ""),
        (shipped_scene("packing"), ""),
        (shipped_scene("drum").at_speed(35.0), "it was trained at 35 rpm"),
        (shipped_scene("drum_mu05").at_speed(30.0), "another material"),
        (shipped_scene("packing_polydisperse"), "spheres of one size"),
        (shipped_scene("hopper"), "planes and cylinders alone"),
    ],
    ids=lambda value: getattr(value, "name", value),
)
def test_a_surrogate_answers_for_scenes_of_its_own_material_that_it_never_saw(scene, reason):
    card, _ = load_card(shipped_model())
    found = why_unfit(card, scene, packing_seed=1)
    assert reason in found
    assert bool(found) == bool(reason)


def test_a_surrogate_does_not_start_from_the_packing_that_it_was_trained_on():
    card, _ = load_card(shipped_model())
    assert "packing 0" in why_unfit(card, shipped_scene("drum").at_speed(30.0), packing_seed=0)


def test_every_kind_of_method_is_compared_under_a_name_of_its_own():
    contest = Contest(benchmark_config(), model_files(["shipped"]))
    names = [method.name for method in contest.methods]
    assert len(names) == len(set(names))
    assert contest.automatic == "DEM 0.2 ms"
    assert {
        *("DEM 0.2 ms", "DEM 0.4 ms", "DEM 1 ms", "DEM 0.4 ms, float32", "DEM 1.25 ms, E = 1e6 Pa"),
        *("DEM 0.2 ms, numpy engine", "holdout30rpm (shipped)", "interpolation, 25 and 35 rpm"),
        *("rigid rotation", "ballistic"),
    } <= set(names)
    assert {method.job["bed"] for method in contest.methods if "bed" in method.job} == {
        str(contest.case.settled_path("data"))
    }
    assert [modulus for modulus, _ in contest.stiffness_methods["largest"]] == [1e7, 1e8, 1e9, 7e10]
    assert [count for count, _ in contest.count_methods["holdout30rpm (shipped)"]] == [300, 1000, 3000, 6000]


def test_a_scene_with_a_motion_of_its_own_has_no_interpolation_and_no_studies():
    contest = Contest(benchmark_config("scene=packing"), model_files(["shipped"]))
    assert next(m for m in contest.methods if m.name == "interpolation").unfit_because
    assert (contest.stiffness_methods, contest.count_methods) == ({}, {})


def test_a_methods_key_follows_its_job_and_its_conditions_and_not_its_folders(tmp_path):
    here, there = (
        next(iter(Contest(benchmark_config(f"dataset.root={root}"), {}).methods)) for root in ("data", tmp_path)
    )
    assert here.key("code") == there.key("code")
    assert here.key("code") != here.key("other code")
    slower = Contest(benchmark_config("scene.material.friction=0.4"), {}).methods[0]
    assert slower.key("code") != here.key("code")
    assert replace(here, seconds=0.1).key("code") != here.key("code")


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("profile.step_multiples=[2]", ["profile.step_multiples=[2.0]", "add 1"]),
        ("profile.soft_moduli=[1e6,1e6]", ["profile.soft_moduli", "twice"]),
        ("profile.judged_rounds=9", ["profile.judged_rounds=9", "profile.rounds=4"]),
        ("profile.rounds=0", ["profile.rounds=0", "≥ 1"]),
        ("dataset.holdout_speeds_rpm=[]", ["dataset.holdout_speeds_rpm=[]", "one held-out speed"]),
        ("profile.rouns=3", ["profile.rouns", "profile.rounds"]),
    ],
)
def test_what_cannot_be_compared_is_refused(override, words):
    with pytest.raises(ConfigError) as refused:
        checked_config(compose("benchmark", [f"++{override}"]), BenchmarkConfig)
    assert all(word in str(refused.value) for word in words)
    assert "\n" not in str(refused.value)


def test_two_models_of_one_name_are_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"two files of the folder .*"):
        model_files([str(tmp_path / "model.pt"), str(tmp_path / "other.pt")])


# ---- the page --------------------------------------------------------------------------------------------


def row(name: str, kind: str, seconds: float, floors: float | None, failure: str = "", **more) -> dict:
    ranges = {"median": seconds, "low": 0.9 * seconds, "high": 1.1 * seconds}
    ranges |= {"expected_low": 0.8 * seconds, "expected_high": 1.2 * seconds}
    found = {"name": name, "kind": kind, "unfit_because": "", "failure": failure, "failed": bool(failure)}
    found |= {"simulated_seconds": 4.0, "wall": ranges, "relative": ranges, "cpu_seconds": 0.5 * seconds}
    found |= {"peak_bytes": 2**28, "own_bytes": 2**20, "data_seconds": 0.0, "training_seconds": 0.0}
    found |= {"floors": floors, "floors_low": floors, "floors_high": floors, "by": "speed_w1", "outside": 0}
    found |= {"failed_seconds": None}
    return found | {"judgement": None} | more


@pytest.fixture
def found() -> dict:
    return {
        "format": FORMAT,
        "scene": "drum",
        "profile": "quick",
        "spheres": 3000,
        "simulated_seconds": 4.0,
        "motion": "30rpm",
        "modulus": 1e7,
        "rounds": 5,
        "automatic": "DEM 0.2 ms",
        "reference": {
            "replicas": 5,
            "noise": 1.3,
            "accepted": 1.3,
            "ranked": [{"key": "speed_w1", "label": "speeds, W1 a frame", "unit": "m/s"}],
        },
        "methods": [
            row("DEM 0.2 ms", "dem", 0.9, 1.0),
            row("DEM 1 ms", "dem", 0.2, 4.0),
            row("DEM 5 ms", "dem", 0.05, None, "sphere 3 diverged", wall=None, relative=None, failed_seconds=0.05),
            row("net", "surrogate", 0.6, 1.8, data_seconds=40.0, training_seconds=860.0),
        ],
        "waited": 0.0,
        "stiffness": {},
        "counts": {},
        "provenance": {"command": "bench", "commit": "abc", "hardware": "two cores", "versions": "numpy 2"},
    }


def test_the_page_says_who_wins_and_marks_who_failed(found):
    text = page_text({"quick/drum": found})
    assert "the fastest is **DEM 0.2 ms**: 0.9 s" in text
    assert "✗ failed: sphere 3 diverged" in text
    (line,) = [line for line in text.splitlines() if line.startswith(("| **net**", "| net"))]
    assert line.endswith("| 40 | 860 | 3,000 |")
    assert "the surrogate is 1.5 times as fast (1.2 to 1.8)" in text
    assert "paid back after 3,000 simulated seconds" in text


def test_a_dem_that_is_as_exact_and_faster_wins_and_training_is_never_paid_back(found):
    found["methods"].append(row("DEM 1.25 ms, E = 1e6 Pa", "dem", 0.3, 1.2))
    assert "the fastest is **DEM 1.25 ms, E = 1e6 Pa**" in winner(found)
    (said,) = verdicts(found)
    assert "**the DEM is 2 times as fast** (1.6 to 2.4)" in said
    assert "never paid back" in said
    table = table_of(found).set_index("method")
    assert table.loc["net", "break_even_seconds"] == math.inf
    assert not table.loc["net", "on_frontier"]
    assert table.loc["DEM 5 ms", "failed"]


def test_intervals_that_allow_both_answers_leave_the_page_undecided(found):
    found["methods"].append(row("DEM 1.5 ms", "dem", 0.3, 1.9, floors_low=1.7, floors_high=2.1))
    next(one for one in found["methods"] if one["name"] == "net").update(floors_low=1.5, floors_high=2.1)
    (said,) = verdicts(found)
    assert "it is undecided who is faster: the surrogate is 1.5 times as fast (1.2 to 1.8) beside DEM 0.2 ms" in said
    assert "**the DEM is 2 times as fast** (1.6 to 2.4) beside DEM 1.5 ms" in said
    assert "are ever paid back is undecided" in said
    assert math.isnan(table_of(found).set_index("method").loc["net", "break_even_seconds"])
    assert "| 860 | undecided |" in page_text({"quick/drum": found})


def test_the_winner_is_everyone_whose_time_is_not_told_apart(found):
    found["methods"].append(row("DEM 0.25 ms", "dem", 0.85, 1.2))
    assert "**DEM 0.25 ms**: 0.85 s a simulated second, 1.20 floors and **DEM 0.2 ms**: 0.9 s" in winner(found)
    assert winner(found).endswith(", not told apart.")


def test_the_winner_names_who_is_faster_and_may_be_as_exact(found):
    found["methods"].append(row("DEM 0.5 ms", "dem", 0.4, 1.4, floors_low=1.2, floors_high=1.6))
    assert "Undecided and faster" in winner(found)
    assert "**DEM 0.5 ms** (0.4 s, 1.40 floors, 1.20 to 1.60)" in winner(found)


def test_interpolation_alone_is_said_to_have_no_spheres(found):
    found["methods"].append(row("interpolation, 25 and 35 rpm", "baseline", 1e-4, 1.1, data_seconds=40.0))
    said = winner(found)
    assert "after 40 s of data, and statistics without spheres. The fastest DEM there is **DEM 0.2 ms**" in said
    found["methods"][-1] |= {"name": "rigid rotation", "data_seconds": 0.0}
    assert "statistics" not in winner(found)
    assert "of data" not in winner(found)


def test_the_page_says_where_a_surrogate_starts_to_cost_less_and_what_softening_makes_of_it(found):
    def points(**costs):
        return [{"at": float(at[1:]), "wall": {"median": cost}, "failure": ""} for at, cost in costs.items()]

    found["stiffness"] = {
        "automatic": points(_1e7=0.3, _1e9=3.0),
        "largest": points(_1e7=0.1, _1e9=0.4),
        "net": points(_1e7=0.6),
    }
    found["counts"] = {"DEM": points(_300=0.1, _3000=1.0), "net": points(_300=0.2, _3000=0.5)}
    text = page_text({"quick/drum": found})
    assert "takes less time than the DEM at its largest allowed step at no stiffness that was timed" in text
    assert "takes less time than the DEM at its automatic step from E = 4.0e+07 Pa on" in text
    assert "errors were measured at E = 1.0e+07 Pa" in text
    assert "takes 0.9 s, more than **net**; whether it can stand in for stiffer spheres was not measured" in text
    assert "2 with 300 spheres, 0.5 with 3000 spheres" in text
    assert "✗" not in text.partition("Against stiffness")[2]


def test_points_of_a_study_that_failed_are_said_and_drawn(found, tmp_path, monkeypatch):
    def point(at: float, cost: float | None, failure: str = "") -> dict:
        return {"at": at, "wall": None if cost is None else {"median": cost}, "failure": failure}

    found["stiffness"] = {
        "automatic": [point(1e7, 0.3), point(1e9, None, "sphere 3 diverged")],
        "largest": [point(1e7, 0.1), point(1e9, 0.4, "sphere 4 diverged")],
        "net": [point(1e7, None, "not finite")],
    }
    found["counts"] = {"DEM": [point(300, 0.1)], "net": [point(300, None, "not finite")]}
    text = page_text({"quick/drum": found})
    assert "✗ The DEM at its automatic step failed at E = 1.0e+09 Pa: sphere 3 diverged." in text
    assert "✗ The DEM at its largest allowed step failed at E = 1.0e+09 Pa: sphere 4 diverged." in text
    assert "✗ **net** failed at E = 1.0e+07 Pa: not finite." in text
    assert "✗ **net** failed at 300 spheres: not finite." in text
    drawn = []
    monkeypatch.setattr(command, "cost_against", lambda lines, *_: drawn.extend(lines))
    command.draw(found, tmp_path)
    assert [list(line.failed_at) for line in drawn] == [[1e9], [1e9], [1e7], [], [300]]
    monkeypatch.undo()
    command.draw(found, tmp_path)


def test_a_run_that_failed_on_its_way_has_a_place_in_the_figure(found):
    (failed,) = [one for one in entries(found) if one.floors is None]
    assert (failed.name, failed.seconds) == ("DEM 5 ms", 0.05)


def test_a_run_that_failed_before_its_first_frame_is_named_in_the_figure(found, tmp_path, monkeypatch):
    seen = {}
    monkeypatch.setattr(command, "time_against_error", lambda *given: seen.update(timed=given[0], lost=given[-1]))
    nothing = {"wall": None, "relative": None}
    found["methods"].append(row("DEM 9 ms", "dem", 0.05, None, "sphere 3 diverged", **nothing))
    assert untimed(found) == ["DEM 9 ms"]
    command.draw(found, tmp_path)
    assert ([one.name for one in seen["timed"]], seen["lost"]) == (["0.2 ms", "1 ms", "5 ms", "net"], ["9 ms"])


def test_a_benchmark_of_failures_alone_is_drawn(found, tmp_path):
    nothing = {"wall": None, "relative": None}
    found["methods"] = [row("DEM 0.2 ms", "dem", 0.05, None, "sphere 3 diverged", **nothing)]
    command.draw(found, tmp_path)
    assert (tmp_path / "time_error.png").exists()
    assert "No method has the DEM's own accuracy" in page_text({"quick/drum": found})


def test_methods_that_waited_for_the_processor_say_that_the_machine_was_busy(found):
    assert share_waited(found["methods"]) == pytest.approx(0.5)
    found["waited"] = 0.5
    assert "Methods waited 50 % of their time for the processor" in page_text({"quick/drum": found})


def test_full_results_of_a_scene_stand_for_it(found, tmp_path):
    for place in ("quick/drum", "full/drum", "quick/packing"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / RESULTS).write_text(json.dumps(copy.deepcopy(found)))
    assert list(read_all(tmp_path)) == ["full/drum", "quick/packing"]
    (tmp_path / "quick/packing" / RESULTS).write_text(json.dumps(found | {"format": FORMAT - 1}))
    with pytest.raises(ResultsError, match="another version"):
        read_all(tmp_path)


@pytest.mark.skipif(not (COMMITTED / PAGE).exists(), reason="no benchmark is committed")
def test_the_committed_page_is_made_from_the_committed_results():
    assert page_text(read_all(COMMITTED)) == (COMMITTED / PAGE).read_text("utf-8"), (
        "results/benchmark/README.md is not what its results say; write it again with "
        "`python -m gran_bench.comparison.page results/benchmark`"
    )
