"""Training the emulator by the house's trainer: a batch of whole series takes the place of a window."""

import copy
import hashlib
import math
from collections.abc import Sequence
from dataclasses import replace
from statistics import mode
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gran_bench.config import TrainConfig
from gran_bench.dataset import CaseSpec
from gran_bench.emulator.network import SETTLED_UNIT, Emulator
from gran_bench.emulator.runs import RunStatistics, columns_of
from gran_bench.emulator.told import SETTLED
from gran_bench.scene import Scene
from gran_bench.trainer import Trainer

LEAST = 1e-6  # that no scale falls below, in the figure's unit
SPREAD_WEIGHT = 0.1  # of the spread's term: it bends no weight of the mean
# Of a figure's error in the loss; those that are not judged are told along with the others.
WEIGHTS, WEIGHT_OF_OTHERS = {"surface_angle": 1.0, "com_angle": 1.5, "speed": 2.0}, 0.3
# Added to the two settled angles, deg: a bed is not to be known again by them.
JITTER = (0.3, 0.1)


class TrainingRuns:
    """The series that the emulator learns from, and which of them are twins.

    Args:
        cases: what the series are of; a twin differs from its case by its nudge alone.
        series: their statistics, in that order.
        batch: series whose gradients are computed together.
    """

    mixture = None  # of scenes: these are of one

    def __init__(self, cases: Sequence[CaseSpec], series: Sequence[RunStatistics], batch: int) -> None:
        self.series, self.batch = list(series), min(batch, len(series))
        self.digest = hashlib.sha256(" ".join(one.digest for one in series).encode()).hexdigest()[:16]
        self.data_seconds = float(np.nansum([one.seconds for one in series]))
        self.figures = list(series[0].figures)
        plain = {case.key_without_nudge: k for k, case in enumerate(map(_Known, cases)) if not case.nudged}
        twins = [(plain[case.key_without_nudge], k) for k, case in enumerate(map(_Known, cases)) if case.nudged]
        self.twins = np.array(twins)
        most = mode(case.packing_seed for case in cases)
        self.known = self._settled(next(k for k, case in enumerate(cases) if case.packing_seed == most))
        self.values = np.stack([one.columns for one in series]).astype(np.float32)

    def apart(self) -> np.ndarray:
        """Differences of twins over √2, ``(T, F, C)``: each has the variance of one run about the mean of runs."""
        first, second = self.twins.T
        return (self.values[first] - self.values[second]) / math.sqrt(2.0)

    def inputs(self, model: Emulator) -> Tensor:
        """What the emulator is told of each run, ``(N, F, I)``."""
        told = [model.inputs(one.scene, self._settled(k)) for k, one in enumerate(self.series)]
        return torch.as_tensor(np.stack(told))

    def _settled(self, number: int) -> np.ndarray:
        """The two angles of a run's settled bed, ``(2,)`` deg; 0 without a straight surface."""
        return np.nan_to_num([self.series[number].figures[name][0, 0] for name in ("surface_angle", "com_angle")])


class _Known:
    """A case by what a twin shares with it."""

    def __init__(self, case: CaseSpec) -> None:
        self.nudged = case.nudge > 0.0
        self.key_without_nudge = str(replace(case, nudge=0.0, nudge_seed=0).key)


class EmulatorTrainer(Trainer):
    """The house's trainer with the emulator's loss; arguments as of `Trainer`.

    L = weighted sum over figures of |ŷ − y| in units of the twins' mean distance, a mean over a figure's columns, plus
    the negative log-likelihood of the twins' differences for a Gaussian of the predicted spread. A batch has every
    stride-th frame of some series, from a random one of the first on.
    """

    def __init__(self, model: Emulator, windows: TrainingRuns, config: TrainConfig, *rest: Any) -> None:
        values, apart = windows.values, windows.apart()
        # A column without any value in the data has none in the emulator: its middle is NaN.
        model.middle.copy_(torch.as_tensor([_mean(column) for column in values.T]))
        model.extent.copy_(torch.as_tensor([_scale(column, deviation=True) for column in values.T]))
        model.scatter.copy_(torch.as_tensor([_scale(column) for column in apart.T]))
        model.known.copy_(torch.as_tensor(windows.known))
        self.inputs, self.valid = windows.inputs(model), torch.as_tensor(np.isfinite(values))
        self.jitter, told = torch.tensor(JITTER) / SETTLED_UNIT, model.told(self.inputs)
        self.parts = [told.part(model.stride, first) for first in range(min(model.stride, values.shape[1]))]
        self.truth = torch.as_tensor(np.nan_to_num(values))
        self.apart, self.apart_valid = torch.as_tensor(np.nan_to_num(apart)), torch.as_tensor(np.isfinite(apart))
        self.weights = torch.empty_like(model.scatter)
        for name, place in columns_of(windows.figures).items():
            floor = math.sqrt(2.0) * _mean(np.abs(apart[..., place]))
            share = WEIGHTS.get(name, WEIGHT_OF_OTHERS) / (place.stop - place.start)
            self.weights[place] = share / (floor + LEAST) if floor > 0.0 else 0.0
        super().__init__(model, windows, config, *rest)
        # Matrices shrink, what shifts and scales them does not.
        groups = [
            {"params": [p for p in self.parameters if (p.ndim > 1) == shrinks], "weight_decay": decay}
            for shrinks, decay in ((True, config.model.weight_decay), (False, 0.0))
        ]
        self.optimizer = torch.optim.AdamW(groups, lr=config.optim.learning_rate, betas=(0.9, 0.99))

    def _window_gradients(self, model: Emulator, draw: int, frames: int) -> tuple[float, dict[str, float], list]:
        """Loss, its terms and its gradients for one batch of series; touches nothing that threads share."""
        rng = np.random.default_rng((self.config.seed, 7919, draw))
        drawn = rng.choice(len(self.truth), self.windows.batch, replace=False)
        first = int(rng.integers(len(self.parts)))
        part, frames = self.parts[first][drawn], slice(first, None, model.stride)
        part.signal[..., SETTLED] += self.jitter * torch.as_tensor(rng.standard_normal((len(drawn), 1, 2))).float()
        count, terms = len(model.committee), {"figures": 0.0, "spread": 0.0}
        for number, recurrence in enumerate(model.committee):
            rows = drawn[number::count]
            mean, spread = model.said_by(recurrence, part[slice(number, None, count)])
            truth = self.truth[rows, frames]
            far = (torch.where(self.valid[rows, frames], mean, truth) - truth).abs()
            terms["figures"] += (far * self.weights).sum(dim=-1).mean() / count
            here, pairs = np.nonzero(rows[:, None] == self.windows.twins[:, 0])
            relative = self.apart[pairs, frames] / spread[here]
            likely = (torch.log(spread[here] / model.scatter) + 0.5 * relative**2) * self.apart_valid[pairs, frames]
            terms["spread"] += SPREAD_WEIGHT * likely.sum() / max(likely.numel(), 1) / count
        total, own = sum(terms.values()), list(model.parameters())
        gradients = torch.autograd.grad(total, own, allow_unused=True, materialize_grads=True)
        return total.item(), {name: value.item() for name, value in terms.items()}, list(gradients)

    def final_weights(self) -> dict[str, Tensor]:
        """The weights to judge, with how deviations of twins go together in them."""
        weights = super().final_weights()
        model = copy.deepcopy(self.model)
        model.load_state_dict(weights)
        with torch.no_grad():
            _, spread = model(self.inputs[self.windows.twins[:, 0]])
        z = torch.where(self.apart_valid, self.apart / spread, torch.zeros(())).double()
        flat = z.flatten(0, 1)
        together = flat.T @ flat / len(flat)
        size = together.diagonal().clamp(min=1e-12).sqrt()
        together = together / size / size[:, None] + 1e-3 * torch.eye(len(size))
        stay = (z[:, 1:] * z[:, :-1]).sum() / (z[:, :-1] ** 2).sum().clamp(min=1e-12)
        root = torch.linalg.cholesky(together / (1.0 + 1e-3))
        return weights | {"together": root.float(), "persistence": stay.clamp(0.0, 0.999).float()}


def _mean(values: np.ndarray) -> float:
    """Over what is finite; NaN where nothing is."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else math.nan


def _scale(values: np.ndarray, deviation: bool = False) -> float:
    """Root mean square of what is finite, or its standard deviation; 1 where nothing is."""
    finite = values[np.isfinite(values)].astype(np.float64)
    finite = finite - finite.mean() if deviation and len(finite) else finite
    return float(np.sqrt(np.mean(finite**2))) + LEAST if len(finite) else 1.0


def make_emulator(config: TrainConfig, scene: Scene, figures: list[str]) -> Emulator:
    """The emulator with its seeded first weights."""
    torch.manual_seed(config.seed)
    return Emulator(config.model, scene, figures)
