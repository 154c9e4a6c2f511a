"""The loss of a training on cases that no update sees, beside its own."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gran_bench.config import LossConfig
from gran_bench.dataset import Windows
from gran_bench.losses import FrameAhead, Target, WindowLoss
from gran_bench.surrogate.step import Surrogate

STARTS = (0.0, 1 / 3)  # of a case: the settled state, and the flow
MOST_CASES = 2  # a look costs about a hundredth of the updates between two of them


class Validation:
    """Windows of validation cases, the same at every look, without noise.

    Args:
        model: that is trained, as it is at the time of a look.
        windows: of the validation cases.
        loss: as in training.
    """

    def __init__(self, model: Surrogate, windows: Windows, loss: LossConfig) -> None:
        self.model, self.windows, self._window_loss = model, windows, WindowLoss(loss)

    @cached_property
    def _starts(self) -> list[tuple[int, int, Any]]:
        """Case, frame, and what a model with a memory remembers there."""
        found = []
        for index, case in enumerate(self.windows.cases[:MOST_CASES]):
            run = case.trajectory
            for start in (int(share * run.frame_count) for share in STARTS):
                past = slice(start + 1)
                memories = self.model.memories(
                    case.scene, run.time[past], run.position[past], run.angular_velocity[past]
                )
                found.append((index, start, None if memories is None else memories[-1]))
        return found

    def loss(self, frames: int) -> float:
        """Mean over the windows of the sum over ``frames`` ahead, dimensionless."""
        model, kind, total = self.model, self.model.velocity_kind, 0.0
        like = next(model.parameters())

        def tensor(array: np.ndarray) -> Tensor:
            return torch.as_tensor(array).to(device=like.device, dtype=like.dtype)

        with torch.no_grad():
            for index, start, memory in self._starts:
                window = self.windows.window(index, start, frames)
                scene = window.scene
                first = window.position[0], window.velocity_at(0, kind), window.angular_velocity[0]
                state = model.begin(scene, *map(tensor, first), memory=memory)
                for k in range(1, frames + 1):
                    time = window.time + (k - 1) * scene.frame_interval
                    before, state = state, model(state, scene, time)
                    truth = (window.position[k], window.velocity_at(k, kind), window.angular_velocity[k])
                    target = Target(
                        *map(tensor, (*truth, window.velocity_at(k - 1, kind))), float(window.mean_overlap[k])
                    )
                    ahead = FrameAhead(before, state, target, scene, time)
                    total += sum(share.item() for share in self._window_loss.terms(ahead, k, frames).values())
        return total / len(self._starts)
