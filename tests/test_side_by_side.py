"""What the DEM errs from its own stored frames, which have no contact springs: the unit of near errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from beds import drum

from gran_bench.config import DemConfig
from gran_bench.dataset import Case
from gran_bench.dem.simulate import simulate
from gran_bench.metrics.position_error import separation
from gran_bench.sweep.side_by_side import dem_ahead

FRAMES = 8


def test_the_dem_from_a_stored_frame_follows_its_own_run_but_for_what_the_springs_did(tmp_path: Path):
    scene = drum(end_time=1.58, length=0.25)
    scene = replace(scene, filling=replace(scene.filling, count=40))
    begun = simulate(replace(scene, start_time=0.0), scene.fresh_filling(0), 1.5)
    whole = simulate(scene, begun.final, 1.58)
    case = Case(scene, whole.trajectory, begun.final, {}, "", tmp_path)
    for start, ahead in ((0, 1), (2, 5)):
        found = dem_ahead(case, DemConfig(), start, ahead).trajectory
        assert found.frame_count == ahead + 1
        assert found.time[0] == whole.trajectory.time[start]
        error = separation(found.position, whole.trajectory.position[start : start + ahead + 1])
        assert error[0] == 0.0
        assert 0.0 < error[-1] < 0.02 * scene.filling.diameter
    # With the springs of the settled state there is no error at all.
    exact = simulate(scene, begun.final, 1.53).trajectory
    assert np.array_equal(exact.position, whole.trajectory.position[: exact.frame_count])
