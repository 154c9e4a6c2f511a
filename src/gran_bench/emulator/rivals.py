"""What the emulator has to beat on the same data: a lag behind a table of constant runs, neighbours, regression."""

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from gran_bench.emulator.training import TrainingRuns
from gran_bench.scene import Scene
from gran_bench.state import FloatArray

Rival = Callable[[Scene, FloatArray], FloatArray]  # of a scene and the first frame's figures (C,), the figures (F, C)

LAGS = (0, 2, 5, 10, 15, 20, 30, 40, 60, 80, 120, 160, 240)  # frames into the past at which the speed is looked up
NEIGHBOURS = 10
PENALTY = 1e-2  # of ridge regression, for features of unit width
TIME_CONSTANTS = np.geomspace(2.0, 200.0, 25)  # frames
STEADY_SHARE = 0.4  # of a constant run: its last part


def rivals(data: TrainingRuns) -> dict[str, Rival]:
    """The rivals by name, fitted to the training series."""
    return {
        "first-order lag on a table of constant runs": _lag(data),
        "nearest neighbours": _neighbours(data),
        "ridge regression": _ridge(data),
    }


def _speeds(scene: Scene) -> FloatArray:
    """|ω| of each frame, rad/s."""
    time = scene.start_time + scene.frame_interval * np.arange(scene.frame_count)
    return np.abs(scene.rotation.angular_speed(time))


def _filled(values: FloatArray) -> FloatArray:
    """Columns with their gaps filled between neighbours in time; a column without any value is 0."""
    filled = np.array(values, np.float64)
    for column in filled.T:
        known = np.isfinite(column)
        column[:] = np.interp(np.arange(len(column)), np.flatnonzero(known), column[known]) if known.any() else 0.0
    return filled


def _lag(data: TrainingRuns) -> Rival:
    """y' = (y∞(ω) − y)/τ from the settled figures; y∞ between constant runs, τ of each column by least error."""
    constant = [one for one in data.series if len(set(one.scene.rotation.speeds_rpm)) == 1]
    table = {}
    for one in constant:
        last = one.columns[-int(STEADY_SHARE * len(one.time)) :]
        table.setdefault(float(_speeds(one.scene)[-1]), []).append(np.nanmean(last, axis=0))
    still = np.stack([one.columns[0] for one in data.series])
    # No run has a torque in its first frame: it is 0 there.
    table[0.0] = [np.nanmean(np.where(np.isfinite(still).any(axis=0), still, 0.0), axis=0)]
    speeds = np.array(sorted(table))
    rows = np.array([np.mean(table[speed], axis=0) for speed in speeds])

    def at(scene: Scene, first: FloatArray, constants: FloatArray) -> FloatArray:
        now = _speeds(scene)
        target = np.stack([np.interp(now, speeds, column) for column in rows.T], axis=1)
        share, found = 1.0 - np.exp(-1.0 / constants), np.empty_like(target)
        found[0] = np.where(np.isfinite(first), first, target[0])
        for frame in range(1, len(now)):
            found[frame] = found[frame - 1] + share * (target[frame] - found[frame - 1])
        return found

    errors = [
        np.mean([np.nanmean(np.abs(at(s.scene, s.columns[0], c) - s.columns), axis=0) for s in data.series], axis=0)
        for c in (np.full(rows.shape[1], constant) for constant in TIME_CONSTANTS)
    ]
    best = TIME_CONSTANTS[np.argmin(errors, axis=0)]
    return lambda scene, first: at(scene, first, best)


def _features(scene: Scene, first: FloatArray) -> FloatArray:
    """The speed now and before, time since the start, the settled angles, filling, friction: ``(F, K)``."""
    now = _speeds(scene)
    before = np.concatenate([np.zeros(max(LAGS)), now])
    past = [before[max(LAGS) - lag :][: len(now)] for lag in LAGS]
    since = np.minimum(np.arange(len(now)), max(LAGS)) / max(LAGS)
    rest = [*np.nan_to_num(first[:2]), 1e-3 * scene.filling.count, 10.0 * scene.material.friction]
    return np.stack([*past, since, *(np.full(len(now), value) for value in rest)], axis=1)


def _stacked(data: TrainingRuns) -> tuple[FloatArray, FloatArray]:
    x = np.concatenate([_features(one.scene, one.columns[0]) for one in data.series])
    return x, np.concatenate([_filled(one.columns) for one in data.series])


def _neighbours(data: TrainingRuns) -> Rival:
    """Mean figures of the ten nearest frames of the training series."""
    x, y = _stacked(data)
    tree = cKDTree(x)
    return lambda scene, first: y[tree.query(_features(scene, first), k=NEIGHBOURS)[1]].mean(axis=1)


def _ridge(data: TrainingRuns) -> Rival:
    """Least squares with a penalty on features, their squares and |ω| = 0 at each lag."""
    x, y = _stacked(data)

    def wide(x: FloatArray) -> FloatArray:
        return np.concatenate([x, x**2, x[:, : len(LAGS)] == 0.0], axis=1)

    middle, extent = wide(x).mean(axis=0), wide(x).std(axis=0) + 1e-9
    z, offset = (wide(x) - middle) / extent, y.mean(axis=0)
    weights = np.linalg.solve(z.T @ z + PENALTY * len(z) * np.eye(z.shape[1]), z.T @ (y - offset))
    return lambda scene, first: (wide(_features(scene, first)) - middle) / extent @ weights + offset
