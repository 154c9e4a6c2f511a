"""Which keys of a config decide the weights of a training: they give a run its key."""

from __future__ import annotations

import pytest

from gran_bench.compose import checked_config, compose
from gran_bench.config import TrainConfig
from gran_bench.config.identity import UNDECIDING, deciding_keys
from gran_bench.config.reading import dotted_keys


def train_config(*overrides: str) -> TrainConfig:
    return checked_config(compose("train", overrides), TrainConfig)


@pytest.mark.parametrize(
    "override",
    [
        *("judge.speeds_rpm=[30]", "tracking.sweep=x", "judge.gif=false", "tracking.root=/else"),
        *("dataset.root=x", "dataset.workers=1", "dataset.replicas=3", "dataset.unseen_packing_seed=2"),
        *("trainer.minutes=3", "trainer.checkpoint_every=1", "trainer.checkpoint_steps=1", "trainer.log_every=1"),
    ],
)
def test_a_key_that_leaves_the_weights_as_they_are_is_not_among_those_that_decide(override):
    assert deciding_keys(train_config(override)) == deciding_keys(train_config())


@pytest.mark.parametrize(
    "override",
    [
        *("seed=1", "device=cpu", "threads=1", "model.iterations=4", "loss.spin=0.1", "rollout.noise_diameters=0"),
        *("rollout.growth=linear", "optim.accumulate=3", "trainer.budget=time", "trainer.start_from=shipped"),
        *("trainer.steps=10", "trainer.startup_fraction=0", "dataset.packing_seed=3", "dem.time_step=1e-4"),
        *("dataset.training_speeds_rpm=[20]", "scene.material.friction=0.4", "model=ccnn"),
    ],
)
def test_a_key_that_changes_the_weights_decides(override):
    assert deciding_keys(train_config(override, "judge.speeds_rpm=[]")) != deciding_keys(train_config())


def test_walls_decide_where_the_model_looks_at_them():
    assert "boundary" not in deciding_keys(train_config())
    seen, unseen = (deciding_keys(train_config("model=ccnn", f"boundary={kind}")) for kind in ("spheres", "none"))
    assert seen != unseen


def test_a_cap_of_minutes_decides_nothing_and_a_budget_of_minutes_does():
    one, two = (deciding_keys(train_config("trainer.budget=time", f"trainer.minutes={m}")) for m in (1, 2))
    assert one != two


def test_every_undeciding_key_is_a_key():
    assert set(dotted_keys(TrainConfig)) >= UNDECIDING
