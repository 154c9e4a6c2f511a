"""A scene that takes no speeds: some packings train, another is held out, rolled out and judged, from data to page."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gran_bench.benchmark.contest import why_unfit
from gran_bench.compose import checked_config, compose
from gran_bench.config import DatasetConfig, DemConfig, EvaluateConfig, GenerateConfig, TrainConfig
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import Case, DatasetError, Windows, generate, read_case, split_cases
from gran_bench.dem.outlet import taking_part
from gran_bench.metrics import summarise
from gran_bench.report.result_page import write_page
from gran_bench.run.experiment import run_evaluation, run_experiment
from gran_bench.run.identity import judging_plan, splits
from gran_bench.run.pace import NO_CONTACT
from gran_bench.run.start_from import refuse_unfair
from gran_bench.run.summary import description, headline, summary_table
from gran_bench.scene import build_scene
from gran_bench.shipped import shipped_scene
from gran_bench.state import Trajectory
from gran_bench.surrogate.checkpoint import load_card
from gran_bench.trainer import Trainer
from gran_bench.trainer.start import make_model, training_windows

SMALL = [
    *("trainer.steps=3", "trainer.log_every=1", "model.width=4", "model.layers=1", "optim.accumulate=1", "threads=1"),
    *("dataset.training_packings=[7,8]", "dataset.replicas=2", "dataset.workers=1", "judge.short_horizon_starts=2"),
    *("judge.gif=false", "tracking.enabled=false", "device=cpu"),
]
SCENES = {
    "xu_shen2022_packing": [
        *("scene.filling.count=12", "scene.container.width=0.15", "scene.container.length=0.15", "scene.end_time=0.6"),
    ],
    "lu2021_hopper": [
        *("scene.filling.count=40", "scene.container.diameter=0.12", "scene.container.orifice=0.09"),
        *("scene.container.height=0.3", "scene.container.outlet_depth=0.02", "scene.end_time=1.7"),
    ],
}


def config_of(recipe: str, root: Path, *changes: str) -> TrainConfig:
    places = [f"dataset.root={root}/data", f"tracking.root={root}/results"]
    composed = compose("train", [f"+experiment={recipe}", *SMALL, *SCENES[recipe], *places, *changes])
    return checked_config(composed, TrainConfig)


@pytest.fixture(scope="module", params=SCENES)
def finished(request, tmp_path_factory):
    """A recipe's tiny run: its config, its summary and its folder."""
    config = config_of(request.param, tmp_path_factory.mktemp(request.param))
    summary = run_experiment(config)
    (folder,) = Path(config.tracking.root, "runs").iterdir()
    return config, summary, folder


def test_some_packings_train_and_another_is_held_out_and_judged(finished):
    config, summary, folder = finished
    split, plan = splits(config), judging_plan(config)
    assert [spec.packing_seed for spec in split.training] == [7, 8]
    assert [spec.packing_seed for spec in split.holdout] == [0]
    assert split.validation == []
    seen = training_windows(config, split).cases
    assert [case.attributes["packing_seed"] for case in seen] == [7, 8]
    assert {spec.packing_seed for spec in plan.cases} == {0, 1}
    assert (plan.judged_rpm, plan.validates, plan.replayed_rpm) == (None, False, [])
    training, (card, _) = summary["training"], load_card(folder / "model.pt")
    assert training["training_packings"] == card.origin["training_packings"] == [7, 8]
    assert training["training_speeds_rpm"] == []
    assert training["steps"] == 3


def test_it_is_judged_by_what_the_scene_is_for(finished):
    config, summary, folder = finished
    own = {"packing": "packing_fraction", "hopper_small": "discharge_rate"}[config.scene.name]
    assert summary["judged_rpm"] is None
    assert list(summary["rollouts"]) == ["own_motion"]
    judged, figures = summary["judged"]["shared"], headline(summary)
    assert judged["requirements"]["center_height"]["verdict"] in ("pass", "fail")
    assert judged["errors"][own]["valid"] or own == "packing_fraction"  # which needs a bed at rest
    assert not judged["errors"]["surface_angle"]["valid"]
    assert {"height error m", "speed W1 m per s"} <= set(figures)
    assert not [name for name in figures if "angle" in name]
    assert summary["nearest_case"] == {}
    shown = summary_table(summary)
    assert "own motion, held out, first packing" in shown
    assert "tells speeds apart" not in shown
    assert "height of the centre of mass" in shown
    assert "bed at rest" in summary["baselines"]
    assert "angle" not in description(summary, folder, [], None)
    drawn = {path.name for path in (folder / "figures").iterdir()}
    assert {"purpose.png", "flow_pattern.png", "loss.png"} <= drawn
    assert not drawn & {"angle_of_repose.png", "nearest_case.png"}


def test_it_becomes_a_page(finished, tmp_path):
    text = write_page(finished[2], tmp_path / "page", "").read_text("utf-8")
    assert "judged at own motion, held out" in text
    assert "| baseline, first packing | height |" in text
    assert "(figures/purpose.png)" in text


def test_the_finished_run_is_found_again_and_its_model_file_is_judged_alone(finished):
    config, summary, folder = finished
    assert run_experiment(config)["judged"] == json.loads(json.dumps(summary["judged"]))
    changes = [f"checkpoint={folder / 'model.pt'}", f"tracking.root={config.tracking.root}", "device=cpu"]
    changes += [f"dataset.root={config.dataset.root}", "dataset.replicas=2", "judge.unseen_packing=false"]
    changes += ["judge.short_horizon_starts=2", "judge.gif=false", "tracking.enabled=false", "dataset.workers=1"]
    again = run_evaluation(checked_config(compose("evaluate", changes), EvaluateConfig))
    assert again["judged"]["shared"]["errors"] == summary["judged"]["shared"]["errors"]


def test_no_model_is_judged_on_a_packing_that_it_saw(finished):
    config, _, folder = finished
    card, _ = load_card(folder / "model.pt")
    seen = EvaluateConfig(checkpoint="x", dataset=replace(config.dataset, packing_seed=8, training_packings=[]))
    with pytest.raises(ConfigError, match=r"dataset\.packing_seed=8: m was trained on that packing"):
        refuse_unfair(seen, card.origin, "m")
    second = replace(seen, dataset=replace(seen.dataset, packing_seed=0, unseen_packing_seed=7))
    with pytest.raises(ConfigError, match=r"dataset\.unseen_packing_seed=7: m was trained on that packing"):
        refuse_unfair(second, card.origin, "m")
    scene = build_scene(config.scene)
    assert why_unfit(card, scene, 7) == "it was trained on packing 7"
    assert why_unfit(card, scene, 1) == ""


def test_generate_makes_the_packings_that_train_and_the_one_that_is_judged(tmp_path, capsys):
    config = config_of("xu_shen2022_packing", tmp_path)
    paths = generate(GenerateConfig(scene=config.scene, dem=config.dem, dataset=config.dataset))
    assert sorted(read_case(path).attributes["packing_seed"] for path in paths) == [0, 7, 8]
    said = capsys.readouterr().out
    assert "still, packing 7" in said
    assert said.count("training") == 2
    assert "holdout" in said


@pytest.mark.parametrize(
    ("recipe", "change", "words"),
    [
        ("lu2021_hopper", "dataset.training_packings=[]", "leaves nothing to train on; give seeds"),
        ("lu2021_hopper", "dataset.training_packings=[0,2]", "has 0, which is dataset.packing_seed"),
        ("lu2021_hopper", "dataset.training_packings=[1,2]", "has 1, which is dataset.unseen_packing_seed"),
        ("lu2021_hopper", "dataset.training_packings=[2,2]", "has 2 twice"),
        ("lu2021_hopper", "dataset.training_packings=[-1]", r"training_packings\[0\]=-1 is impossible"),
        ("lu2021_hopper", "judge.speeds_rpm=[30]", "choose judge.speeds_rpm=null"),
        ("lu2021_hopper", "boundary=spheres", "has a static boundary"),
        ("lu2021_hopper", "boundary=analytic", "static points"),
        ("xu_shen2022_packing", "scene.filling.sizes.kind=uniform", "train on equal spheres"),
    ],
)
def test_what_no_training_on_packings_can_be_is_refused_in_a_sentence(recipe, change, words, tmp_path):
    with pytest.raises(ConfigError, match=words):
        config_of(recipe, tmp_path, change)


def test_the_packings_of_a_drum_are_refused_and_a_scene_without_any_has_no_splits():
    with pytest.raises(ConfigError, match="the cases of a drum are its speeds, all from one packing"):
        checked_config(compose("train", ["dataset.training_packings=[3]"]), TrainConfig)
    with pytest.raises(DatasetError, match=r"give dataset\.training_packings, or choose a drum"):
        split_cases(shipped_scene("hopper"), DemConfig(), DatasetConfig())


def discharge() -> tuple[Trajectory, Trajectory]:
    """Two spheres in a hopper, one of which falls through the outlet: of the DEM, and of a model of mean velocities."""
    scene, frames = shipped_scene("hopper"), 30
    step, time = scene.frame_interval, scene.start_time + scene.frame_interval * np.arange(frames)
    position, velocity = np.zeros((frames, 2, 3)), np.zeros((frames, 2, 3))
    position[:, 1, 2], position[0, 0, 2], velocity[0, 0, 2] = 0.3, 0.05, -1.0
    for k in range(1, frames):
        position[k], velocity[k] = position[k - 1], velocity[k - 1]
        if taking_part(scene, position[k - 1])[0]:
            velocity[k, 0, 2] -= 9.81 * step
            position[k, 0, 2] += step * velocity[k, 0, 2]
    single = position.astype(np.float32), velocity.astype(np.float32)
    dem = Trajectory(time, *single, np.zeros_like(single[0]), np.full(2, 0.01))
    return dem, Trajectory(time, *single, None, np.full(2, 0.01), velocity_kind="mean")


def test_a_discharged_sphere_keeps_its_speed_in_the_dem_and_in_a_rollout_of_mean_velocities():
    scene = shipped_scene("hopper")
    dem, model = discharge()
    truth, found = summarise(dem, scene, "mean"), summarise(model, scene)
    assert truth.sorted_speed[-1].tolist() == pytest.approx([0.0, abs(model.velocity[-1, 0, 2])], rel=1e-4)
    np.testing.assert_allclose(truth.sorted_speed, found.sorted_speed, rtol=1e-4, atol=1e-6)
    assert truth.jump < 1e-6
    assert found.jump < 1e-4


def test_a_hopper_that_has_run_empty_teaches_nothing(tmp_path):
    config = config_of("lu2021_hopper", tmp_path)
    scene = build_scene(config.scene)
    time = scene.start_time + scene.frame_interval * np.arange(scene.frame_count)
    position = np.full((scene.frame_count, 40, 3), -1.0, np.float32)
    still, nothing = np.zeros_like(position), {name: np.zeros(scene.frame_count) for name in NO_CONTACT}
    motion = Trajectory(time, position, still, still, np.full(40, 0.01), diagnostics=nothing)
    case = Case(scene, motion, scene.fresh_filling(0), {}, "", Path("sample"))
    trainer = Trainer(make_model(config, scene), Windows([case]), config, tmp_path)
    with ThreadPoolExecutor(1) as pool:
        assert trainer.update(pool)["gradient_norm"] == 0.0
