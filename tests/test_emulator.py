"""The statistics emulator: its schedules, its recurrence, its spread, and a whole experiment in a tiny drum."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gran_bench.config import (
    ContainerConfig,
    DatasetConfig,
    DemConfig,
    EmulatorConfig,
    FillingConfig,
    JudgeConfig,
    OptimConfig,
    SceneConfig,
    SchedulesConfig,
    TrackingConfig,
    TrainConfig,
    TrainerConfig,
)
from gran_bench.config.reading import validate
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import CaseSpec, DatasetError
from gran_bench.emulator.judging import distance, judge_schedule, judgement
from gran_bench.emulator.network import INPUTS, Emulator, load_emulator, settled_angles
from gran_bench.emulator.runs import FIGURES, RunStatistics, ensure_runs, measure, quantiles, read_run, run_path
from gran_bench.emulator.scan import DrivenModes, driven_by_frames
from gran_bench.emulator.schedules import Judged, judged_schedules, random_rotation, refuse_unfair, training_cases
from gran_bench.emulator.told import OVER, Told
from gran_bench.run.experiment import run_experiment
from gran_bench.run.identity import emulator_plan, identify
from gran_bench.run.summary import summary_table
from gran_bench.scene import build_scene
from gran_bench.scene.motion import Rotation
from gran_bench.state import Trajectory
from gran_bench.surrogate.checkpoint import CheckpointError, load_model

NAMES = [name for name in FIGURES if name != "torque"]
SCENE = build_scene(SceneConfig(name="drum"))


def tiny(root: Path, **changes) -> TrainConfig:
    """A drum of 60 spheres for a tenth of a second, a few runs, an emulator of a few numbers."""
    settings = dict(
        experiment="tiny",
        threads=1,
        device="cpu",
        scene=SceneConfig(
            name="drum_tiny",
            container=ContainerConfig(diameter=0.4, length=0.2, periodic_axis=True),
            filling=FillingConfig(count=60),
            start_time=0.4,
            end_time=0.6,
        ),
        dataset=DatasetConfig(root=str(root / "data"), replicas=3, workers=1),
        model=EmulatorConfig(
            width=8, modes=4, blocks=1, stride=3, committee=2, batch=4, members=4,
            schedules=SchedulesConfig(runs=7, twins=3, stopping=2, constants=2, filling_spread=0.1),
        ),
        optim=OptimConfig(learning_rate=1e-2, final_learning_rate=1e-3, accumulate=2, weight_average=0.9),
        trainer=TrainerConfig(steps=6, log_every=2, checkpoint_steps=2),
        judge=JudgeConfig(scenes=[], random_schedules=1),
        tracking=TrackingConfig(root=str(root / "results"), enabled=False),
    )  # fmt: skip
    return TrainConfig(**(settings | changes))


# ---- schedules -------------------------------------------------------------------------------------------


def test_a_random_schedule_follows_from_its_seed_and_stays_in_its_range():
    rotations = [random_rotation(SCENE, seed, 15.0, 42.0) for seed in range(60)]
    assert rotations == [random_rotation(SCENE, seed, 15.0, 42.0) for seed in range(60)]
    assert len(set(rotations)) == 60
    speeds = [speed for rotation in rotations for speed in rotation.speeds_rpm]
    assert all(speed == 0.0 or 15.0 <= speed <= 42.0 for speed in speeds)
    assert any(0.0 in rotation.speeds_rpm[1:] for rotation in rotations), "none stops"


def test_training_has_twins_other_beds_and_no_motion_that_is_judged():
    dataset, schedules = DatasetConfig(), SchedulesConfig(runs=20, twins=4, stopping=0)
    shipped = {"drum_stop": Rotation((1.5, 3.5, 3.5, 4.5, 4.5), (30.0, 30.0, 0.0, 0.0, 30.0))}
    cases = training_cases(SCENE, DemConfig(), dataset, schedules, shipped)
    plain, twins = [case for case in cases if not case.nudge], [case for case in cases if case.nudge]
    assert (len(plain), len(twins)) == (20, 4)
    assert all(replace(twin, nudge=0.0, nudge_seed=0) in plain for twin in twins)
    assert {case.packing_seed for case in cases}.isdisjoint({dataset.unseen_packing_seed})
    assert len({case.packing_seed for case in cases}) > 8
    assert len({case.scene.filling.count for case in cases}) > 2
    judged = judged_schedules(SCENE, DemConfig(), dataset, JudgeConfig(random_schedules=3), schedules, shipped)
    assert [one.label for one in judged[:4]] == ["30 rpm", "drum_stop", "random 1000", "random 1001"]
    motions = {one.replicas[0].scene.rotation for one in judged}
    assert motions.isdisjoint({case.scene.rotation for case in cases})


def test_further_runs_stop_often_and_need_no_bed_of_their_own():
    schedules = SchedulesConfig(runs=40, twins=4, stopping=40)
    cases = training_cases(SCENE, DemConfig(), DatasetConfig(), schedules, {})
    plain, stopping = cases[:40], cases[40:80]
    times = SCENE.start_time + SCENE.frame_interval * np.arange(SCENE.frame_count)

    def at_rest(some: list[CaseSpec]) -> float:
        return float(np.mean([case.scene.rotation.angular_speed(times) == 0.0 for case in some]))

    assert at_rest(stopping) > 1.5 * at_rest(plain) > 0.0
    assert {case.settled_path("data") for case in stopping} < {case.settled_path("data") for case in plain}
    assert sum(case.packing_seed == DatasetConfig().packing_seed for case in stopping) == 10
    assert {(case.scene.filling, case.scene.material) for case in stopping} == {(SCENE.filling, SCENE.material)}
    assert all(case.nudge for case in cases[80:])
    fewer = training_cases(SCENE, DemConfig(), DatasetConfig(), replace(schedules, stopping=0), {})
    assert fewer == [*plain, *cases[80:]], "the other runs stay as they are"


@pytest.mark.parametrize("speeds", [(30.0, 30.0), (-30.0, -30.0)])
def test_a_training_run_that_turns_as_a_judged_one_is_refused(speeds):
    """Written in another way, and the mirror image, too."""
    same = CaseSpec(replace(SCENE, rotation=Rotation((1.5, 3.0), speeds)))
    with pytest.raises(DatasetError, match="turns as the held-out 30 rpm does"):
        refuse_unfair([same], [Rotation((1.5,), (30.0,))], {})
    with pytest.raises(DatasetError, match="turns as drum_stop does"):
        refuse_unfair([same], [], {"drum_stop": Rotation((1.5,), (30.0,))})


def test_a_shipped_scene_of_another_drum_is_refused_by_name(tmp_path):
    config = tiny(tmp_path, judge=JudgeConfig(scenes=["drum_ramp"]))
    with pytest.raises(ConfigError, match="drum_ramp differs from scene drum_tiny in more than its motion"):
        emulator_plan(config)


# ---- the recurrence --------------------------------------------------------------------------------------


@pytest.mark.parametrize("frames", [1, 2, 37])
def test_the_compiled_recurrence_is_the_one_by_frames_and_so_is_its_gradient(frames):
    rng = torch.Generator().manual_seed(0)
    shapes = (3, frames, 5), (3, frames, 10), (5,), (5,)
    log_pace, drive, rate, angle = (torch.randn(*shape, dtype=torch.float64, generator=rng) for shape in shapes)
    slope, found = torch.randn(3, frames, 10, dtype=torch.float64, generator=rng), []
    for modes in (DrivenModes.apply, driven_by_frames):
        given = [value.clone().requires_grad_() for value in (log_pace, drive, rate.abs(), angle)]
        state = modes(*given)
        gradients = torch.autograd.grad(state, given, slope, allow_unused=True, materialize_grads=True)
        found.append([state.detach(), *gradients])
    for compiled, plain in zip(*found, strict=True):
        torch.testing.assert_close(compiled, plain)


def test_a_phase_begins_where_the_wall_starts_and_where_it_stops():
    speed = torch.tensor([0.0, 1.0, 1.0, 0.0, 0.0, 2.0, 2.0])
    inputs = torch.zeros(1, 7, len(INPUTS))
    inputs[0, :, 0] = inputs[0, :, OVER] = speed
    inputs[0, :, 2] = speed != 0.0
    told = Told.of(inputs, unit_angle=0.1, unit_time=0.5)
    assert told.before[0].tolist() == [0, 0, 0, 2, 2, 4, 4]
    turned = torch.atanh(told.signal[0, :, len(INPUTS)]) * 0.15
    torch.testing.assert_close(turned, torch.tensor([0.0, 0.1, 0.2, 0.0, 0.0, 0.2, 0.4]))
    every = told.part(2, 1)
    assert every.before[0].tolist() == [0, 0, 1]
    assert every.signal[0, :, OVER].tolist() == [1.0, 0.5, 1.0]
    torch.testing.assert_close(every.signal[..., 3:], told.signal[:, 1::2, 3:])


def test_a_frame_follows_from_the_speed_up_to_it_and_not_beyond():
    torch.manual_seed(0)
    emulator = Emulator(EmulatorConfig(), SCENE, NAMES)
    steady = replace(SCENE, rotation=Rotation((1.5,), (25.0,)))
    stops = replace(SCENE, rotation=Rotation((1.5, 3.5, 3.5), (25.0, 25.0, 0.0)))
    one, other = (emulator.statistics(scene, np.array([1.0, 2.0]), members=2) for scene in (steady, stops))
    before = one.time < 3.5 - 1e-9
    np.testing.assert_allclose(one.mean[before], other.mean[before], atol=1e-5)
    assert np.abs(one.mean[~before] - other.mean[~before]).max() > 1e-3


def test_backward_rotation_is_the_mirror_image():
    torch.manual_seed(0)
    emulator = Emulator(EmulatorConfig(), SCENE, NAMES)
    forward, backward = (replace(SCENE, rotation=Rotation((1.5,), (v,))) for v in (25.0, -25.0))
    settled = np.array([1.0, 2.0])
    np.testing.assert_array_equal(emulator.inputs(forward, settled), emulator.inputs(backward, settled))


def test_an_ensemble_has_the_spread_that_is_said_and_its_quantiles_in_order():
    torch.manual_seed(0)
    emulator = Emulator(EmulatorConfig(), SCENE, NAMES)
    emulator.persistence.fill_(0.9)
    scene = replace(SCENE, rotation=Rotation((1.5,), (25.0,)))
    said = emulator.statistics(scene, np.zeros(2), seed=1, members=400)
    for name in ("surface_angle", "com_angle"):
        place = said.columns[name]
        ratio = said.members[..., place].std(axis=0, ddof=1) / said.spread[:, place]
        assert ratio.mean() == pytest.approx(1.0, abs=0.05)
    assert (np.diff(said.members[..., said.columns["speed"]], axis=-1) >= 0.0).all()
    again = emulator.statistics(scene, np.zeros(2), seed=1, members=400)
    np.testing.assert_array_equal(again.members, said.members)


@pytest.mark.parametrize(
    ("scene", "settled", "words"),
    [
        (replace(SCENE, rotation=Rotation((1.5,), (60.0,))), (0.0, 0.0), "no angle of repose"),
        (replace(SCENE, rotation=Rotation((1.5, 2.0), (20.0, -20.0))), (0.0, 0.0), "turns both ways"),
        (replace(SCENE, frame_interval=0.02), (0.0, 0.0), "frame interval"),
        (SCENE, (np.nan, 0.0), "no angles of a settled bed"),
    ],
)
def test_what_the_emulator_was_not_made_for_is_refused(scene, settled, words):
    emulator = Emulator(EmulatorConfig(), SCENE, NAMES)
    with pytest.raises(ValueError, match=words):
        emulator.statistics(scene, np.array(settled))


def test_the_settled_angles_are_those_of_the_first_frame():
    rng = np.random.default_rng(0)
    bed = SCENE.fresh_filling(0)
    low = bed.position * [0.3, 1.0, 0.3] + [0.0, 0.0, -0.3] + rng.normal(0.0, 1e-3, bed.position.shape)
    still = replace(bed, position=low, time=SCENE.start_time)
    motion = Trajectory(np.array([1.5]), low[None], np.zeros_like(low)[None], None, bed.radius)
    first = measure(motion, SCENE)
    found = settled_angles(SCENE, still)
    np.testing.assert_allclose(found, [first["surface_angle"][0, 0], first["com_angle"][0, 0]])


def test_what_lies_beyond_the_training_is_said():
    emulator = Emulator(EmulatorConfig(), SCENE, NAMES)
    inside = replace(SCENE, rotation=Rotation((1.5, 3.0, 3.0), (20.0, 20.0, 0.0)))
    assert emulator.extrapolations(inside) == []
    beyond = replace(
        SCENE,
        rotation=Rotation((1.5,), (10.0,)),
        filling=replace(SCENE.filling, count=1500),
        material=replace(SCENE.material, friction=0.5),
    )
    said = emulator.extrapolations(beyond)
    assert [line.partition(",")[0] for line in said] == ["10 rpm", "spheres 1500", "friction 0.5"]


# ---- judging ---------------------------------------------------------------------------------------------


def noise(rng: np.random.Generator, count: int) -> np.ndarray:
    """Runs of independent frames about one expectation, ``(count, F, C)``; quantiles in order."""
    runs = rng.standard_normal((count, SCENE.frame_count, 27))
    runs[..., 2:26] = np.sort(runs[..., 2:26], axis=-1)
    return runs


@pytest.fixture
def judge_said(monkeypatch):
    """Judge a mean and an ensemble against five runs of noise."""
    rng = np.random.default_rng(0)
    places = {"surface_angle": (0, 1), "com_angle": (1, 2), "speed": (2, 26), "mean_speed": (26, 27)}
    truth = noise(rng, 5)
    scene = replace(SCENE, rotation=Rotation((1.5,), (30.0,)))
    case = CaseSpec(scene)
    series = [
        RunStatistics(scene, np.arange(SCENE.frame_count) * 0.01, {n: run[:, a:b] for n, (a, b) in places.items()})
        for run in truth
    ]

    def judged(mean: np.ndarray, members: np.ndarray):
        emulator = Emulator(EmulatorConfig(), SCENE, NAMES)
        said = replace(emulator.statistics(scene, np.zeros(2), members=2), mean=mean, members=members)
        monkeypatch.setattr(emulator, "statistics", lambda *_, **__: said)
        return judge_schedule(emulator, Judged("30 rpm", False, (case,) * 5), series, {"replay": lambda s, f: truth[0]})

    return judged


def test_the_expectation_passes_and_a_replica_or_a_shifted_mean_do_not(judge_said):
    rng = np.random.default_rng(1)
    expectation, ensemble = noise(rng, 4000).mean(axis=0), noise(rng, 20)

    def verdicts(mean, members):
        rows = judgement([judge_said(mean, members)], False, faster=1e3).requirements
        return {row.key: row.verdict for row in rows}

    assert set(verdicts(expectation, ensemble).values()) == {"pass"}
    assert verdicts(noise(rng, 1)[0], ensemble)["surface_angle_mean"] == "fail"  # as right as the DEM is, as a sample
    assert verdicts(expectation + 1.5, ensemble)["com_angle_mean"] == "fail"
    narrow = expectation + 0.3 * (ensemble - expectation)
    assert verdicts(expectation, narrow)["surface_angle_spread"] == "fail"
    row = judge_said(expectation, ensemble).row["surface_angle"]
    assert row["energy"] == pytest.approx(0.5 * row["floor"], rel=0.1)
    assert judge_said(expectation, narrow).row["surface_angle"]["energy"] > row["energy"]


def test_a_distance_over_too_few_valid_frames_is_undefined():
    a, b = np.zeros((20, 1)), np.ones((20, 1))
    a[0] = np.nan
    assert distance(a, b) == 1.0
    a[:3] = np.nan
    assert np.isnan(distance(a, b))


def test_quantiles_are_at_the_middles_of_their_shares():
    ordered = np.sort(np.random.default_rng(0).normal(size=(2, 2400)), axis=1)
    expected = np.quantile(ordered, (np.arange(24) + 0.5) / 24, axis=1, method="hazen").T
    np.testing.assert_allclose(quantiles(ordered), expected)


# ---- a whole experiment ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[TrainConfig, dict]:
    config = tiny(tmp_path_factory.mktemp("emulator"))
    validate(config)
    return config, run_experiment(config)


def test_an_experiment_makes_judges_and_draws(finished):
    config, summary = finished
    folder = identify(config).folder
    assert (folder / "figures" / "schedules.png").exists()
    assert set(summary["judged"]) == {"shared", "unseen"}
    found = summary["statistics"]
    assert set(found["schedules"]) == {
        "30 rpm", "30 rpm, unseen packing", "random 1000", "random 1000, unseen packing",
    }  # fmt: skip
    assert len(found["averages"]["shared"]["com_angle"]["rivals"]) == 3
    assert found["seconds_a_second"] > 0.0
    text = summary_table(summary)
    assert "nearest neighbours, unseen packing" in text
    assert "spread of the ensemble" in text
    assert json.loads((folder / "summary.json").read_text())["statistics"] == found


def test_runs_that_count_their_energy_teach_the_torque_on_the_drum(tmp_path):
    config = tiny(tmp_path, dem=DemConfig(power=True))
    summary = run_experiment(config)
    spec = emulator_plan(config).training[0]
    torque = read_run(spec, config.dataset.root).figures["torque"]
    assert torque.shape == (spec.scene.frame_count, 1)
    assert np.nanmean(torque) > 0.0, "the drum lifts the bed"
    assert summary["statistics"]["averages"]["shared"]["torque"]["error"] > 0.0
    assert load_emulator(identify(config).folder / "model.pt").columns["torque"] == slice(27, 28)


def test_a_finished_experiment_is_not_done_again_and_its_model_is_read(finished, monkeypatch):
    config, summary = finished
    monkeypatch.setattr("gran_bench.run.emulation.make_emulator", None)
    assert run_experiment(config)["statistics"] == summary["statistics"]
    path = identify(config).folder / "model.pt"
    emulator = load_emulator(path)
    scene = replace(build_scene(config.scene), rotation=Rotation((0.4,), (30.0,)))
    assert np.isfinite(emulator.statistics(scene, np.zeros(2)).members).all()
    with pytest.raises(CheckpointError, match="steps no particles"):
        load_model(path)


def test_the_bed_that_most_training_runs_share_is_known_again(finished):
    config, _ = finished
    emulator, plan = load_emulator(identify(config).folder / "model.pt"), emulator_plan(config)
    shared, unseen = plan.judged[0], plan.judged[-1]
    assert (shared.unseen, unseen.unseen) == (False, True)
    known = INPUTS.index("known")
    for judged, expected in ((shared, 1.0), (unseen, 0.0)):
        for spec in judged.replicas:  # from nudged starts, too
            settled = read_run(spec, config.dataset.root).columns[0, :2]
            assert (emulator.inputs(spec.scene, settled)[:, known] == expected).all()
    assert (emulator.inputs(spec.scene, emulator.known.numpy() + np.array([0.0, 0.01]))[:, known] == 0.0).all()


def test_statistics_alone_are_kept_and_a_damaged_file_is_named(finished):
    config, _ = finished
    root = Path(config.dataset.root)
    spec = emulator_plan(config).training[0]
    assert not list(root.glob("*.h5")), "a trajectory was kept"
    path = run_path(spec, root)
    content = path.read_bytes()
    path.write_bytes(content[:-200])
    with pytest.raises(DatasetError, match=f"{path.name} cannot be read"):
        read_run(spec, root)
    path.unlink()
    ensure_runs([spec], root, workers=1, progress=False)
    assert read_run(spec, root).digest


def test_a_training_that_was_stopped_ends_with_the_same_weights(finished, tmp_path):
    config, _ = finished
    tracking = replace(config.tracking, root=str(tmp_path))
    short = replace(config, trainer=replace(config.trainer, minutes=1e-9), tracking=tracking)
    assert run_experiment(short)["training"]["steps"] < config.trainer.steps
    whole = replace(short, trainer=replace(short.trainer, minutes=None))
    run_experiment(whole)
    weights = [torch.load(identify(c).folder / "model.pt", weights_only=True)["weights"] for c in (config, whole)]
    assert identify(config).key == identify(whole).key
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])
