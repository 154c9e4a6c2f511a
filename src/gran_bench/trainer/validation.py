"""The loss of a training on cases that no update sees, beside its own."""

from functools import cached_property
from typing import Any

import torch

from gran_bench.config import LossConfig
from gran_bench.dataset import Windows
from gran_bench.losses import WindowLoss
from gran_bench.surrogate.step import Surrogate
from gran_bench.trainer.trainer import motion_at, step_ahead

STARTS = (0.0, 1 / 3)  # of a case: the settled state, and the flow
MOST_CASES = 2  # a look costs about a hundredth of the updates between two of them


class Validation:
    """Windows of validation cases, the same at every look, without noise, for a model as it is at that time."""

    def __init__(self, model: Surrogate, windows: Windows, loss: LossConfig) -> None:
        self.model, self.windows, self._loss = model, windows, WindowLoss(loss)

    @cached_property
    def _starts(self) -> list[tuple[int, int, Any]]:
        """Case, frame, and what a model with a memory remembers there."""
        found = []
        for index, case in enumerate(self.windows.cases[:MOST_CASES]):
            run = case.trajectory
            for start in (int(share * run.frame_count) for share in STARTS):
                past = (array[: start + 1] for array in (run.time, run.position, run.angular_velocity))
                memories = self.model.memories(case.scene, *past)
                found.append((index, start, None if memories is None else memories[-1]))
        return found

    def loss(self, frames: int) -> float:
        """Mean over the windows of the sum over ``frames`` ahead, dimensionless."""
        total = 0.0
        with torch.no_grad():
            for index, start, memory in self._starts:
                window = self.windows.window(index, start, frames)
                state = self.model.begin(window.scene, *motion_at(self.model, window, 0), memory=memory)
                for k in range(1, frames + 1):
                    state, shares = step_ahead(self.model, self._loss, window, state, k, frames)
                    total += sum(share.item() for share in shares.values())
        return total / len(self._starts)
