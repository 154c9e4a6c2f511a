"""Requirements of the scene: in noise floors, and in phases of the motion that the DEM itself shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from beds import drum, flowing, inclined_bed, resting
from test_metrics_judge import SCENE, rotating_bed, verdicts

from gran_bench.config import RequirementsConfig
from gran_bench.metrics import judge, summarise
from gran_bench.metrics.phases import find_phases
from gran_bench.scene import Rotation

ANY_RUN = ("all_finite", "none_outside", "starts_settled", "moves_by_velocity", "keeps_apart")


@pytest.fixture(scope="module")
def replicas():
    return [summarise(rotating_bed(60.0, 0.3, seed), SCENE) for seed in range(5)]


def phases_of(value, scene=SCENE, **asked):
    """The phases of a bed whose centre-of-mass angle is a function of the time since the start, in two runs."""
    summary = summarise(rotating_bed(60.0, scene=scene), scene)
    angle = summary.series["com_angle"]
    series = [
        summary.series | {"com_angle": replace(angle, value=value(angle.time - scene.start_time) + 0.1 * sign)}
        for sign in (-1, 1)
    ]
    return find_phases(series, scene, RequirementsConfig(**asked))


def overshoot(since):
    """Up to 60° at 0.4 s, down to 30° at 0.8 s, and a slow swing of 1° from then on."""
    return np.interp(since, [0.0, 0.4, 0.8], [0.0, 60.0, 30.0]) + np.sin(9.0 * since)


def test_the_steady_part_and_the_first_peak_are_found_from_the_dem():
    found = phases_of(overshoot)
    assert found.steady_from == pytest.approx(2.3, abs=0.05)  # 0.8 s after the start, less three standard deviations
    assert found.peak_before == found.steady_from
    assert found.turns == pytest.approx(0.4, abs=0.03)  # of the wall, at 30 rpm
    assert str(found) == "steady from 2.3 s on, after 0.4 turns of the wall; first peak before 2.3 s"
    assert found.pattern_time == pytest.approx(2.06)  # the state nearest to a quarter of the scene


def test_times_that_are_asked_for_are_taken():
    found = phases_of(overshoot, steady_from=3.0, peak_before=2.5)
    assert (found.steady_from, found.peak_before) == (3.0, 2.5)


@pytest.mark.parametrize(
    ("value", "why"),
    [
        (lambda since: 60.0 - 20.0 * since, "com angle still changes"),
        (lambda since: np.where(since > 2.0, np.nan, overshoot(since)), "com angle is not finite"),
    ],
)
def test_a_flow_that_still_changes_or_breaks_down_has_no_steady_part(value, why):
    found = phases_of(value)
    assert found.steady_from is None
    assert why in found.not_steady_because
    assert found.peak_before is not None, "the highest state there was, after which the angle fell, is the first peak"


def scattered(since):
    """As an angle scatters from state to state, degrees."""
    return np.random.default_rng(1).normal(0.0, 0.5, len(since))


def test_an_angle_that_still_rises_at_the_end_has_no_first_peak():
    for value in (lambda since: 20.0 * since, lambda since: 3.0 * since + scattered(since)):
        found = phases_of(value)
        assert found.peak_before is None
        assert str(found).endswith("; no first peak (the angle still rises at the end)")
    late = phases_of(lambda since: np.interp(since, [0.0, 1.9, 2.2], [0.0, 60.0, 50.0]) + scattered(since))
    assert late.peak_before is not None, "a fall that is under way is no scatter"


def test_an_angle_that_rises_to_its_steady_value_has_no_first_peak():
    found = phases_of(lambda since: np.interp(since, [0.0, 0.6], [0.0, 30.0]) + 0.5 * np.sin(9.0 * since))
    assert found.steady_from is not None
    assert found.peak_before is None
    assert found.no_peak_because == "the angle still rises where the flow counts as steady"
    broken = phases_of(lambda since: np.where(since > 1.0, np.nan, 30.0))
    assert broken.no_peak_because == "the angle does not fall from its highest value by more than it scatters"


def test_a_flow_that_is_steady_from_its_start_has_no_first_peak():
    found = phases_of(lambda since: 30.0 + np.sin(9.0 * since))
    assert found.steady_from == SCENE.start_time
    assert found.peak_before is None
    assert "steady from its start" in found.no_peak_because


def test_where_the_speed_changes_only_the_last_constant_span_can_be_steady_and_the_first_has_the_peak():
    ramp = replace(SCENE, rotation=Rotation((1.5, 2.5, 2.7), (30.0, 30.0, 40.0)))
    found = phases_of(lambda since: overshoot(since) + 10.0 * (since > 1.2), ramp)
    assert found.steady_from == pytest.approx(2.74, abs=0.05)
    assert found.peak_before == pytest.approx(2.54, abs=0.05)
    never = replace(SCENE, rotation=Rotation((1.5, 3.6), (30.0, 40.0)))
    assert "constant in the last" in phases_of(overshoot, never).not_steady_because


def test_a_scene_without_an_angle_is_steady_where_its_height_and_its_speeds_are():
    scene = SCENE.at_speed(50.0)
    runs = [summarise(rotating_bed(60.0, 0.3, seed, scene), scene) for seed in range(3)]
    assert find_phases([run.series for run in runs], scene).steady_from is not None
    falling = [run.series | {"center_height": replace(run.series["center_height"], value=-run.time)} for run in runs]
    assert "center height still changes" in find_phases(falling, scene).not_steady_because


def test_by_default_each_error_is_held_to_noise_floors(replicas):
    good, wrong = judge(rotating_bed(60.0, 0.3, 99), replicas, SCENE), judge(rotating_bed(90.0), replicas, SCENE)
    assert set(verdicts(good)) == {*ANY_RUN, "surface_angle", "com_angle", "speed_w1"}
    assert good.accepted
    assert verdicts(wrong)["com_angle"] == verdicts(wrong)["surface_angle"] == "fail"
    row = next(row for row in wrong.requirements if row.key == "com_angle")
    assert (row.figure.unit, row.bound) == ("noise floors", RequirementsConfig().floors)
    assert row.figure.number == pytest.approx(wrong.error("com_angle").multiple)
    assert row.label == "centre-of-mass angle, at most 4 noise floors"
    assert (
        verdicts(judge(rotating_bed(90.0), replicas, SCENE, asked=RequirementsConfig(floors=1e6)))["com_angle"]
        == "pass"
    )


def test_a_bound_in_degrees_takes_the_place_of_floors_and_holds_only_where_the_dem_has_the_figure(replicas):
    asked = RequirementsConfig(steady_angle_deg=3.0)
    found = verdicts(judge(rotating_bed(60.0, 0.3, 99), replicas, SCENE, asked=asked))
    assert set(found) == {*ANY_RUN, "surface_angle_steady", "com_angle_steady", "speed_w1"}
    late = RequirementsConfig(steady_angle_deg=3.0, steady_from=9.0)
    found = verdicts(judge(rotating_bed(90.0), replicas, SCENE, asked=late))
    assert found["com_angle_steady"] == "undefined"
    assert found["com_angle"] == "fail", "the angle is held to floors instead"


def test_without_a_floor_nothing_is_asked_for_in_floors(replicas):
    judgement = judge(rotating_bed(90.0), replicas[:1], SCENE)
    rows = {row.key: row for row in judgement.requirements}
    assert rows["com_angle"].verdict == "undefined"
    assert "no noise floor" in rows["com_angle"].figure.note


def test_a_figure_that_the_dem_has_and_the_candidate_lacks_fails(replicas):
    broken = rotating_bed(60.0, 0.3, 99)
    broken.velocity[25:] = np.nan
    assert verdicts(judge(broken, replicas, SCENE))["speed_w1"] == "fail"


def test_a_noisy_scene_is_asked_for_no_less_than_its_own_scatter():
    runs = [summarise(rotating_bed(60.0 + off), SCENE) for off in (0.0, 0.1, 30.0)]
    judgement = judge(rotating_bed(60.0), runs, SCENE, asked=RequirementsConfig(floors=2.0))
    (row,) = (row for row in judgement.requirements if row.key == "com_angle")
    assert row.bound > 2.0
    assert "runs of the DEM itself scatter more" in row.figure.note


def test_a_scene_without_an_angle_is_held_to_what_it_has():
    scene = replace(drum(end_time=1.6), walls=(), drum_radius=None, length=None)
    beds = [inclined_bed(0.0)[::9] + np.array([0.0, 0.0, 1e-3 * off]) for off in range(4)]
    runs = [resting(scene, bed, speed=1.0 + 0.1 * k) for k, bed in enumerate(beds)]
    found = verdicts(judge(runs[0], runs[1:], scene))
    assert found["center_height"] == found["speed_w1"] == "pass"
    assert not any("angle" in key for key in found)
    high = resting(scene, beds[0] + [0.0, 0.0, 0.1], speed=1.0)
    assert verdicts(judge(high, runs[1:], scene))["center_height"] == "fail"


def at_another_speed(seed: int):
    """A run of the DEM at another speed of training, whose bed swings less and moves more slowly."""
    return rotating_bed(57.0, 0.3, seed)


def test_a_model_that_replays_another_training_speed_fails_whatever_the_floors(replicas):
    generous, replays = RequirementsConfig(floors=100.0), {"25 rpm replayed": at_another_speed(50)}
    same, other = (judge(run, replicas, SCENE, replays=replays, asked=generous)
                   for run in (at_another_speed(50), at_another_speed(51)))  # fmt: skip
    assert verdicts(same)["beats_replay"] == verdicts(same)["not_a_replay"] == "fail"
    assert verdicts(other)["not_a_replay"] == "fail", "another run of the same speed, whichever errs more"
    good = judge(rotating_bed(60.0, 0.3, 99), replicas, SCENE, replays=replays)
    assert verdicts(good)["beats_replay"] == verdicts(good)["not_a_replay"] == "pass"
    rows = {row.key: row for row in good.requirements}
    worst, likeness = (rows[key] for key in ("beats_replay", "not_a_replay"))
    assert worst.figure.number < worst.bound
    assert worst.label == f"largest error, less than {worst.bound:.3g} noise floors (25 rpm replayed)"
    assert likeness.figure.number < likeness.bound
    assert likeness.label == f"speeds, nearer to the DEM than to 25 rpm replayed ({likeness.bound:.3g} m/s)"


def test_a_judgement_without_replays_says_that_it_did_not_ask_for_them(replicas):
    replayed, said = at_another_speed(50), "not asked: whether a run at another speed does as well; give replays={"
    assert said in str(judge(replayed, replicas, SCENE)).splitlines()[-1]
    assert "not asked" not in str(judge(replayed, replicas, SCENE, replays={"25 rpm replayed": replayed}))
    still = replace(SCENE, rotation=Rotation())
    assert "not asked" not in str(judge(replayed, replicas, still)), "where nothing turns there is no other speed"


def test_a_model_that_errs_as_much_as_a_replay_in_another_way_fails(replicas):
    replays = {"25 rpm replayed": at_another_speed(50)}
    found = verdicts(judge(rotating_bed(64.0, 0.3, 99), replicas, SCENE, replays=replays))
    assert (found["beats_replay"], found["not_a_replay"]) == ("fail", "pass")


def test_a_replay_that_cannot_be_told_from_the_dem_holds_nobody_to_anything(replicas):
    replays = {"30.01 rpm replayed": rotating_bed(60.0, 0.3, 50)}
    judgement = judge(rotating_bed(60.0, 0.3, 99), replicas, SCENE, replays=replays)
    rows = {row.key: row for row in judgement.requirements}
    assert rows["not_a_replay"].verdict == "undefined"
    assert "cannot be told from it" in rows["not_a_replay"].figure.note


def test_runs_that_are_no_rollouts_of_the_scene_are_no_replays(replicas):
    with pytest.raises(ValueError, match="25 rpm replayed has 200"):
        judge(rotating_bed(60.0), replicas, SCENE, replays={"25 rpm replayed": flowing(SCENE)})
