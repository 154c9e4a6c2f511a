"""What a recurrence is told of every frame: the inputs, how long the wall has been moving or standing, and since when.

A phase lasts as long as the wall turns, or stands. How a bed begins to flow follows from the bed in the last frame of
the phase before: the recurrence can look at what it made of that frame.
"""

from __future__ import annotations  # a class names itself

from dataclasses import dataclass

import torch
from torch import Tensor

# Columns of the inputs: speed over the frame, whether the wall turns, angles of the settled bed.
OVER, TURNS, SETTLED = 1, 2, slice(3, 5)
ANGLES = (0.15, 0.4, 1.2)  # rad that the wall has turned in a phase, in which a feature goes up to 1
TIMES = (0.84, 2.8, 8.4)  # √(d/g) since a phase began, likewise
FEATURES = len(ANGLES) + len(TIMES)


@dataclass(frozen=True)
class Told:
    """Series of frames, all or every so many."""

    signal: Tensor  # (B, F, 8 + FEATURES)
    before: Tensor  # (B, F), the frame before the present phase, by its place in the series; 0 in the first phase

    @classmethod
    def of(cls, inputs: Tensor, unit_angle: float, unit_time: float) -> Told:
        """From inputs ``(B, F, 8)``; the angle of a frame at a speed of 1, rad, and a frame's length in √(d/g)."""
        turns = inputs[..., TURNS] > 0.0
        frames = torch.arange(turns.shape[1]).expand(turns.shape)
        begins = torch.ones_like(turns)
        begins[:, 1:] = turns[:, 1:] != turns[:, :-1]
        last = torch.cummax(torch.where(begins, frames, 0), dim=1).values - 1
        before, since = last.clamp(min=0), (frames - last) * unit_time
        turned = torch.cumsum(inputs[..., OVER], dim=1) * unit_angle
        turned = (turned - turned.gather(1, before)) * turns
        features = [*(torch.tanh(turned / scale) for scale in ANGLES), *(1.0 - torch.exp(-since / t) for t in TIMES)]
        return cls(torch.cat([inputs, torch.stack(features, dim=-1)], dim=-1), before)

    def part(self, stride: int, first: int) -> Told:
        """Every ``stride``-th frame from ``first`` on; the speed over a frame becomes that over the stride."""
        turned = torch.cumsum(self.signal[..., OVER], dim=1)
        frames = torch.arange(first, turned.shape[1], stride)
        earlier = (frames - stride).clamp(min=0)
        signal = self.signal[:, frames]
        signal[..., OVER] = (turned[:, frames] - turned[:, earlier]) / (frames - earlier).clamp(min=1)
        before = torch.div(self.before[:, frames] - first, stride, rounding_mode="floor").clamp(min=0)
        return Told(signal, before)

    def __getitem__(self, rows: object) -> Told:
        """Some of the series."""
        return Told(self.signal[rows], self.before[rows])
