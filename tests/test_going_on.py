"""A training that goes on from a finished one, or starts from its weights: its bits, its key, its words, refusals."""

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import stored_runs
import torch
from beds import flowing
from finished_runs import SCENE, summary_of
from stored_runs import only_run

from gran_bench.config import (
    BoundaryConfig,
    CconvModelConfig,
    ContactModelConfig,
    ContainerConfig,
    DatasetConfig,
    EvaluateConfig,
    FillingConfig,
    JudgeConfig,
    OptimConfig,
    RolloutConfig,
    SceneConfig,
    TrackingConfig,
    TrainConfig,
    TrainerConfig,
)
from gran_bench.config.rules import ConfigError
from gran_bench.run import experiment
from gran_bench.run.experiment import experiment_cost, run_evaluation, run_experiment
from gran_bench.run.identity import identify
from gran_bench.run.summary import description, record_judgement, summary_table
from gran_bench.surrogate.checkpoint import ModelCard, load_card, save_model
from gran_bench.sweep.opening import open_sweep
from gran_bench.sweep.runs import SweepJob
from gran_bench.trainer import Trainer

template = stored_runs.template
MADE = summary_of(flowing(SCENE, seed=3), flowing(SCENE, seed=4))  # what the judge says, which is not tested here


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture
def job(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., TrainConfig]:
    """The config of a tiny training without schedule, with other values of dotted keys; nothing is judged."""

    def judged(record, model, plan, card, training, run) -> dict[str, Any]:
        summary = MADE | {"experiment": "tiny", "provenance": {}, "training": training}
        record_judgement(run, summary, record.identity.folder, [])
        return summary

    def changed(**changes: Any) -> TrainConfig:
        config = TrainConfig(
            experiment="tiny",
            device="cpu",
            threads=1,
            scene=SceneConfig(
                name="drum_tiny",
                container=ContainerConfig(diameter=0.4, length=0.2, periodic_axis=True),
                filling=FillingConfig(count=40),
                start_time=0.4,
                end_time=0.6,
            ),
            dataset=DatasetConfig(
                root=str(data), training_speeds_rpm=[25.0, 35.0], holdout_speeds_rpm=[30.0], workers=1
            ),
            model=ContactModelConfig(iterations=2, memory=True),
            rollout=RolloutConfig(frames=2, noise_m=1e-4),
            optim=OptimConfig(schedule="constant", learning_rate=1e-3, accumulate=2, weight_average=0.9),
            trainer=TrainerConfig(steps=4, log_every=1, checkpoint_steps=1),
            judge=JudgeConfig(speeds_rpm=[30.0], unseen_packing=False),
            tracking=TrackingConfig(enabled=False, root=str(tmp_path / "results")),
        )
        for key, value in changes.items():
            *sections, name = key.split("__")
            section = config
            for part in sections:
                section = getattr(section, part)
            setattr(section, name, value)
        return config

    monkeypatch.setattr(experiment, "judge_stage", judged)
    return changed


def trained(config: TrainConfig) -> tuple[Path, dict[str, Any]]:
    """Run a config; its folder, and what its training says."""
    training = run_experiment(config)["training"]
    return identify(config).folder, training


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return load_card(folder / "model.pt")[1]


def same(one: Path, other: Path) -> bool:
    ours, theirs = weights(one), weights(other)
    return all(torch.equal(ours[name], theirs[name]) for name in theirs)


def losses(folder: Path) -> pd.DataFrame:
    return pd.read_csv(folder / "losses.csv").drop(columns="seconds")


class Killed(BaseException):
    """As if by ``kill -9``: nothing handles it."""


def kill_at(step: int, config: TrainConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    original = Trainer.update

    def update(self, pool):
        if self.step == step:
            raise Killed
        return original(self, pool)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "update", update)
        with pytest.raises(Killed):
            run_experiment(config)


# ---- more steps ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("killed", [False, True])
def test_more_steps_go_on_from_the_longest_finished_run_and_end_with_the_bits_of_a_run_from_the_start(
    job, tmp_path, monkeypatch, capfd, killed
):
    for steps in (2, 4):
        parent, training = trained(job(trainer__steps=steps, trainer__checkpoint_steps=3, trainer__minutes=9.0))
        assert training.get("parent_run") == (None if steps == 2 else identify(job(trainer__steps=2)).folder.name)
    longer = job(trainer__steps=8)
    if killed:
        kill_at(4, longer, monkeypatch)  # before its first checkpoint
        kill_at(6, longer, monkeypatch)
    left = f"training: contact, {2 if killed else 4} updates after {6 if killed else 4}, "
    assert left in "\n".join(experiment_cost(longer).lines)
    capfd.readouterr()
    child, training = trained(longer)
    assert f"training goes on from update {6 if killed else 4} of 8" in capfd.readouterr().err
    assert (training["parent_run"], training["parent_steps"], training["steps"]) == (parent.name, 4, 8)
    assert child != parent
    assert json.loads((parent / "training.json").read_text())["steps"] == 4  # which stays as it is
    whole, alone = trained(job(trainer__steps=8, tracking__root=str(tmp_path / "other")))
    assert whole.name == child.name
    assert "parent_run" not in alone
    assert same(child, whole)
    assert losses(child).equals(losses(whole))


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"optim__schedule": "cosine"}, "optim.schedule=cosine"),
        ({"rollout__final_frames": 3}, "rollout.final_frames=3"),
        ({"rollout__final_frames": 3, "rollout__final_from": 0.0}, None),
        ({"optim__warmup_steps": 3}, None),
        ({"optim__schedule": "cosine", "optim__final_learning_rate": 1e-3}, None),  # a cosine between equal rates
    ],
)
def test_going_on_is_refused_where_the_schedule_runs_through_the_budget(job, capfd, changes, key):
    parent, _ = trained(job(**changes))
    capfd.readouterr()
    child, training = trained(job(trainer__steps=6, **changes))
    said = capfd.readouterr().err
    if key is None:
        assert training["parent_run"] == parent.name
        return
    assert f"{parent.name}, the same training of 4 updates, is finished; this one starts from the beginning" in said
    assert f": {key} run through" in said.replace("runs", "run")
    assert f"trainer.start_from={parent.name}" in said
    assert "parent_run" not in training
    assert losses(child)["step"].tolist() == [1, 2, 3, 4, 5, 6]
    assert not losses(child).head(4).equals(losses(parent))


@pytest.mark.parametrize(
    "change", [{"seed": 1}, {"optim__learning_rate": 2e-3}, {"dataset__training_speeds_rpm": [25.0]}]
)
def test_nothing_goes_on_from_another_training_or_from_a_longer_one(job, change):
    trained(job(trainer__steps=5))
    assert "parent_run" not in trained(job(trainer__steps=6, **change))[1]
    assert "parent_run" not in trained(job(trainer__steps=3))[1]


def test_nothing_goes_on_from_damage_or_from_a_run_of_another_version(job, tmp_path, capfd):
    damaged, _ = trained(job(trainer__steps=3))
    unknown, _ = trained(job(trainer__steps=2))
    content = (damaged / "checkpoint.pt").read_bytes()
    (damaged / "checkpoint.pt").write_bytes(content[: len(content) // 2])
    (unknown / "config.json").write_text("{}")
    child, training = trained(job(trainer__steps=6))
    assert f"{damaged / 'checkpoint.pt'} is damaged" in capfd.readouterr().err
    assert "parent_run" not in training
    assert same(child, trained(job(trainer__steps=6, tracking__root=str(tmp_path / "other")))[0])


def test_more_minutes_go_on_too_where_the_budget_is_of_time(job):
    budget = {"trainer__budget": "time", "trainer__steps": 10**6}
    parent, first = trained(job(trainer__minutes=0.005, **budget))
    _, second = trained(job(trainer__minutes=0.01, **budget))
    assert (second["parent_run"], second["parent_steps"]) == (parent.name, first["steps"])
    assert second["steps"] > first["steps"]


def test_the_parent_is_in_the_summary_on_the_page_and_a_tag_of_the_run(job, template, request):
    tracking = TrackingConfig(experiment=request.node.name, root=str(template))
    parent, _ = trained(job(tracking__root=str(template)))
    child, _ = trained(job(trainer__steps=6, tracking=tracking))
    assert only_run(tracking).data.tags["parent_run"] == parent.name
    summary = json.loads((child / "summary.json").read_text())
    assert summary["training"]["parent_run"] == parent.name
    words = f"oes on from update 4 of {parent.name}"
    assert f"g{words}" in summary_table(summary)
    assert f"**G{words}.**" in description(summary, child, [], None)
    tuned = replace(tracking, experiment="tuned")
    trained(job(trainer__start_from=parent.name, tracking=tuned))
    assert only_run(tuned).data.tags["parent_run"] == parent.name


# ---- weights to start from -----------------------------------------------------------------------------------

OTHER = {"dataset__training_speeds_rpm": [40.0]}  # data that are others
STILL = {"optim__learning_rate": 1e-30, "optim__final_learning_rate": 1e-30, "optim__weight_average": 0.0}


def test_a_training_starts_from_the_weights_of_a_run_with_an_optimiser_of_its_own(job, tmp_path, monkeypatch):
    parent, _ = trained(job())
    tuned = job(trainer__start_from=parent.name, **OTHER, **STILL)
    folder, training = trained(tuned)
    assert same(folder, parent)  # updates that are too small to change a bit
    assert losses(folder)["step"].tolist() == [1, 2, 3, 4]
    assert training["parent_run"] == parent.name
    assert "parent_steps" not in training
    moved = job(trainer__start_from=parent.name, **OTHER)
    kill_at(3, moved, monkeypatch)
    again, _ = trained(moved)
    whole, _ = trained(replace(moved, tracking=replace(moved.tracking, root=str(tmp_path / "other")),
                               trainer=replace(moved.trainer, start_from=str(parent))))  # fmt: skip
    assert same(again, whole)
    assert not same(again, parent)
    assert not same(again, trained(job(**OTHER))[0])
    # And on from there, as from any other.
    _, training = trained(replace(moved, trainer=replace(moved.trainer, steps=6)))
    assert training["parent_run"] == again.name
    assert training["parent_weights"] == json.loads((again / "training.json").read_text())["parent_weights"]


def test_the_weights_decide_the_key_and_not_how_they_are_named(job, tmp_path):
    parent, _ = trained(job())
    copy = tmp_path / "mine.pt"
    save_model(copy, weights(parent), replace(load_card(parent / "model.pt")[0], origin={"steps": 1}))
    words = (parent.name, parent.name[-8:], str(parent), str(parent / "model.pt"), str(copy))
    keys = {identify(job(trainer__start_from=word, **OTHER)).key for word in words}
    assert len(keys) == 1
    other, _ = trained(job(seed=1))
    assert identify(job(trainer__start_from=other.name, **OTHER)).key not in keys
    assert identify(job(**OTHER)).key not in keys


def test_what_differs_from_the_training_of_the_weights_is_told(job, capfd):
    parent, _ = trained(job())
    capfd.readouterr()
    run_experiment(
        job(
            **OTHER,
            trainer__start_from=parent.name,
            scene__filling__diameter=0.04,
            scene__frame_interval=0.02,
            scene__material__friction=0.5,
            model__radius_diameters=1.15,
        )
    )
    told = [line for line in capfd.readouterr().err.split("\n") if "warning: " in line]
    for words in (
        "scene.filling.diameter=0.04, trained with 0.05",
        "scene.frame_interval=0.02, trained with 0.01",
        "scene.material.friction=0.5, trained with 0.3",
        "model.radius_diameters=1.15, trained with 1.2",
    ):
        assert sum(line.endswith(f": {words}") for line in told) == 1
    assert len(told) == 4


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"model__iterations": 3}, "another architecture (model.iterations=3, trained with 2); choose as there"),
        ({"model__memory": False}, "another architecture (model.memory=False, trained with True); choose as there"),
        ({"trainer__start_from": "holdout30rpm"}, "another architecture (model."),
        ({"trainer__start_from": "shipped"}, "another architecture (model."),
        (
            {"model": CconvModelConfig(), "boundary": BoundaryConfig()},
            "are of model=contact, and this training of ccnn; choose",
        ),
        ({"trainer__start_from": "paper"}, "paper has no model.pt (yet); finish its training"),
        ({"trainer__start_from": "tiny"}, "trainer.start_from=tiny: no run has this name, id or folder"),  # a beginning
        ({"trainer__start_from": "NOT"}, "NOT has no model.pt (yet)"),
        ({"trainer__start_from": "README.md"}, "README.md is not a whole gran-bench model file"),
        ({"dataset__holdout_speeds_rpm": [35.0], "judge__speeds_rpm": [35.0]}, "was trained on 35 rpm; judge another"),
        (
            {"judge__unseen_packing": True, "dataset__unseen_packing_seed": 0, "dataset__packing_seed": 1},
            "that packing",
        ),
    ],
)
def test_weights_that_do_not_fit_are_refused_before_any_work(job, tmp_path, monkeypatch, changes, said):
    parent, _ = trained(job())
    place = tmp_path / "NOT"
    place.mkdir()
    (place / "config.json").write_text("{}")
    (tmp_path / "README.md").write_text("no model")
    named = {"trainer__start_from": parent.name, "dataset__root": str(tmp_path / "none"), **OTHER} | changes
    if named["trainer__start_from"] in ("NOT", "README.md"):
        named["trainer__start_from"] = str(tmp_path / named["trainer__start_from"])
    config = job(**named)
    monkeypatch.setattr(experiment, "experiment_cost", lambda config: pytest.fail("the cost was told first"))
    with pytest.raises(ConfigError) as refused:
        run_experiment(config)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)
    with pytest.raises(ConfigError) as again, open_sweep([SweepJob("one", {}, 0, config=config)], "sweep"):
        pass
    assert str(again.value) == str(refused.value)
    assert not (tmp_path / "none").exists()


def test_what_the_weights_have_seen_is_not_judged_as_unseen(job, tmp_path):
    parent, _ = trained(job())
    folder, training = trained(job(trainer__start_from=parent.name, **OTHER))
    assert training["seen_speeds_rpm"] == [25.0, 35.0, 40.0]
    dataset = DatasetConfig(training_speeds_rpm=[30.0], holdout_speeds_rpm=[25.0])
    config = EvaluateConfig(str(folder / "model.pt"), "cpu", dataset=dataset, judge=JudgeConfig(speeds_rpm=[25.0]))
    with pytest.raises(ConfigError, match="this model was trained on 25 rpm"):
        run_evaluation(config)
    # Another scene is another flow, whose speeds count for it alone.
    other = job(trainer__start_from=folder.name, scene__material__friction=0.4, **OTHER)
    assert trained(other)[1]["seen_speeds_rpm"] == [40.0]


def test_a_card_of_a_plugin_that_is_gone_is_refused_by_the_name_of_its_model(job, tmp_path):
    parent, _ = trained(job())
    card = ModelCard({"name": "theirs"}, {}, asdict(job().scene), {})
    save_model(tmp_path / "theirs.pt", weights(parent), card)
    with pytest.raises(ConfigError, match="choose model=theirs, or train from the start"):
        run_experiment(job(trainer__start_from=str(tmp_path / "theirs.pt")))
