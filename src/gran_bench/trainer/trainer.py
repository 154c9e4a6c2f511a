"""Train a surrogate: windows of the data in, weights out; any moment may be the last, and nothing is lost.

One update averages the gradients of ``optim.accumulate`` windows. The windows of an update are independent, so
they run in parallel threads, each with its own gradients, and are averaged in the order of the windows: the
result doesn't depend on the number of threads. What window and what noise an update sees is a pure function
of the seed and the update's number, so a resumed training is bit-identical to one that never stopped.
"""

import copy
import itertools
import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gran_bench.config import TrainConfig
from gran_bench.config.choices import given_or
from gran_bench.dataset import Window, Windows
from gran_bench.losses import FrameAhead, Target, WindowLoss
from gran_bench.progress import Progress
from gran_bench.scene import Scene
from gran_bench.surrogate.checkpoint import CHECKPOINT, CheckpointError, read_tensors, write_tensors
from gran_bench.surrogate.step import FrameState, Surrogate
from gran_bench.trainer.augmentation import Turn
from gran_bench.trainer.schedule import frames_ahead, learning_rate, work_of_updates

DIVERGED = "diverged.pt"


class TrainingDiverged(RuntimeError):
    """The loss is not finite; the state that led there is saved beside the checkpoint."""


class TrainingStopped(KeyboardInterrupt):
    """Training was asked to stop and left a checkpoint that the same command resumes."""


@dataclass(frozen=True)
class TrainingResult:
    """What a training did."""

    steps: int  # optimiser updates in all
    seconds: float  # wall time in all, across resumes
    stopped_by: str  # steps or time
    loss: float  # of the last update: mean over windows of the sum over frames
    parameters: int  # of the model, number of scalars
    planned_steps: int | None  # updates of the budget, None for one of time; where more than steps, the clock cut them
    learning_rate: float  # of the last update


class Trainer:
    """Optimise a surrogate on windows of the training cases.

    Args:
        model: moved to its device already; trained in place.
        windows: the training side of the data; it cannot reach the held-out cases.
        config: budgets, loss, optimiser.
        folder: holds the checkpoint; one that is there is resumed.
        log: called with ``(metrics, step)`` every ``trainer.log_every`` updates.
        should_stop: polled between updates; True saves a checkpoint and raises ``TrainingStopped``.
        warn: called once with a sentence, if the clock is going to cut a budget of steps.
    """

    def __init__(
        self,
        model: Surrogate,
        windows: Windows,
        config: TrainConfig,
        folder: Path,
        log: Callable[[dict[str, float], int], None] = lambda metrics, step: None,
        should_stop: Callable[[], bool] = lambda: False,
        warn: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.model, self.windows, self.config = model, windows, config
        self.folder, self.log, self.should_stop, self.warn = folder, log, should_stop, warn
        self.loss = WindowLoss(config.loss)
        self.parameters = list(model.parameters())
        self.optimizer = torch.optim.Adam(self.parameters, lr=config.optim.learning_rate)
        self.average = [p.detach().clone() for p in self.parameters] if config.optim.weight_average else None
        self.step, self.seconds, self.spent, self.last_loss = 0, 0.0, 0.0, math.nan
        self.progress = 0.0  # share of the budget at which the update in work begins
        self.workers = min(config.threads, config.optim.accumulate) if self._on_cpu else 1
        self.replicas = [model] + [copy.deepcopy(model) for _ in range(self.workers - 1)]
        for replica in self.replicas[1:]:  # it reads the same weights and collects gradients of its own
            for own, shared in zip(replica.parameters(), self.parameters, strict=True):
                own.data = shared.data

    @property
    def _on_cpu(self) -> bool:
        return self.parameters[0].device.type == "cpu"

    def save(self) -> None:
        """Write the checkpoint, whole or not at all."""
        state = {"model": self.model.state_dict(), "optimizer": self.optimizer.state_dict(), "average": self.average}
        clocks = {"step": self.step, "seconds": self.seconds, "spent": self.spent, "loss": self.last_loss}
        write_tensors(self.folder / CHECKPOINT, state | clocks)

    def resume(self) -> bool:
        """Go on from the checkpoint in the folder; False if there is none.

        Raises:
            CheckpointError: it is damaged.
        """
        path = self.folder / CHECKPOINT
        if not path.exists():
            return False
        try:
            state = read_tensors(path, self.parameters[0].device)
        except Exception as error:
            raise CheckpointError(
                f"{path} is not a whole checkpoint ({type(error).__name__}: {' '.join(str(error).split())[:200]}); "
                "delete it, and the same command trains from the start"
            ) from error
        self.model.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
        if self.average is not None:
            for kept, saved in zip(self.average, state["average"], strict=True):
                kept.copy_(saved)
        self.step, self.seconds, self.spent = state["step"], state["seconds"], state["spent"]
        self.last_loss = state["loss"]
        return True

    @property
    def expected_steps(self) -> float:
        """Updates that the whole budget holds, so that learning rate and growing rollouts end with it.

        With ``budget: time`` the pace so far says how many; the clock then has a part in the result, which no second
        training repeats bit by bit.
        """
        budget = self.config.trainer
        if budget.budget == "steps":
            return budget.steps
        share = max(self.spent / (60.0 * budget.minutes), self.step / budget.steps)
        return self.step / share if self.step else budget.steps

    def _clock(self) -> float:
        """The clock, s, that minutes are counted by: of the wall; of a budget of time on a CPU, of the processor.

        Processor time, summed over threads, gives each choice of a sweep as much work, whatever else the machine does.
        """
        by_processor = self._on_cpu and self.config.trainer.budget == "time"
        return time.process_time() if by_processor else time.monotonic()

    def _cut_ahead(self, work: np.ndarray, seconds_a_frame: float) -> str | None:
        """A sentence that says how much of a budget of steps the clock will cut at this pace; None for nothing.

        ``work``: frames ahead of all updates up to each one, times the size of a window where scenes are mixed.
        """
        budget, done = self.config.trainer, work[self.step - 1]
        needed = self.spent + (work[-1] - done) * seconds_a_frame
        if needed <= 60.0 * budget.minutes:
            return None
        # The update that begins last ends beyond the cap.
        fits = 1 + np.searchsorted(work, done + (60.0 * budget.minutes - self.spent) / seconds_a_frame)
        return (
            f"at this pace {fits} of {budget.steps} updates fit in {budget.minutes:g} minutes, and the schedule of the "
            f"learning rate is cut; raise trainer.minutes to {math.ceil(needed / 60.0)} or lower trainer.steps"
        )

    def _window_gradients(self, model: Surrogate, draw: int, frames: int) -> tuple[float, dict[str, float], list]:
        """Loss, its terms and its gradients for one window; touches nothing that threads share."""
        window = self.windows.draw(draw, frames, self.progress)
        rng = np.random.default_rng((self.config.seed, 7919, draw))
        memory = self._memories[window.case][window.start] if model.has_memory else None
        if self.config.rollout.mirror and rng.random() < 0.5:
            count = len(window.position[0])
            window, memory = window.mirrored(), None if memory is None else memory.mirrored(window.scene, count)
        turn = Turn.drawn(rng, window.scene.period) if self.config.rollout.rotation else None
        state = self._start(model, window, memory, rng)
        state, seen = (state, window.scene) if turn is None else (turn.state(state), turn.scene(window.scene))
        total, terms, gradients = 0.0, {}, [torch.zeros_like(p) for p in self.parameters]
        for k in range(1, frames + 1):
            state, shares = step_ahead(model, self.loss, window, state, k, frames, seen, turn)
            for name, value in shares.items():
                terms[name] = terms.get(name, 0.0) + value.item()
            total = total + sum(shares.values())
            if not self.config.rollout.gradient_through_time or k == frames:
                if total.requires_grad:  # or nobody is left, in a hopper that has run empty
                    own = list(model.parameters())
                    found = torch.autograd.grad(total, own, allow_unused=True, materialize_grads=True)
                    gradients = [g + new for g, new in zip(gradients, found, strict=True)]
                total, state = 0.0, state.detached()
        return sum(terms.values()), terms, gradients

    @cached_property
    def _memories(self) -> list[Any]:
        """What a model with a memory remembers at each frame of each case."""
        motions = [(case.scene, case.trajectory) for case in self.windows.cases]
        return [self.model.memories(scene, m.time, m.position, m.angular_velocity) for scene, m in motions]

    def _start(self, model: Surrogate, window: Window, memory: Any, rng: np.random.Generator) -> FrameState:
        """The window's first state with training noise, in the model's form."""
        rollout, scene = self.config.rollout, window.scene
        position, velocity, spin = motion_at(model, window, 0)
        if (size := given_or(rollout.noise_m, rollout.noise_diameters, scene.filling.diameter)) > 0:

            def noise() -> Tensor:
                return like_weights(model, rng.standard_normal(window.position[0].shape)) * size

            moved = noise()
            position = position + moved
            if rollout.independent_noise:
                velocity = velocity + noise() / scene.frame_interval
                spin = spin + noise() / (scene.frame_interval * scene.filling.radius)
            else:
                velocity = velocity + moved / scene.frame_interval
        return model.begin(scene, position, velocity, spin, memory=memory)

    def update(self, pool: ThreadPoolExecutor) -> dict[str, float]:
        """One optimiser update; returns the mean loss over its windows, its terms, rate and gradient norm.

        Raises:
            TrainingDiverged: a loss or a gradient is not finite.
        """
        config, steps = self.config.optim, self.expected_steps
        frames, self.progress = frames_ahead(self.config.rollout, self.step, steps), min(self.step / steps, 1.0)
        first = self.step * config.accumulate
        if self.model.has_memory:
            _ = self._memories  # before several threads want them

        def lane(number: int) -> list[tuple[int, float, dict[str, float], list[Tensor]]]:
            """The windows of one thread, one after another, on its own copy of the model."""
            draws = range(first + number, first + config.accumulate, self.workers)
            return [(draw, *self._window_gradients(self.replicas[number], draw, frames)) for draw in draws]

        results = sorted(itertools.chain(*pool.map(lane, range(self.workers))), key=lambda result: result[0])
        for i, parameter in enumerate(self.parameters):
            parameter.grad = torch.stack([gradients[i] for _, _, _, gradients in results]).mean(dim=0)
        metrics = {"loss": sum(r[1] for r in results) / len(results), "learning_rate": 0.0, "frames_ahead": frames}
        metrics |= {f"term/{name}": sum(r[2][name] for r in results) / len(results) for name in results[0][2]}
        norm = torch.linalg.vector_norm(torch.stack([torch.linalg.vector_norm(p.grad) for p in self.parameters]))
        metrics["gradient_norm"] = norm.item()
        if not (math.isfinite(metrics["loss"]) and math.isfinite(metrics["gradient_norm"])):
            self._save_divergence([r[0] for r in results])
        if config.gradient_clip is not None and metrics["gradient_norm"] > config.gradient_clip:
            for parameter in self.parameters:
                parameter.grad.mul_(config.gradient_clip / norm)
        metrics["learning_rate"] = learning_rate(config, self.step, steps)
        for group in self.optimizer.param_groups:
            group["lr"] = metrics["learning_rate"]
        self.optimizer.step()
        self.step += 1
        if self.average is not None:
            # A young average would remember the random start: its decay grows to the set one.
            decay = min(config.weight_average, (1.0 + self.step) / (10.0 + self.step))
            torch._foreach_lerp_(self.average, [p.detach() for p in self.parameters], 1.0 - decay)
        return metrics

    def _save_divergence(self, draws: list[int]) -> None:
        path, seed = self.folder / DIVERGED, self.config.seed
        write_tensors(path, {"model": self.model.state_dict(), "step": self.step, "draws": draws, "seed": seed})
        raise TrainingDiverged(
            f"the loss is not finite at update {self.step}; the weights and the windows that led there are in {path}. "
            "Try a smaller optim.learning_rate, optim.gradient_clip=0.2 or fewer rollout.frames"
        )

    def run(self, progress: bool = True) -> TrainingResult:
        """Train until the budget of steps or minutes is spent; resumes where a checkpoint is.

        Raises:
            TrainingDiverged: a loss is not finite.
            TrainingStopped: ``should_stop`` said so; the checkpoint is written.
        """
        self.resume()
        budget = self.config.trainer
        cap = math.inf if budget.minutes is None else 60.0 * budget.minutes
        last_saved = time.monotonic()
        before, began = (self.seconds, self.spent), (time.monotonic(), self._clock())
        warm, done = False, 0
        # What the clock may cut: a budget of steps with a cap of minutes. It is said once.
        capped = budget.budget == "steps" and budget.minutes is not None
        work = np.cumsum(work_of_updates(self.config.rollout, budget.steps, self.windows.mixture)) if capped else None
        threads = torch.get_num_threads()
        # Threads run whole windows. Threads inside an operation would fight them, and would sum in another order.
        # OpenMP counts threads for each thread that calls it, so the pool's own have to be told as well.
        torch.set_num_threads(1)
        windows = ThreadPoolExecutor(
            self.workers, thread_name_prefix="windows", initializer=torch.set_num_threads, initargs=(1,)
        )
        bar = Progress(total=budget.steps, initial=self.step, desc="training", unit="update", show=progress)
        self.model.train()
        try:
            with windows as pool:
                while self.step < budget.steps and self.spent < cap:
                    metrics = self.update(pool)
                    if not warm:
                        # A process's first update loads or compiles its kernels, which is no training.
                        began, warm, done = (time.monotonic(), self._clock()), True, self.step
                    self.seconds = before[0] + time.monotonic() - began[0]
                    self.spent = before[1] + self._clock() - began[1]
                    self.last_loss = metrics["loss"]
                    bar.update()
                    bar.set_postfix(loss=f"{self.last_loss:.4f}", refresh=False)
                    if self.step % budget.log_every == 0 or self.step == budget.steps or self.spent >= cap:
                        self.log(metrics | {"seconds": self.seconds}, self.step)
                        if capped and self.step > done:
                            pace = (self.spent - before[1]) / (work[self.step - 1] - work[done - 1])
                            if said := self._cut_ahead(work, pace):
                                capped = False
                                with Progress.external_write_mode():
                                    self.warn(said)
                    due = budget.checkpoint_steps and self.step % budget.checkpoint_steps == 0
                    stop = self.should_stop()
                    if due or stop or time.monotonic() - last_saved >= budget.checkpoint_every:
                        self.save()
                        last_saved = time.monotonic()
                    if stop:
                        raise TrainingStopped(f"stopped at update {self.step}; the same command goes on from there")
        finally:
            torch.set_num_threads(threads)
            bar.close()
        self.save()
        count = sum(p.numel() for p in self.parameters)
        stopped_by, planned = "steps" if self.step >= budget.steps else "time", None
        if budget.budget == "steps":
            planned = budget.steps
        rate = learning_rate(self.config.optim, max(self.step - 1, 0), self.expected_steps)
        return TrainingResult(self.step, self.seconds, stopped_by, self.last_loss, count, planned, rate)

    def final_weights(self) -> dict[str, Tensor]:
        """The weights to judge: the running average where there is one, else the last."""
        state = {name: value.detach().clone() for name, value in self.model.state_dict().items()}
        if self.average is not None:
            for (name, _), value in zip(self.model.named_parameters(), self.average, strict=True):
                state[name] = value.detach().clone()
        return state


def like_weights(model: Surrogate, array: np.ndarray) -> Tensor:
    """An array as a tensor of the model's precision, on its device."""
    like = next(model.parameters())
    return torch.as_tensor(array).to(device=like.device, dtype=like.dtype)


def motion_at(model: Surrogate, window: Window, k: int) -> tuple[Tensor, ...]:
    """Position, velocity in the model's sense and spin of frame ``k`` of a window, each ``(N, 3)``."""
    truth = window.position[k], window.velocity_at(k, model.velocity_kind), window.angular_velocity[k]
    return tuple(like_weights(model, array) for array in truth)


def step_ahead(
    model: Surrogate, loss: WindowLoss, window: Window, state: FrameState, k: int, frames: int,
    seen: Scene | None = None, turn: Turn | None = None,
) -> tuple[FrameState, dict[str, Tensor]]:  # fmt: skip
    """The model's frame ``k`` of ``frames`` ahead, from its frame before, and the loss there by term.

    With a ``turn``, the state is turned, and ``seen`` is the turned scene.
    """
    scene, earlier = window.scene, like_weights(model, window.velocity_at(k - 1, model.velocity_kind))
    start = window.time + (k - 1) * scene.frame_interval
    after = model(state, scene if seen is None else seen, start)
    target = Target(*motion_at(model, window, k), earlier, float(window.mean_overlap[k]))
    before, predicted = (state, after) if turn is None else (turn.back(state), turn.back(after))
    return after, loss.terms(FrameAhead(before, predicted, target, scene, start), k, frames)
