"""Figures that can be undefined, series with invalid states, and the noise floor."""

from __future__ import annotations

import json

import numpy as np
import pytest

from gran_bench.metrics.measured import Measured, Series, frame_at, mean_of, noise_floor, prediction_interval, score
from gran_bench.plots.evaluation import draw_run
from gran_bench.plots.style import drawing

TIME = 1.5 + 0.01 * np.arange(401)


def series(value, **keys):
    return Series(TIME[: len(value)], np.asarray(value, float), "deg", **keys)


def test_an_undefined_figure_has_a_reason_and_never_a_number():
    figure = Measured.undefined("deg", "no surface")
    assert not figure.defined
    with pytest.raises(ValueError, match="no surface"):
        _ = figure.number
    assert json.dumps(figure.value) == "null"
    with pytest.raises(ValueError, match="reason"):
        Measured(None, "deg")
    with pytest.raises(ValueError, match="not a figure"):
        Measured(float("nan"), "deg")


def test_a_mean_over_figures_is_undefined_where_one_is():
    good, bad = Measured(1.0, "m"), Measured.undefined("m", "diverged")
    assert mean_of([good, Measured(3.0, "m")], "m").number == 2.0
    assert mean_of([good, bad], "m").note == "diverged"


def test_a_series_is_averaged_over_the_states_valid_in_both():
    a, b = np.zeros(401), np.full(401, 2.0)
    a[:20], b[10:30] = np.nan, np.nan
    difference = series(a).difference(series(b))
    assert difference.number == 2.0
    assert "20 of 401 states invalid, and 10 more of the other run" in difference.note


@pytest.mark.parametrize(("invalid", "defined"), [(40, True), (41, False)])
def test_below_ninety_per_cent_valid_a_series_is_undefined(invalid, defined):
    value = np.zeros(401)
    value[:invalid] = np.nan
    assert series(value).difference(series(np.ones(401))).defined is defined
    assert series(value).mean().defined is defined


def test_a_series_that_ends_early_counts_its_missing_states_as_invalid():
    full = series(np.zeros(401))
    assert "0 of 401 states invalid, and 21 more of the other run" in full.difference(series(np.ones(380))).note
    assert not series(np.ones(200)).difference(full).defined


def test_series_of_different_clocks_are_refused():
    shifted = Series(TIME + 0.005, np.zeros(401), "deg")
    with pytest.raises(ValueError, match="different times"):
        series(np.zeros(401)).difference(shifted)


def test_the_peak_is_the_largest_value_of_its_window_and_when():
    value = np.zeros(401)
    value[40], value[300] = 60.0, 99.0
    peak, when = series(value).largest(end=3.0)
    assert (peak.number, when.number) == (60.0, pytest.approx(1.9))


def test_a_series_that_is_undefined_gives_nothing_at_all():
    angle = series(np.ones(401), undefined_because="above the critical speed")
    assert not angle.valid.any()
    for figure in (angle.mean(), *angle.largest(), angle.difference(angle)):
        assert figure.note == "above the critical speed"


def test_a_state_is_found_within_half_a_frame():
    assert frame_at(TIME, 2.5) == 100
    assert frame_at(TIME, 2.504) == 100
    assert frame_at(TIME, 6.0) is None


def test_score_is_the_mean_to_the_replicas_and_floor_the_mean_of_their_pairs():
    def distance(a, b):
        return Measured(abs(a - b), "m")

    assert score(distance, 10.0, [0.0, 2.0, 4.0], "m").number == 8.0
    assert noise_floor(distance, [0.0, 2.0, 4.0], "m").number == pytest.approx((2 + 4 + 2) / 3)
    assert not noise_floor(distance, [1.0], "m").defined


def test_the_interval_of_five_replicas_reaches_2_78_s_root_1_2():
    figures = [34.0, 34.5, 35.0, 35.5, 36.0]
    interval = prediction_interval(figures)
    reach = 2.776445 * np.std(figures, ddof=1) * np.sqrt(1.2)
    assert interval.mean == pytest.approx(35.0)
    assert (interval.low, interval.high) == (pytest.approx(35.0 - reach), pytest.approx(35.0 + reach))
    assert 35.9 in interval
    assert 40.0 not in interval
    assert prediction_interval([1.0]) is None


def test_a_table_and_a_figure_count_the_invalid_states_of_a_run_alike(tmp_path):
    mine, theirs = np.zeros(401), [np.zeros(401) for _ in range(3)]
    mine[:6], theirs[1][6:8] = np.nan, np.nan
    distance = score(lambda a, b: a.difference(b), series(mine), [series(value) for value in theirs], "deg")
    assert "6 of 401 states invalid" in distance.note
    assert "6 of 401 states invalid" in series(mine).mean().note
    with drawing(tmp_path / "a.png", 3.0, 2.0) as figure:
        axes = figure.subplots()
        draw_run(axes, series(mine), "model", "black")
        assert axes.lines[0].get_label() == "model (6 of 401 states invalid)"


def test_a_note_that_not_all_runs_have_says_so():
    noted, plain = Measured(1.0, "deg", "2 of 9 states invalid: wild"), Measured(1.0, "deg")
    assert mean_of([noted, noted], "deg").note == noted.note
    assert mean_of([plain, noted], "deg").note == f"{noted.note} (this or the like in 1 of 2 runs)"
