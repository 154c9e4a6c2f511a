"""Two-colour Shannon entropy: how far the bed has mixed the two halves that it started as."""

from __future__ import annotations

import numpy as np
from scipy.special import entr

from gran_bench.config.registry import register_metric
from gran_bench.config.rules import check_arguments
from gran_bench.metrics.angle_of_repose import cross_section_axes
from gran_bench.metrics.measured import Series
from gran_bench.scene import Scene
from gran_bench.state import Trajectory

CELL = 2.0  # diameters, edge of a square cell of the cross-section


@register_metric("mixing entropy", "-")
def mixing(trajectory: Trajectory, scene: Scene) -> Series:
    """Entropy of mixing of every state, 0 (apart) to 1 (mixed), −.

    S = −Σ_c n_c (p_c ln p_c + q_c ln q_c) / (N ln 2), p_c and q_c the shares of the two colours among the n_c
    spheres of cell c (Arntz et al., AIChE J. 54, 2008). A sphere's colour is the half of the first state's bed, left
    or right of its median along the climbing direction, that it lay in. Cells are 2 d squares of the cross-section
    over the full length, which hold enough spheres to leave little bias from small numbers.
    """
    check_arguments(trajectory=(trajectory, Trajectory), scene=(scene, Scene))
    value = np.full(trajectory.frame_count, np.nan)
    if not scene.needs.gravity or not len(trajectory.radius):
        return Series(trajectory.time, value, "-", undefined_because="the scene has no bed")
    across = trajectory.position.astype(np.float64) @ np.stack(cross_section_axes(scene), axis=1)
    if not np.isfinite(across[0]).all():
        return Series(trajectory.time, value, "-", undefined_because="the first state is not finite")
    coloured = across[0, :, 0] > np.median(across[0, :, 0])
    edge = CELL * scene.filling.diameter
    for frame, centers in enumerate(across):
        if not np.isfinite(centers).all():
            continue
        # Ranks instead of numbers of cells: these have no largest, however far a sphere flies.
        column, row = (np.unique(line, return_inverse=True)[1] for line in np.floor(centers / edge).T)
        _, cell = np.unique(column * len(centers) + row, return_inverse=True)
        count = np.bincount(cell)
        share = np.bincount(cell, coloured) / count
        value[frame] = (count * (entr(share) + entr(1.0 - share))).sum() / (count.sum() * np.log(2.0))
    return Series(trajectory.time, value, "-", invalid_because="position is not finite")
