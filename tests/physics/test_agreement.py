"""Two samples of runs: Student's and Welch's intervals, and what a mean over few runs can tell."""

from __future__ import annotations

import math

import pytest
from scipy import stats

from gran_bench.verification.agreement import difference_of, mean_of


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


def test_samples_without_any_scatter_differ_by_infinitely_many_standard_errors():
    assert difference_of([1.0, 1.0], [2.0, 2.0]).standard_errors_from_zero == math.inf
    assert difference_of([1.0, 1.0], [1.0, 1.0]).standard_errors_from_zero == 0.0


@pytest.mark.parametrize("values", [[], [1.0], [[1.0, 2.0]]])
def test_a_single_value_has_no_interval(values):
    with pytest.raises(ValueError, match="give at least two"):
        mean_of(values)
