"""Claims: who is on the frontier, who is the rival, what pays, and what a spread promises."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from gran_bench.benchmark.claims import (
    Entry,
    best_in_time,
    crossing,
    equal_accuracy,
    fastest_rival,
    not_told_apart,
    paid_back,
    speed_up,
)
from gran_bench.benchmark.results import spread
from gran_bench.plots.time_error import frontier


def entry(name: str, seconds: float, floors: float | None, kind: str = "dem", **spent: float) -> Entry:
    return Entry(name, kind, seconds, floors, fast=0.9 * seconds, slow=1.1 * seconds, **spent)


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


def paid_beside(one: Entry, seconds: float) -> float | None:
    return paid_back(equal_accuracy(one, [one, entry("DEM", seconds, 1.0)], accepted=1.3))


def test_break_even_divides_what_was_spent_by_what_is_saved():
    surrogate = entry("surrogate", 0.6, 1.8, "surrogate", data_seconds=40.0, training_seconds=860.0)
    assert paid_beside(surrogate, 0.9) == pytest.approx(900.0 / 0.3)
    assert paid_beside(surrogate, 0.4) == math.inf
    assert paid_beside(entry("free", 0.1, 9.0, "baseline"), 0.5) == 0.0


def test_where_the_times_overlap_nobody_knows_whether_anything_is_paid_back():
    surrogate = entry("surrogate", 0.6, 1.8, "surrogate", training_seconds=860.0)
    for seconds in (0.59, 0.6, 0.61):
        assert math.isnan(paid_beside(surrogate, seconds))


def uncertain(one: Entry, low: float, high: float) -> Entry:
    return replace(one, low=low, high=high)


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


def test_a_spread_has_the_median_the_range_and_what_to_expect_of_another_benchmark():
    found = spread([1.0, 1.2, 0.9, 1.1, 1.0])
    assert (found["median"], found["low"], found["high"]) == pytest.approx((1.0, 0.9, 1.2))
    assert found["expected_low"] < 0.95
    assert found["expected_high"] == pytest.approx(1.0 / found["expected_low"])
    single = spread([2.0])
    assert (single["median"], single["expected_low"]) == (2.0, None)
    assert spread([]) is None


def test_the_median_of_another_benchmark_lies_where_it_is_expected():
    rng = np.random.default_rng(0)
    hits = []
    for _ in range(2000):
        found, other = (spread(list(np.exp(rng.normal(0.0, 0.1, 5)))) for _ in range(2))
        hits.append(found["expected_low"] <= other["median"] <= found["expected_high"])
    assert 0.93 < np.mean(hits) < 0.98
