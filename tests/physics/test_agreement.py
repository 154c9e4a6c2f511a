"""Two samples of runs: Student's and Welch's intervals, and what a mean over few runs can tell."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from gran_bench.verification.agreement import (
    difference_of,
    mean_of,
    paired_difference_of,
    share_within,
    share_within_of,
)


def test_a_mean_of_few_has_students_interval():
    mean = mean_of([1.0, 2.0, 3.0, 4.0])
    assert mean.middle == 2.5
    assert mean.standard_error == pytest.approx(math.sqrt(5.0 / 3.0) / 2.0)
    assert mean.half_width == pytest.approx(3.18245 * mean.standard_error, rel=1e-5)  # t of three degrees of freedom


def test_a_difference_has_welchs_interval():
    first, second = [1.0, 2.0, 4.0, 4.5], [0.5, 0.6, 0.4]
    found = difference_of(first, second)
    welch = stats.ttest_ind(first, second, equal_var=False)
    low, high = welch.confidence_interval(0.95)
    assert (found.middle - found.half_width, found.middle + found.half_width) == pytest.approx((low, high))
    assert found.standard_errors_from_zero == pytest.approx(abs(welch.statistic))


def test_pairs_take_out_what_both_runs_of_a_start_share():
    start = np.array([0.0, 5.0, 10.0, 20.0])
    first, second = start + 1.0 + np.array([0.1, -0.1, 0.1, -0.1]), start
    assert paired_difference_of(first, second).half_width < 0.2 < difference_of(first, second).half_width
    with pytest.raises(ValueError, match="4 and 3 values are no pairs"):
        paired_difference_of(first, second[:3])


def test_samples_without_any_scatter_differ_by_infinitely_many_standard_errors():
    assert difference_of([1.0, 1.0], [2.0, 2.0]).standard_errors_from_zero == math.inf
    assert difference_of([1.0, 1.0], [1.0, 1.0]).standard_errors_from_zero == 0.0


@pytest.mark.parametrize("values", [[], [1.0], [[1.0, 2.0]]])
def test_a_single_value_has_no_interval(values):
    with pytest.raises(ValueError, match="give at least two"):
        mean_of(values)


def test_means_of_three_are_counted_over_all_choices():
    # Means of three of 0, 0, 0, 3: 0 once, 1 three times.
    assert share_within_of([0.0, 0.0, 0.0, 3.0], 0.0, 0.5) == 0.25
    assert share_within_of([0.0, 0.0, 0.0, 3.0], 0.0, 1.0) == 1.0
    assert share_within([0.0, 0.0, 0.0, 3.0], [1.0, 1.0, 1.0], 0.5) == 0.75
