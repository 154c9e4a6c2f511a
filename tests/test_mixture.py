"""Training on several scenes: shares by stage, scenes at the size of the run's spheres, and no held-out speed."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gran_bench.compose import checked_config, compose
from gran_bench.config import RolloutConfig, TrainConfig
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import Split
from gran_bench.dataset.mixture import Mixture
from gran_bench.run.cost import training_cost
from gran_bench.run.further_scenes import of_the_same_spheres
from gran_bench.run.going_on import Parent, _bent_by
from gran_bench.run.identity import judging_plan, splits
from gran_bench.run.start_from import seen_elsewhere
from gran_bench.scene import build_scene
from gran_bench.shipped import shipped_scene, shipped_scene_config
from gran_bench.trainer import work_of_updates


def train_config(*overrides: str) -> TrainConfig:
    return checked_config(compose("train", list(overrides)), TrainConfig)


@pytest.fixture(scope="module")
def split() -> Split:
    return splits(train_config("model=ccnn", "mixture=growing"))


def names(mixture: Mixture, split: Split, progress: float, draws: int = 2000) -> dict[str, float]:
    """Share of each scene among drawn cases."""
    drawn = [mixture.draw(np.random.default_rng((1, k)), progress) for k in range(draws)]
    found = [split.training[case].scene.name for case in drawn]
    return {name: found.count(name) / draws for name in dict.fromkeys(sorted(found))}


def test_a_scene_has_its_share_of_the_windows_in_each_stage(split: Split):
    mixture = Mixture(split.training, [[0.0, 3.0, 1.0], [1.0, 1.0, 0.0]], [0.5])
    early, late = names(mixture, split, 0.49), names(mixture, split, 0.5)
    assert early == pytest.approx({"drum_short": 0.75, "drum_slice": 0.25}, abs=0.03)
    assert late == pytest.approx({"drum": 0.5, "drum_short": 0.5}, abs=0.03)
    assert names(Mixture(split.training), split, 0.0) == pytest.approx(
        {"drum": 1 / 3, "drum_short": 1 / 3, "drum_slice": 1 / 3}, abs=0.04
    )


def test_every_speed_of_a_scene_is_as_likely(split: Split):
    mixture, rng = Mixture(split.training, [[0.0, 1.0, 0.0]]), np.random.default_rng(0)
    drawn = [split.training[mixture.draw(rng, 1.0)].scene.rotation.speeds_rpm[0] for _ in range(3000)]
    assert {speed: drawn.count(speed) / 3000 for speed in set(drawn)} == pytest.approx(
        dict.fromkeys((20.0, 25.0, 35.0, 40.0, 50.0, 60.0), 1 / 6), abs=0.03
    )


def test_an_update_on_small_scenes_counts_by_their_spheres(split: Split):
    mixture = Mixture(split.training, [[0.0, 1.0, 1.0], [1.0, 0.0, 0.0]], [0.5])
    assert mixture.size(0.0) == pytest.approx((750 + 600) / 2 / 3000)
    assert mixture.size(1.0) == 1.0
    work = work_of_updates(RolloutConfig(frames=1, final_frames=3, final_from=0.75), 4, mixture)
    assert work == pytest.approx([0.225, 0.225, 1.0, 3.0])


def test_the_cost_says_which_scenes_and_counts_their_spheres(monkeypatch: pytest.MonkeyPatch):
    import gran_bench.run.cost as costs

    for name in ("rollout_pace", "update_pace", "summary_pace"):
        monkeypatch.setattr(costs, name, lambda *_: 0.1)
    small = train_config("model=ccnn", "mixture=slice", "rollout=frames1", "trainer.steps=100", "trainer.minutes=null")
    plain = replace(small, trainer=replace(small.trainer, mixture=train_config().trainer.mixture))
    found = [training_cost(each, judging_plan(each), splits(each).training) for each in (small, plain)]
    assert [cost.seconds["training"] for cost in found] == pytest.approx([2.0, 10.0])
    assert "; windows of drum, drum_slice" in found[0].lines[0]
    assert "windows of drum" not in found[1].lines[0]


def test_further_scenes_of_the_same_spheres_are_the_shipped_ones(split: Split):
    assert split.training[6].scene == shipped_scene("drum_short").at_speed(20.0)


def test_a_further_scene_is_made_of_the_runs_spheres():
    own = train_config("scene.filling.diameter=0.0125", "scene.frame_interval=0.005").scene
    own.container.diameter, own.container.length, own.material.friction = 0.25, 0.25, 0.4
    further = build_scene(of_the_same_spheres(shipped_scene_config("drum_short"), own))
    assert (further.drum_radius, further.length) == (0.125, 0.0625)
    assert (further.filling.diameter, further.filling.count) == (0.0125, 750)
    assert (further.material.friction, further.frame_interval, further.frame_count) == (0.4, 0.005, 401)
    box = build_scene(of_the_same_spheres(shipped_scene_config("packing"), own))
    assert box.room.upper[2] == 0.375


def test_training_sees_no_held_out_speed_in_any_scene():
    split = splits(
        train_config(
            "model=ccnn", "dataset=choose35", "mixture=growing", "trainer.mixture.scenes=[drum_short,drum_small]"
        )
    )
    hidden = {30.0, 35.0}
    assert len(split.training) == 15
    assert not [spec.label for spec in split.training if {*spec.scene.rotation.speeds_rpm} & hidden]
    assert [spec.scene.name for spec in (*split.validation, *split.holdout)] == ["drum", "drum"]


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["trainer.mixture.scenes=[drum_ramp]"], "drum_ramp turns at 30 rpm, which no training may see"),
        (["trainer.mixture.scenes=[drum_smal]"], "drum_smal"),
        (["trainer.mixture.scenes=[collision]"], "collision has spheres of its own"),
    ],
)
def test_a_further_scene_that_cannot_be_is_refused_before_any_work(overrides: list[str], words: str):
    with pytest.raises(ConfigError, match=words):
        splits(train_config(*overrides))


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["mixture=slice", "trainer.mixture.speeds_rpm=[25,-30]"], "has -30 rpm, which is held out"),
        (["trainer.mixture.speeds_rpm=[25]"], "has no further scene"),
        (["trainer.mixture.scenes=[drum_slice,drum_slice]"], "a scene twice"),
        (["trainer.mixture.scenes=[drum]"], "the run's own scene.name=drum"),
        (["mixture=slice", "trainer.mixture.shares=[[1]]"], "does not give 2 numbers"),
        (["mixture=slice", "trainer.mixture.shares=[[0,0]]"], "does not give 2 numbers, not all 0"),
        (["mixture=growing", "trainer.mixture.until=[]"], "does not give 1 rising numbers"),
        (["mixture=slice", "trainer.mixture.until=[0.5]"], "does not give 0 rising numbers"),
        (["mixture=slice", "dataset=imported"], "is for cases that this DEM makes"),
        (["model=contact", "rollout.rotation=true"], "for networks that see none, and not for model=contact"),
    ],
)
def test_a_mixture_that_contradicts_itself_is_refused(overrides: list[str], words: str):
    with pytest.raises(ConfigError) as refused:
        train_config(*overrides)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_model_says_which_scenes_and_speeds_it_has_seen():
    assert seen_elsewhere(train_config()) == {}
    said = seen_elsewhere(train_config("mixture=slice", "trainer.mixture.speeds_rpm=[33]"))
    assert json.loads(json.dumps(said)) == {
        "further_scenes": ["drum_slice"],
        "seen_speeds_rpm": [20.0, 25.0, 33.0, 35.0, 40.0, 50.0, 60.0],
    }


def test_stages_bend_the_updates_of_a_shorter_training_only_where_they_differ():
    config = train_config("model=ccnn", "mixture=growing", "optim.schedule=constant", "rollout=frames1")
    config.trainer.steps = 1000
    assert _bent_by(config, Parent(300, 500, Path("a"))) == []  # the first stage of 500 updates ends at 300
    assert _bent_by(config, Parent(500, 500, Path("a"))) == ["trainer.mixture.until"]
