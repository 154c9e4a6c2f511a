"""Ensembles of statistics: the energy score favours whoever scatters as the flow does."""

import re

import numpy as np
import pytest

from gran_bench.metrics.statistics import energy_score, energy_scores, spread_ratio


def runs(count: int, seed: int, spread: float = 1.0, states: int = 4000) -> np.ndarray:
    return 30.0 + spread * np.random.default_rng(seed).standard_normal((count, states))


def distance(runs: np.ndarray) -> float:
    pairs = [np.abs(runs[i] - runs[j]).mean() for i in range(len(runs)) for j in range(i)]
    return float(np.mean(pairs))


def test_the_energy_score_is_its_definition_over_members_and_replicas():
    ensemble, replicas = runs(4, 0, states=3), runs(2, 1, states=3)
    expected = []
    for state in range(3):
        x, y = ensemble[:, state], replicas[:, state]
        apart = [abs(x[m] - x[n]) for m in range(4) for n in range(4) if m != n]
        expected.append(np.mean(np.abs(x[:, None] - y)) - 0.5 * np.mean(apart))
    assert energy_scores(ensemble, replicas) == pytest.approx(expected)


def test_runs_of_the_dem_itself_score_half_the_floor_and_have_its_spread():
    replicas = runs(5, 0)
    assert 2.0 * energy_score(runs(5, 1), replicas) == pytest.approx(distance(replicas), rel=0.03)
    assert 2.0 * energy_score(runs(50, 2), replicas) == pytest.approx(distance(replicas), rel=0.03)
    assert spread_ratio(runs(5, 1), replicas) == pytest.approx(1.0, rel=0.03)


def test_a_mean_without_spread_and_too_wide_an_ensemble_score_worse_than_the_dem():
    replicas, own = runs(5, 0), energy_score(runs(20, 1), runs(5, 0))
    mean = replicas.mean(axis=0, keepdims=True)
    assert np.abs(mean - replicas).mean() < distance(replicas)  # by distance alone the mean would win
    assert energy_score(mean, replicas) > 1.2 * own
    assert energy_score(runs(20, 1, spread=3.0), replicas) > 1.2 * own
    assert spread_ratio(mean, replicas) == 0.0
    assert spread_ratio(runs(20, 1, spread=3.0), replicas) == pytest.approx(3.0, rel=0.03)


def test_quantiles_of_a_state_are_compared_in_the_wasserstein_distance():
    one, other = np.sort(runs(2, 0, states=24)[:, None, :], axis=2)
    assert energy_score(one[None], other[None]) == pytest.approx(np.abs(one - other).mean())


def test_a_state_without_a_figure_is_nan_and_too_many_of_them_leave_no_score():
    ensemble, replicas = runs(3, 0, states=20), runs(3, 1, states=20)
    ensemble[1, 4] = np.nan
    assert np.isnan(energy_scores(ensemble, replicas)[4])
    assert np.isfinite([energy_score(ensemble, replicas), spread_ratio(ensemble, replicas)]).all()
    ensemble[1, :4] = np.inf
    assert np.isnan([energy_score(ensemble, replicas), spread_ratio(ensemble, replicas)]).all()


@pytest.mark.parametrize(
    ("shapes", "said"),
    [
        (((3,), (2, 3)), "ensemble has shape (3,)"),
        (((3, 5), (2, 4)), "ensemble has states of shape (5,) and replicas (4,)"),
        (((3, 5), (0, 5)), "replicas has shape (0, 5)"),
    ],
)
def test_arrays_that_do_not_belong_together_are_refused(shapes, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        energy_score(*map(np.zeros, shapes))
    with pytest.raises(ValueError, match="one run, which has no spread"):
        spread_ratio(np.zeros((3, 5)), np.zeros((1, 5)))
