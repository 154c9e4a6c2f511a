"""Ensembles of statistics beside replicas of the DEM: the energy score, and how wide the ensemble is.

A method without particles claims a distribution: an ensemble of series, or of quantiles of a state. The mean of the
replicas lies closer to each of them than another replica does, so a distance to replicas would favour whoever hides
the scatter of the flow. The energy score is smallest, in the mean, for the ensemble that scatters as the flow does.
"""

import math

import numpy as np

from gran_bench.metrics.measured import LEAST_VALID_SHARE
from gran_bench.state import FloatArray


def energy_scores(ensemble: FloatArray, replicas: FloatArray) -> FloatArray:
    """Energy score of an ensemble in each state, mean over the replicas, ``(F,)`` in their unit.

    ES = mean_mr |x_m − y_r| − ½ mean_{m≠n} |x_m − x_n|, the second mean over different members, so that it does not
    depend on how many there are (Gneiting & Raftery, J. Am. Stat. Assoc. 102, 2007, eq. 20–21; Ferro, Q. J. R.
    Meteorol. Soc. 140, 2014). A single member claims no spread: ES is its mean distance. Runs of the DEM itself have,
    in the mean, half the noise floor.

    Args:
        ensemble: ``(M, F)`` members; ``(M, F, Q)`` where a state has Q figures, such as quantiles, of which the
            mean is taken. The distance of two sets of Q quantiles is then their Wasserstein-1 distance.
        replicas: ``(R, F)`` or ``(R, F, Q)`` runs of the DEM, in the same unit.

    Raises:
        ValueError: shapes that do not belong together, or no member, replica or state.

    A state in which a member or a replica has no finite figure is NaN.
    """
    x, y = _held(ensemble, replicas)
    far = np.mean([np.abs(x - one).mean(axis=0) for one in y], axis=0)
    if (count := len(x)) > 1:
        # Σ_{m<n} (x_n − x_m) of increasing members: each one counts as often as it is the larger.
        rank = 2.0 * np.arange(count) - (count - 1.0)
        far = far - np.tensordot(rank, np.sort(x, axis=0), axes=1) / (count * (count - 1.0))
    return far.mean(axis=1)


def energy_score(ensemble: FloatArray, replicas: FloatArray) -> float:
    """Mean over the states of `energy_scores`; NaN where fewer than 90 % of the states have one."""
    score = energy_scores(ensemble, replicas)
    valid = np.isfinite(score)
    return float(score[valid].mean()) if valid.mean() >= LEAST_VALID_SHARE else math.nan


def spread_ratio(ensemble: FloatArray, replicas: FloatArray) -> float:
    """Spread of an ensemble in units of the replicas' spread, √(⟨s²_ensemble⟩ / ⟨s²_replicas⟩), −; 1 is right.

    s² is the variance over members or replicas, ⟨⟩ the mean over the states (and the Q figures of each). Arrays as in
    `energy_scores`. A single member has no spread: 0. NaN where the replicas have none, or where fewer than 90 % of
    the states are finite. A single replica is a `ValueError`.
    """
    x, y = _held(ensemble, replicas)
    if len(y) < 2:
        raise ValueError("replicas has one run, which has no spread; give two or more")
    valid = np.isfinite(x).all(axis=(0, 2)) & np.isfinite(y).all(axis=(0, 2))
    own = float(y[:, valid].var(axis=0, ddof=1).mean()) if valid.mean() >= LEAST_VALID_SHARE else 0.0
    if not own:
        return math.nan
    return math.sqrt(float(x[:, valid].var(axis=0, ddof=1).mean()) / own) if len(x) > 1 else 0.0


def _held(ensemble: FloatArray, replicas: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Both as ``(…, F, Q)`` in double precision; a `ValueError` that names what does not fit."""
    x, y = (np.asarray(array, np.float64) for array in (ensemble, replicas))
    for name, array in (("ensemble", x), ("replicas", y)):
        if array.ndim not in (2, 3) or not array.size:
            raise ValueError(f"{name} has shape {array.shape}; expected (runs, states) or (runs, states, figures)")
    if x.shape[1:] != y.shape[1:]:
        raise ValueError(f"ensemble has states of shape {x.shape[1:]} and replicas {y.shape[1:]}; give both alike")
    x, y = (np.where(np.isfinite(array), array, np.nan) for array in (x, y))
    return (x[..., None], y[..., None]) if x.ndim == 2 else (x, y)
