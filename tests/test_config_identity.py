"""Which keys of a config tell two trainings apart: those that decide their weights, unless others switch them off."""

from __future__ import annotations

import json

import pytest

from gran_bench.compose import Source, checked_config, compose, described_jobs
from gran_bench.config import TrainConfig
from gran_bench.config.identity import telling_keys


@pytest.mark.parametrize(
    ("switched_off", "changes"),
    [
        ("loss.frame_weights=rising", ["rollout.frames=1"]),
        ("loss.spin_frame_weights=rising", ["loss.spin=0"]),
        ("loss.spin_frame_weights=rising", ["loss.spin=1", "rollout.frames=1"]),
        ("loss.discount=0.5", ["loss.frame_weights=inverse"]),
        ("loss.discount=0.5", ["loss.frame_weights=discounted", "rollout.frames=1"]),
        ("rollout.gradient_through_time=false", ["rollout.frames=1"]),
        ("rollout.final_from=0.3", ["rollout.final_frames=null"]),
        ("rollout.growth=linear", ["rollout.frames=2", "rollout.final_frames=2"]),
        ("rollout.independent_noise=false", ["rollout.noise=0"]),
        ("optim.decay_steps=4", ["optim.schedule=cosine"]),
        ("optim.final_learning_rate=1e-5", ["optim.schedule=constant"]),
        ("trainer.startup_seconds=0.5", ["trainer.startup_fraction=0"]),
    ],
)
def test_a_key_that_others_switch_off_tells_no_two_runs_apart(switched_off, changes):
    switched_on = [
        *("rollout.frames=2", "rollout.final_frames=3", "rollout.noise=1e-4", "rollout.independent_noise=true"),
        *("loss.spin=1", "loss.frame_weights=discounted", "optim.schedule=steps", "trainer.startup_fraction=0.5"),
    ]

    def told(*overrides: str) -> dict:
        composed = compose("train", ["+experiment=smoke", "model=contact", "rollout=contact", *overrides])
        return telling_keys(checked_config(composed, TrainConfig))

    growth = ["rollout.final_frames=null"] if "rollout.frames=1" in changes else []
    assert told(*switched_on, *growth, *changes, switched_off) == told(*switched_on, *growth, *changes)
    assert told(*switched_on, switched_off) != told(*switched_on)


@pytest.mark.parametrize("name", ["sweep_loss", "sweep_rollout", "sweep_radius", "sweep_boundary"])
def test_no_two_jobs_of_a_shipped_sweep_are_one_run(name):
    jobs = described_jobs(Source("train"), [f"+experiment={name}"], multirun=True).jobs
    configs = [checked_config(composed, TrainConfig) for _, composed in jobs]
    keys = [json.dumps(telling_keys(config), sort_keys=True) for config in configs]
    assert len(set(keys)) == len(keys)
