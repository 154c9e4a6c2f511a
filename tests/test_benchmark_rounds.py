"""Rounds: methods take turns, runs that fail are kept, several runs are pooled, the DEM has an accuracy of its own."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest

from gran_bench import workers
from gran_bench.benchmark import command, turns
from gran_bench.benchmark.contest import Method
from gran_bench.benchmark.errors import noise_bound, pooled_judgement


@pytest.fixture
def worker_that(monkeypatch):
    """Makes workers whose process does what a line of Python says once it is asked."""
    made = []

    def make(does: str) -> workers.Worker:
        def start(module: str, environment: dict, **pipes) -> subprocess.Popen:
            code = f"import sys, time; sys.stdin.readline(); {does}"
            return subprocess.Popen([sys.executable, "-S", "-c", code], start_new_session=True, **pipes)

        monkeypatch.setattr(workers, "start_module", start)
        made.append(workers.Worker("none"))
        return made[-1]

    yield make
    for worker in made:
        worker.end()


@pytest.mark.parametrize(
    ("does", "words"),
    [
        ("time.sleep(60)", "no end within 2 s"),
        ("print('{\"wall_sec', end='')", "ended with status 0"),
        ("print('{\"wall_sec', end='', flush=True); sys.exit('out of memory')", "out of memory"),
        ("print('{\"wall_sec')", "no line of JSON"),
        ("sys.stdout.flush(); import os; os.kill(os.getpid(), 9)", "signal 9"),
    ],
)
def test_a_method_that_never_returns_or_gives_a_part_of_an_answer_is_a_failed_run(worker_that, does, words):
    assert words in worker_that(does).ask({"round": 0}, patience=2.0)["died"]


def test_an_answer_in_time_is_taken(worker_that):
    assert worker_that("print('{\"ready\": true}')").ask({"job": {}}, patience=60.0) == {"ready": True}


class Echo:
    """A run that gives no frames and notes the nudges that it was started from."""

    def __init__(self) -> None:
        self.nudges: list[int] = []

    def __call__(self, module: str) -> Echo:
        return self

    def end(self) -> None:
        pass

    def ask(self, request: dict, patience: float) -> dict:
        self.nudges += [request["nudge_seed"]] if "keep" in request else []
        turn = {"wall_seconds": 1.0, "cpu_seconds": 1.0, "peak_bytes": 1, "own_bytes": 1}
        return turn if "keep" in request else {"ready": True}


def test_two_seeds_give_rounds_that_start_from_nudges_of_their_own(tmp_path, monkeypatch):
    nudges = {}
    for seed in (0, 1):
        monkeypatch.setattr(turns, "Worker", echo := Echo())
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
