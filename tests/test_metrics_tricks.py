"""A judge that no trick passes: only a run of the DEM is taken for one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gran_bench import judge, settle, shipped_scene, simulate
from gran_bench.config import DemConfig
from gran_bench.dataset.case_spec import replica_nudge
from gran_bench.dataset.generation import nudged
from gran_bench.metrics import summarise
from gran_bench.metrics.ensembles import claims_of, judge_ensemble
from gran_bench.metrics.floor import Floor, beside_floor, nudges_grow, thinned
from gran_bench.metrics.requirements import held_rows
from gran_bench.metrics.sample import SAMPLE

SCENE = shipped_scene("drum_small", {"filling.count": 120, "container.length": 0.2, "end_time": 3.5}).at_speed(30.0)
DEM = DemConfig(threads=1)


@pytest.fixture(scope="module")
def runs():
    """Six replicas."""
    bed = settle(SCENE, seed=1, dem=DEM)
    starts = [nudged(bed, replica_nudge(SCENE), k) for k in range(6)]
    return [simulate(SCENE, start, SCENE.end_time, dem=DEM).trajectory for start in starts]


@pytest.fixture(scope="module")
def replicas(runs):
    return [summarise(run, SCENE) for run in runs[:5]]


def verdicts(judgement):
    return {row.key: row.verdict for row in judgement.requirements}


def failed(judgement):
    return {key for key, verdict in verdicts(judgement).items() if verdict == "fail"}


def mean_of(replicas):
    """What a perfect predictor of the mean says: the mean series, and the mean of each quantile of the speeds."""
    first = replicas[0]
    series = {
        name: replace(one, value=np.mean([run.series[name].value for run in replicas], axis=0))
        for name, one in first.series.items()
    }
    speed = np.mean([run.sorted_speed for run in replicas], axis=0)
    return replace(first, series=series, sorted_speed=speed, position=None, failures=None)


def picked(runs, choose):
    """A run whose frames come from others, by ``choose(frame)``: a run and its frame."""
    parts = [choose(k) for k in range(runs[0].frame_count)]
    arrays = {
        name: np.stack([getattr(runs[r], name)[k] for r, k in parts])
        for name in ("position", "velocity", "angular_velocity")
    }
    return replace(runs[0], diagnostics={}, **arrays)


def test_a_further_replica_passes_as_a_sample(runs, replicas):
    judgement = judge(runs[5], replicas, SCENE)
    assert not failed(judgement)
    assert {*SAMPLE} - {"is_sample"} <= {*verdicts(judgement)}


def test_the_mean_of_the_replicas_lies_nearer_than_a_replica_and_is_no_sample(replicas):
    mean, one = mean_of(replicas), judge(replicas[0], replicas[1:], SCENE)
    judgement = judge(mean, replicas, SCENE)
    assert judgement.error("com_angle").multiple < one.error("com_angle").multiple
    assert failed(judgement) == {"is_sample"}
    assert not judgement.accepted


def test_the_mean_of_the_replicas_as_spheres_is_no_sample_either(runs, replicas):
    arrays = {
        name: np.mean([getattr(run, name) for run in runs[:5]], axis=0)
        for name in ("position", "velocity", "angular_velocity")
    }
    assert failed(judge(replace(runs[0], diagnostics={}, **arrays), replicas, SCENE)) == {"keeps_apart"}


def test_frames_resampled_from_the_replicas_have_their_statistics_and_are_no_sample(runs, replicas):
    rng = np.random.default_rng(0)
    mixed = picked(runs, lambda k: (int(rng.integers(5)), k))
    judgement = judge(mixed, replicas, SCENE)
    assert judgement.error("com_angle").multiple < 1.5
    assert failed(judgement) == {"moves_by_velocity"}


def test_a_replica_that_is_ahead_does_not_start_at_the_settled_bed(runs, replicas):
    last = runs[0].frame_count - 1
    judgement = judge(picked(runs, lambda k: (0, min(k + 10, last))), replicas, SCENE)
    assert "starts_settled" in failed(judgement)


def test_a_replica_that_is_late_errs_by_too_many_floors(runs, replicas):
    assert "com_angle" in failed(judge(picked(runs, lambda k: (5, max(k - 25, 0))), replicas, SCENE))


def test_statistics_are_judged_by_their_energy_score_and_their_spread(replicas):
    rows = held_rows(replicas)
    mean = {row.key: row for row in judge_ensemble(claims_of(mean_of(replicas[:4]), rows), replicas[4:] + replicas[:3])}
    ensemble = {row.key: np.concatenate([claims_of(run, [row])[row.key] for run in replicas[:3]]) for row in rows}
    sample = {row.key: row for row in judge_ensemble(ensemble, replicas[3:])}
    for key in ("com_angle", "speed_w1"):
        assert mean[key].spread == 0.0
        assert mean[key].multiple > 1.15
        assert 0.5 < sample[key].spread < 2.0
        assert 0.6 < sample[key].multiple < 1.5
        assert sample[key].members == 3


def test_an_ensemble_may_claim_fewer_quantiles_than_there_are_spheres_and_lack_a_quantity(replicas):
    quantiles = np.stack([run.sorted_speed[:, 2::5] for run in replicas[:3]])
    (speeds, angle) = judge_ensemble({"speed_w1": quantiles}, replicas[3:], [
        row for row in held_rows(replicas) if row.key in ("speed_w1", "com_angle")][::-1])  # fmt: skip
    assert 0.5 < speeds.multiple < 1.6
    assert not angle.score.defined
    with pytest.raises(ValueError, match="choose from surface_angle"):
        judge_ensemble({"angle": quantiles}, replicas)
    with pytest.raises(ValueError, match="no spread"):
        judge_ensemble({"speed_w1": quantiles}, replicas[:1])


def test_fewer_spheres_of_the_same_volume_are_judged_beside_the_floor_for_so_few(runs, replicas):
    """A sample of a fourth of the spheres of a replica, each of four times the volume, errs by one floor in speeds."""
    few = runs[5].position.shape[1] // 4
    coarse = replace(
        runs[5],
        diagnostics={},
        radius=runs[5].radius[:few] * 4.0 ** (1.0 / 3.0),
        **{name: getattr(runs[5], name)[:, ::4] for name in ("position", "velocity", "angular_velocity")},
    )
    judgement, whole = judge(coarse, replicas, SCENE), judge(runs[5], replicas, SCENE)
    row = judgement.error("speed_w1")
    assert row.floor.number > 1.2 * whole.error("speed_w1").floor.number
    assert 0.6 < row.multiple < 1.6
    assert f"thinned to {few} of {4 * few} spheres" in judgement.floor_between
    assert judgement.error("com_angle").floor.number == pytest.approx(whole.error("com_angle").floor.number)
    assert "another number of spheres" in judgement.error("position_1").error.note
    assert "starts_settled" not in verdicts(judgement)
    with pytest.raises(ValueError, match="fewer spheres of the same volume"):
        judge(replace(coarse, radius=runs[5].radius[:few]), replicas, SCENE)


def test_a_run_of_more_spheres_is_thinned_itself(replicas):
    few = [thinned(run, 30) for run in replicas]
    mine, floor = beside_floor(replicas[0], few[1:])
    assert mine.sorted_speed.shape[1] == floor.spheres == 30
    assert np.all(np.diff(mine.sorted_speed, axis=1) >= 0.0)


def test_where_nudges_do_not_grow_the_floor_is_between_packings(replicas):
    apart = [replace(run, position=run.position + np.float32(0.01 * k)) for k, run in enumerate(replicas)]
    late = [replace(run, position=run.position.copy()) for run in apart]
    for run in late:
        run.position[: len(run.time) // 2 + 1] = 0.0
    assert nudges_grow(apart)
    assert not nudges_grow(late)
    still = [replace(run, position=run.position * 0.0) for run in replicas[:3]]
    assert not nudges_grow(still)
    assert beside_floor(still[0], still, replicas)[1].between == "packings"
    assert beside_floor(apart[0], apart, still)[1].between == "replicas"
    floor, row = Floor.of_runs(replicas, 10_000), held_rows(replicas)[-1]
    judgement = judge(still[0], still, SCENE, packings=replicas)
    assert judgement.floor_between == "packings"
    assert judgement.error(row.key).floor.number == pytest.approx(floor.of(row).number)


def test_a_run_that_stores_mean_velocities_in_single_precision_moves_as_they_say(runs):
    """As a model of mean velocities does; the DEM's own means follow from its positions without any rounding."""
    mean = replace(runs[0], velocity=runs[0].mean_velocity().astype(np.float32), velocity_kind="mean")
    again = verdicts(judge(mean, runs[1:], SCENE))
    assert again["moves_by_velocity"] == "pass"
    slower = replace(mean, velocity=0.9 * mean.velocity)
    assert verdicts(judge(slower, runs[1:], SCENE))["moves_by_velocity"] == "fail"
