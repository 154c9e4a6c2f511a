"""Budgets of updates and of time: what the clock cuts is said, and the learning rate gets to its end."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import pytest
from trainings import FakeWindows, Network, config, same, train

from gran_bench.config import (
    OptimConfig,
    RolloutConfig,
    TrainerConfig,
)
from gran_bench.trainer import (
    Trainer,
    learning_rate,
)

# ---- a budget of steps that the clock cuts -------------------------------------------------------------------


def paced(folder, seconds_a_frame, monkeypatch, **settings):
    """A training on a clock that each update sets forward by a time for each frame that it looks ahead.

    Args:
        seconds_a_frame: of an update by its number.

    Returns:
        What it did, the trainer, and what it said of the clock, with the update after which it said so.
    """
    now, said, original = [0.0], [], Trainer.update

    def update(self, pool):
        metrics = original(self, pool)
        now[0] += metrics["frames_ahead"] * seconds_a_frame(self.step)
        return metrics

    folder.mkdir(exist_ok=True)
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "update", update)
        patch.setattr("gran_bench.trainer.trainer.time", SimpleNamespace(monotonic=lambda: now[0]))
        trainer = Trainer(
            Network(), FakeWindows(), config(**settings), folder, warn=lambda line: said.append((trainer.step, line))
        )
        return trainer.run(progress=False), trainer, said


def test_a_budget_of_steps_that_will_not_fit_is_said_at_the_first_updates_and_at_the_end(tmp_path, monkeypatch):
    trainer_config = TrainerConfig(steps=100, minutes=1.0, log_every=5)
    optim = OptimConfig(learning_rate=1e-2, final_learning_rate=1e-4, schedule="cosine", accumulate=1)
    result, _, said = paced(
        tmp_path, lambda step: 1.5, monkeypatch, trainer=trainer_config, optim=optim, rollout=RolloutConfig(frames=1)
    )
    ((step, line),) = said
    assert step == 5
    assert line.startswith("at this pace 41 of 100 updates fit in 1 minutes,")
    assert line.endswith("raise trainer.minutes to 3 or lower trainer.steps")
    assert (result.stopped_by, result.steps, result.planned_steps) == ("time", 41, 100)
    assert result.learning_rate == learning_rate(optim, 40, 100) > 5e-3


def test_longer_rollouts_to_come_are_counted_in(tmp_path, monkeypatch):
    rollout = RolloutConfig(frames=1, final_frames=3, final_from=0.5)
    trainer = TrainerConfig(steps=40, minutes=1.0, log_every=2)
    # 20 updates of 1 frame and 20 of 3 are 80 s; the first alone would be 40 s.
    result, _, said = paced(tmp_path, lambda step: 1.0, monkeypatch, trainer=trainer, rollout=rollout)
    ((step, line),) = said
    assert step == 2
    assert line.startswith(f"at this pace {result.steps} of 40 updates fit in 1 minutes")


def test_a_machine_that_gets_busy_later_is_said_when_it_shows(tmp_path, monkeypatch):
    trainer = TrainerConfig(steps=40, minutes=1.0, log_every=2)
    result, _, said = paced(
        tmp_path, lambda step: 1.0 if step < 20 else 5.0, monkeypatch, trainer=trainer, rollout=RolloutConfig(frames=1)
    )
    ((step, _),) = said
    assert 20 <= step < result.steps < 40


def test_a_cap_that_does_not_cut_says_nothing_and_changes_no_bit(tmp_path, monkeypatch):
    free, _ = train(tmp_path / "free")
    cap = replace(config().trainer, minutes=1.0, log_every=2)
    result, capped, said = paced(tmp_path / "capped", lambda step: 1.0, monkeypatch, trainer=cap)
    assert said == []
    assert (result.stopped_by, result.planned_steps) == ("steps", result.steps)
    assert same(free.final_weights(), capped.final_weights())


def test_a_budget_of_time_is_no_budget_of_steps_that_was_cut(tmp_path):
    trainer = TrainerConfig(budget="time", steps=10**6, minutes=0.001)
    train(tmp_path / "run", trainer=trainer)
    again = Trainer(Network(), FakeWindows(), config(trainer=trainer), tmp_path / "run").run(progress=False)
    assert again.stopped_by == "time"
    assert again.planned_steps is None


# ---- a budget of time ----------------------------------------------------------------------------------------


class Clock:
    """Processor and wall time that go on by a second at each look; every second look is the end of an update."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 0.5
        return self.now


def test_a_budget_of_time_takes_the_learning_rate_to_its_end_and_a_resume_goes_on_with_what_was_spent(
    tmp_path, monkeypatch
):
    clock = Clock()
    monkeypatch.setattr("gran_bench.trainer.trainer.time.process_time", clock)
    optim = OptimConfig(learning_rate=1e-2, final_learning_rate=1e-4, schedule="cosine", accumulate=1)
    rollout = RolloutConfig(frames=1, final_frames=2, final_from=0.5)

    def part(minutes: float) -> tuple[Trainer, list]:
        trainer = TrainerConfig(budget="time", steps=10**6, minutes=minutes, log_every=1, checkpoint_steps=1)
        return train(tmp_path / "run", optim=optim, rollout=rollout, trainer=trainer)

    whole, logged = part(minutes=10.0 / 60.0)
    assert whole.spent >= 10.0
    assert whole.step == len(logged) < 30
    rates = [metrics["learning_rate"] for _, metrics in logged]
    assert rates[0] == pytest.approx(1e-2)
    assert all(later <= earlier for earlier, later in itertools.pairwise(rates))
    assert rates[-1] < 5e-4
    halves = [metrics["frames_ahead"] for _, metrics in logged]
    assert halves[0] == 1
    assert halves[-1] == 2
    # Killed after its last checkpoint, it has nothing left to spend; with twice the budget it is in the middle.
    again, more = part(minutes=10.0 / 60.0)
    assert (again.step, more) == (whole.step, [])
    again, more = part(minutes=20.0 / 60.0)
    assert again.spent >= 20.0
    assert more[0][1]["learning_rate"] == pytest.approx(learning_rate(optim, 1, 2), rel=0.15)
