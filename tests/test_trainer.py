"""Training: bit-identical after any interruption, whatever the number of threads; budgets; divergence."""

import itertools
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from gran_bench.config import (
    BoundaryConfig,
    CconvModelConfig,
    ContactModelConfig,
    LossConfig,
    OptimConfig,
    RolloutConfig,
    SceneConfig,
    TrainConfig,
    TrainerConfig,
)
from gran_bench.scene import build_scene
from gran_bench.surrogate.checkpoint import CheckpointError
from gran_bench.surrogate.step import FrameState, Surrogate, build_model
from gran_bench.trainer import (
    CHECKPOINT,
    DIVERGED,
    Trainer,
    TrainingDiverged,
    TrainingStopped,
    frames_ahead,
    learning_rate,
)

SCENE = build_scene(SceneConfig(name="drum"))


class Network(Surrogate):
    """A small network of the velocity: enough to have several weights and a history through time."""

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        torch.manual_seed(seed)
        self.net = nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, 3))

    def forward(self, state: FrameState, scene, time: float) -> FrameState:
        velocity = state.velocity + self.net(state.velocity)
        return FrameState(state.position + scene.frame_interval * velocity, velocity)


@dataclass(frozen=True)
class FakeWindow:
    scene: object
    time: float
    position: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray
    mean_overlap: np.ndarray

    def velocity_at(self, k: int, kind: str) -> np.ndarray:
        return self.velocity[k]


class FakeWindows:
    """Spheres that lose a third of their velocity each frame; every draw is a function of its number."""

    def draw(self, draw: int, frames: int) -> FakeWindow:
        rng = np.random.default_rng((5, draw))
        start, speed = rng.normal(size=(2, 20, 3)).astype(np.float32)
        k = np.arange(frames + 1, dtype=np.float32)[:, None, None]
        velocity = speed * (2.0 / 3.0) ** k
        position = start + SCENE.frame_interval * (np.cumsum(velocity, axis=0) - velocity[0])
        return FakeWindow(SCENE, 1.5, position, velocity, velocity * 0, np.zeros(frames + 1))


class CrowdedWindows(FakeWindows):
    """The same in a box of half a metre, so that spheres have neighbours and walls."""

    def draw(self, draw: int, frames: int) -> FakeWindow:
        window = super().draw(draw, frames)
        crowd = np.random.default_rng((6, draw)).uniform(-0.25, 0.25, (frames + 1, 400, 3)).astype(np.float32)
        zeros = np.zeros_like(crowd)
        return replace(window, position=crowd - [0.0, 0.0, 0.2], velocity=zeros, angular_velocity=zeros)


def config(**changes) -> TrainConfig:
    settings = dict(
        model=ContactModelConfig(),
        seed=3,
        threads=2,
        scene=SceneConfig(name="drum"),
        loss=LossConfig(velocity=1.0),
        rollout=RolloutConfig(frames=2, noise_m=1e-3),
        optim=OptimConfig(learning_rate=1e-2, accumulate=3, weight_average=0.9, gradient_clip=1.0),
        trainer=TrainerConfig(steps=12, checkpoint_steps=4, log_every=1),
    )
    return TrainConfig(**(settings | changes))


def train(folder, **changes) -> tuple[Trainer, list]:
    folder.mkdir(exist_ok=True)
    logged = []
    trainer = Trainer(Network(), FakeWindows(), config(**changes), folder, lambda m, s: logged.append((s, m)))
    trainer.run(progress=False)
    return trainer, logged


def same(a: dict, b: dict) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a)


def test_training_lowers_the_loss(tmp_path):
    _, logged = train(tmp_path, trainer=TrainerConfig(steps=150, log_every=1))
    losses = [metrics["loss"] for _, metrics in logged]
    assert np.mean(losses[-10:]) < 0.5 * np.mean(losses[:10])


def test_an_interrupted_training_ends_with_the_same_bits(tmp_path):
    whole, _ = train(tmp_path / "whole")
    (tmp_path / "parts").mkdir()
    polls = iter([False] * 6 + [True])
    stopped = Trainer(Network(), FakeWindows(), config(), tmp_path / "parts", should_stop=lambda: next(polls))
    with pytest.raises(TrainingStopped, match="update 7"):
        stopped.run(progress=False)
    resumed, logged = train(tmp_path / "parts")
    assert logged[0][0] == 8
    assert same(whole.final_weights(), resumed.final_weights())


def test_a_kill_between_checkpoints_ends_with_the_same_bits(tmp_path):
    whole, _ = train(tmp_path / "whole")
    folder = tmp_path / "killed"
    folder.mkdir()

    class Killed(BaseException):
        pass

    def die(metrics, step):
        if step == 10:  # the last checkpoint is of update 8
            raise Killed

    with pytest.raises(Killed):
        Trainer(Network(), FakeWindows(), config(), folder, die).run(progress=False)
    resumed, logged = train(folder)
    assert logged[0][0] == 9
    assert same(whole.final_weights(), resumed.final_weights())


@pytest.mark.parametrize("through_time", [True, False])
def test_the_number_of_threads_changes_no_bit(tmp_path, through_time):
    rollout = RolloutConfig(frames=2, noise_m=1e-3, gradient_through_time=through_time)
    one, _ = train(tmp_path / "one", threads=1, rollout=rollout)
    two, _ = train(tmp_path / "two", threads=2, rollout=rollout)
    assert same(one.final_weights(), two.final_weights())


def test_gradient_through_time_matters(tmp_path):
    on, _ = train(tmp_path / "on", rollout=RolloutConfig(frames=2))
    off, _ = train(tmp_path / "off", rollout=RolloutConfig(frames=2, gradient_through_time=False))
    assert not same(on.final_weights(), off.final_weights())


@pytest.mark.parametrize("frames", [2, 3, 5, 8, 12])
@pytest.mark.parametrize("through_time", [True, False])
def test_every_frame_ahead_is_trained_on_and_gradients_go_through_time_or_stop_at_a_frames_start(
    tmp_path, frames, through_time
):
    """What the trainer does, done by hand: each frame from the last, its loss, its gradient."""
    rollout = RolloutConfig(frames=frames, gradient_through_time=through_time)
    trainer = Trainer(Network(), FakeWindows(), config(rollout=rollout), tmp_path)
    loss, _, gradients = trainer._window_gradients(trainer.model, 4, frames)

    window = FakeWindows().draw(4, frames)
    state = FrameState(torch.from_numpy(window.position[0]), torch.from_numpy(window.velocity[0]))
    shares = []
    for k in range(1, frames + 1):
        if not through_time:
            state = FrameState(state.position.detach(), state.velocity.detach())
        state = trainer.model(state, SCENE, 0.0)
        error = (state.position - torch.from_numpy(window.position[k])).norm(dim=1).mean()
        slip = (state.velocity - torch.from_numpy(window.velocity[k])).norm(dim=1).mean() * SCENE.frame_interval
        shares.append((error + slip) / SCENE.filling.diameter)
    assert loss == pytest.approx(sum(share.item() for share in shares), rel=1e-5)
    each = [torch.autograd.grad(share, trainer.parameters, retain_graph=True) for share in shares]
    for found, *parts in zip(gradients, *each, strict=True):
        assert torch.allclose(found, sum(parts), rtol=1e-3, atol=1e-4 * found.abs().max().item())
        assert not torch.allclose(found, sum(parts[:-1]), rtol=1e-3)  # the last frame counts


def test_one_frame_ahead_has_no_time_to_go_through(tmp_path):
    on, _ = train(tmp_path / "on", rollout=RolloutConfig(frames=1))
    off, _ = train(tmp_path / "off", rollout=RolloutConfig(frames=1, gradient_through_time=False))
    assert same(on.final_weights(), off.final_weights())


def test_accumulated_windows_are_averaged_into_one_update(tmp_path):
    trainer = Trainer(Network(), FakeWindows(), config(), tmp_path)
    parts = [trainer._window_gradients(trainer.model, draw, 2)[2] for draw in range(3)]
    expected = [torch.stack(g).mean(dim=0) for g in zip(*parts, strict=True)]
    norm = torch.sqrt(sum(g.square().sum() for g in expected)).item()
    with ThreadPoolExecutor(2) as pool:
        metrics = trainer.update(pool)
    assert metrics["gradient_norm"] == pytest.approx(norm, rel=1e-5)


def test_the_time_cap_counts_across_resumes(tmp_path):
    trainer, _ = train(tmp_path, trainer=TrainerConfig(steps=4, log_every=1))
    assert trainer.seconds > 0
    capped = Trainer(Network(), FakeWindows(), config(trainer=TrainerConfig(steps=10**6, minutes=1e-9)), tmp_path)
    result = capped.run(progress=False)
    assert (result.stopped_by, result.steps) == ("time", 4)
    assert result.seconds == pytest.approx(trainer.seconds)


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


def test_a_damaged_checkpoint_is_refused_by_name_with_the_remedy(tmp_path):
    trainer, _ = train(tmp_path, trainer=TrainerConfig(steps=2))
    path = tmp_path / CHECKPOINT
    content = path.read_bytes()
    place = content.index(trainer.parameters[0].detach().numpy().tobytes())
    flipped = content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]
    for damaged in (content[:-1], content[:100], b"", flipped):
        path.write_bytes(damaged)
        with pytest.raises(CheckpointError, match=r"checkpoint\.pt is not a whole checkpoint .*; delete it"):
            train(tmp_path, trainer=TrainerConfig(steps=4))


def test_a_training_stopped_after_its_last_update_knows_its_loss(tmp_path):
    whole, _ = train(tmp_path / "whole")
    (tmp_path / "late").mkdir()
    late = Trainer(Network(), FakeWindows(), config(), tmp_path / "late", should_stop=lambda: late.step == 12)
    with pytest.raises(TrainingStopped):
        late.run(progress=False)
    again = Trainer(Network(), FakeWindows(), config(), tmp_path / "late").run(progress=False)
    assert again.loss == whole.last_loss
    assert again.stopped_by == "steps"


def test_the_fused_convolution_trains_to_the_same_bits_on_any_number_of_threads(tmp_path):
    settings = dict(
        model=CconvModelConfig(width=8, layers=1),
        rollout=RolloutConfig(frames=1),
        loss=LossConfig(position_l2=1.0),
        optim=OptimConfig(accumulate=2),
        trainer=TrainerConfig(steps=2),
    )

    def weights(threads: int) -> dict:
        torch.manual_seed(0)
        folder = tmp_path / str(threads)
        folder.mkdir()
        model = build_model(settings["model"], BoundaryConfig(), SCENE)
        trainer = Trainer(model, CrowdedWindows(), config(threads=threads, **settings), folder)
        trainer.run(progress=False)
        return trainer.final_weights()

    assert same(weights(1), weights(2))


def test_a_thread_that_runs_windows_has_no_threads_inside_an_operation(tmp_path):
    # OpenMP's idle threads spin, and what they spin is charged to a budget of processor time.
    seen = []

    class Watching(FakeWindows):
        def draw(self, draw: int, frames: int) -> FakeWindow:
            seen.append((threading.current_thread().name, torch.get_num_threads()))
            return super().draw(draw, frames)

    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        Trainer(Network(), Watching(), config(threads=2), tmp_path).run(progress=False)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert {threads for _, threads in seen} == {1}
    assert {name.partition("_")[0] for name, _ in seen} == {"windows"}


def test_a_loss_that_is_not_finite_stops_and_keeps_what_led_there(tmp_path):
    broken = Network()
    with torch.no_grad():
        broken.net[0].weight.fill_(float("nan"))
    with pytest.raises(TrainingDiverged, match=r"update 0.*diverged\.pt"):
        Trainer(broken, FakeWindows(), config(), tmp_path).run(progress=False)
    saved = torch.load(tmp_path / DIVERGED, weights_only=True)
    assert saved["draws"] == [0, 1, 2]
    assert not (tmp_path / CHECKPOINT).exists()


def test_learning_rate_schedules():
    steps = OptimConfig(learning_rate=1e-4, final_learning_rate=2e-6, schedule="steps", decay_steps=4)
    rates = [learning_rate(steps, s, 100) for s in range(100)]
    assert rates[0] == 1e-4
    assert rates[-1] == pytest.approx(2e-6)
    assert len(set(rates)) == 5
    assert all(b <= a for a, b in itertools.pairwise(rates))
    cosine = OptimConfig(learning_rate=1.0, final_learning_rate=1e-9, schedule="cosine", warmup_steps=10)
    assert learning_rate(cosine, 0, 100) == pytest.approx(0.1)
    assert learning_rate(cosine, 50, 100) == pytest.approx(0.5)
    assert learning_rate(OptimConfig(schedule="constant", learning_rate=3.0), 99, 100) == 3.0


def test_the_horizon_grows_at_its_share_of_the_budget():
    rollout = RolloutConfig(frames=3, final_frames=5, final_from=0.6)
    assert [frames_ahead(rollout, s, 10) for s in (0, 5, 6, 9)] == [3, 3, 5, 5]
    assert frames_ahead(RolloutConfig(frames=3), 9, 10) == 3


def test_a_horizon_that_grows_linearly_takes_every_number_on_its_way_equally_long():
    rollout = RolloutConfig(frames=1, final_frames=5, final_from=0.8, growth="linear")
    assert [frames_ahead(rollout, s, 20) for s in range(20)] == sorted([1, 2, 3, 4] * 4) + [5] * 4
    at_once = replace(rollout, final_from=0.0)
    assert frames_ahead(at_once, 0, 20) == 5


def test_a_growing_horizon_is_trained_on_as_it_grows(tmp_path):
    rollout = RolloutConfig(frames=1, final_frames=4, final_from=0.5, growth="linear")
    _, logged = train(tmp_path, rollout=rollout)
    assert [metrics["frames_ahead"] for _, metrics in logged] == [1, 1, 2, 2, 3, 3] + [4] * 6


def test_the_loss_that_is_logged_last_is_the_one_that_a_training_ends_with_whatever_ends_it(tmp_path):
    for ending in ({"steps": 7}, {"steps": 10**6, "minutes": 1e-9}):
        folder = tmp_path / str(len(ending))
        folder.mkdir()
        logged = []
        settings = config(trainer=TrainerConfig(log_every=10**5, **ending))
        trainer = Trainer(Network(), FakeWindows(), settings, folder, lambda m, s: logged.append((s, m["loss"])))  # noqa: B023
        result = trainer.run(progress=False)
        assert logged == [(result.steps, result.loss)]
