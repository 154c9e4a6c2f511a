"""Training: bit-identical after any interruption, whatever the number of threads; divergence."""

import itertools
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from trainings import SCENE, CrowdedWindows, FakeWindow, FakeWindows, Network, config, same, train

from gran_bench.config import (
    BoundaryConfig,
    CconvModelConfig,
    LossConfig,
    OptimConfig,
    RolloutConfig,
    TrainerConfig,
)
from gran_bench.surrogate.checkpoint import CheckpointError
from gran_bench.surrogate.step import FrameState, build_model
from gran_bench.trainer import (
    CHECKPOINT,
    DIVERGED,
    Trainer,
    TrainingDiverged,
    TrainingStopped,
    frames_ahead,
    learning_rate,
)


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
        def draw(self, draw: int, frames: int, progress: float = 0.0) -> FakeWindow:
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
