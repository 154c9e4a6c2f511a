"""The emulator: a learned linear recurrence from the wall's speed to the statistics of the flow, with their spread."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.signal import lfilter
from torch import Tensor, nn

from gran_bench.config import EmulatorConfig, SceneConfig
from gran_bench.config.reading import read_config
from gran_bench.emulator.runs import FIGURES, columns_of
from gran_bench.emulator.scan import DrivenModes
from gran_bench.emulator.told import FEATURES, Told
from gran_bench.metrics.angle_of_repose import center_of_mass_angles, surface_lines, why_no_angle
from gran_bench.scene import Scene, build_scene
from gran_bench.scene.motion import RADIANS_PER_SECOND_PER_RPM
from gran_bench.state import FloatArray, ParticleState
from gran_bench.surrogate.checkpoint import CheckpointError, ModelCard, load_card

# Of the first modes, in √(d/g): decay times from the shortest to the longest, and the highest frequency.
DECAYS, FREQUENCY = (0.4, 60.0), 0.14
LOG_PACE = (-4.0, 2.0)  # least and largest ln γ
INPUTS = (
    "speed", "speed over the frame", "turns", "settled surface angle", "settled centre", "filling", "friction", "known",
)  # fmt: skip
SETTLED_UNIT = 3.0  # deg, of the settled angles
KNOWN_WITHIN = 1e-3  # deg that the settled angles of the bed of most training runs may be off; a nudge is far below
LEAST_SPREAD = 1e-3  # of the scatter of runs


@dataclass(frozen=True)
class Statistics:
    """What the emulator says of a run: the expected figures, and an ensemble that scatters as runs of the DEM do."""

    time: FloatArray  # (F,) s
    mean: FloatArray  # (F, C)
    spread: FloatArray  # (F, C), standard deviation between runs
    members: FloatArray  # (M, F, C)
    columns: dict[str, slice]  # of each figure, by the names of `FIGURES`


class Modes(nn.Module):
    """Decaying oscillations that a signal drives and hastens: h_t = λ_t h_{t−1} + (1 − |λ_t|) B u_t, y_t = Re(C h_t).

    λ_t = e^{(−1/τ + 2πi f) γ_t Δt}, γ_t = e^{G u_t}. τ and f of each mode and G are learned. The pace γ lets a bed that
    stands keep what it remembers, and one that flows forget it. ``step`` is Δt, s.
    """

    def __init__(self, width: int, modes: int, fall_time: float, step: float) -> None:
        super().__init__()
        decay = torch.linspace(math.log(DECAYS[0]), math.log(DECAYS[1]), modes)
        self.log_decay = nn.Parameter(decay + math.log(fall_time / step))  # of τ in steps
        turns = torch.linspace(0.0, FREQUENCY, modes)[torch.randperm(modes)]
        self.frequency = nn.Parameter(turns * step / fall_time)  # f in 1/step
        self.drive, self.read = nn.Linear(width, 2 * modes), nn.Linear(2 * modes, width)
        self.pace = nn.Linear(width, modes)
        nn.init.zeros_(self.pace.weight)
        nn.init.zeros_(self.pace.bias)

    def forward(self, signal: Tensor) -> Tensor:
        """Of ``(B, F, W)``, the same shape."""
        log_pace, rate = self.pace(signal).clamp(*LOG_PACE), torch.exp(-self.log_decay)
        return self.read(DrivenModes.apply(log_pace, self.drive(signal), rate, 2.0 * math.pi * self.frequency))


class Layer(nn.Module):
    """Modes, and a look at the frame before the present phase, then a perceptron; each is added to what comes in."""

    def __init__(self, width: int, modes: int, fall_time: float, step: float) -> None:
        super().__init__()
        self.before, self.modes = nn.LayerNorm(width), Modes(width, modes, fall_time, step)
        self.held = nn.Linear(width, width)
        self.between, self.mix = nn.LayerNorm(width), _perceptron(width, 2 * width, width)

    def forward(self, signal: Tensor, before: Tensor) -> Tensor:
        """Of ``(B, F, W)``, the same shape; ``before`` as of `Told`."""
        own = self.before(signal)
        held = self.held(own)
        signal = signal + self.modes(own) + held.gather(1, before[..., None].expand_as(held))
        return signal + self.mix(self.between(signal))


def _perceptron(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, hidden), nn.SiLU(), nn.Linear(hidden, outputs))


class Recurrence(nn.Module):
    """One member of the committee: from inputs to the columns, and to how far runs scatter, both without unit.

    The spread learns from features that the level has made, and does not bend them.
    """

    def __init__(self, config: EmulatorConfig, scene: Scene, columns: int) -> None:
        super().__init__()
        width = config.width
        sizes = width, config.modes, scene.fall_time, config.stride * scene.frame_interval
        self.take = _perceptron(len(INPUTS) + FEATURES, width, width)
        self.layers = nn.ModuleList(Layer(*sizes) for _ in range(config.blocks))
        self.level = nn.Sequential(nn.LayerNorm(width), _perceptron(width, width, columns))
        self.spread = nn.Sequential(nn.LayerNorm(width), _perceptron(width, width // 2, columns))

    def forward(self, told: Told) -> tuple[Tensor, Tensor]:
        """Two ``(B, F, C)``."""
        signal = self.take(told.signal)
        for layer in self.layers:
            signal = layer(signal, told.before)
        return self.level(signal), nn.functional.softplus(self.spread(signal.detach())) + LEAST_SPREAD


class Emulator(nn.Module):
    """Mean and spread of the figures of each frame, from the wall's speed up to it, the bed, filling and friction.

    Args:
        config: sizes.
        scene: that the emulator is made for; filling and friction are inputs as shares of its own.
        figures: names of `FIGURES` that the data have.
    """

    has_memory = False

    def __init__(self, config: EmulatorConfig, scene: Scene, figures: list[str]) -> None:
        super().__init__()
        self.columns = columns_of(figures)
        count = sum(FIGURES[name][2] for name in figures)
        self.scene, self.members, self.schedules, self.stride = scene, config.members, config.schedules, config.stride
        self.committee = nn.ModuleList(Recurrence(config, scene, count) for _ in range(config.committee))
        # Of the training data: middle and width of each column, and how far runs scatter there.
        for name, value in {"middle": 0.0, "extent": 1.0, "scatter": 1.0}.items():
            self.register_buffer(name, torch.full((count,), value))
        # Settled angles of the bed that most training runs start from, deg.
        self.register_buffer("known", torch.full((2,), math.nan))
        # How deviations from the mean go together between columns, and from frame to frame.
        self.register_buffer("together", torch.eye(count))
        self.register_buffer("persistence", torch.zeros(()))

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Of ``(B, F, 8)`` inputs, mean and standard deviation ``(B, F, C)`` in the figures' units."""
        runs, frames = inputs.shape[:2]
        missing = -frames % self.stride  # of a whole number of strides; what is added has no part in what comes before
        whole = self.told(torch.cat([inputs, inputs[:, -1:].expand(-1, missing, -1)], dim=1))
        parts = [whole.part(self.stride, first) for first in range(self.stride)]
        told = Told(torch.cat([part.signal for part in parts]), torch.cat([part.before for part in parts]))
        found = [self.said_by(recurrence, told) for recurrence in self.committee]
        means = (torch.stack(each).mean(dim=0).unflatten(0, (self.stride, runs)) for each in zip(*found, strict=True))
        mean, spread = (each.permute(1, 2, 0, 3).flatten(1, 2)[:, :frames] for each in means)
        return mean, spread

    def told(self, inputs: Tensor) -> Told:
        """What the recurrences are told, of inputs ``(B, F, 8)``."""
        scene = self.scene
        speed = scene.critical_speed_rpm * RADIANS_PER_SECOND_PER_RPM
        return Told.of(inputs, speed * scene.frame_interval, scene.frame_interval / scene.fall_time)

    def said_by(self, recurrence: Recurrence, told: Told) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation as one member of the committee has them."""
        level, spread = recurrence(told)
        return self.middle + self.extent * level, self.scatter * spread

    def inputs(self, scene: Scene, settled: FloatArray) -> FloatArray:
        """What the emulator is told of a run, ``(F, 8)``; ``settled`` are the two angles of the bed at rest, deg.

        A bed with the settled angles of the one that most training runs share is that one. Without a word of it the
        emulator would say of every bed how that one begins to flow.
        """
        time = scene.start_time + scene.frame_interval * np.arange(scene.frame_count)
        backward = min(scene.rotation.speeds_rpm) < 0.0  # the mirror image
        unit = (-1.0 if backward else 1.0) / (self.scene.critical_speed_rpm * RADIANS_PER_SECOND_PER_RPM)
        now = scene.rotation.angular_speed(time) * unit
        over = np.diff(scene.rotation.angles(time), prepend=0.0) / scene.frame_interval * unit
        over[0] = 0.0
        rest = [*(np.asarray(settled) / SETTLED_UNIT), scene.filling.count / self.scene.filling.count - 1.0]
        rest.append(scene.material.friction / max(self.scene.material.friction, 1e-9) - 1.0)
        rest.append(np.allclose(settled, self.known.numpy(), rtol=0.0, atol=KNOWN_WITHIN))
        found = [now, over, now != 0.0, *(np.full(len(time), value) for value in rest)]
        return np.stack(found, axis=1).astype(np.float32)

    @torch.no_grad()
    def statistics(self, scene: Scene, settled: FloatArray, seed: int = 0, members: int | None = None) -> Statistics:
        """Expected statistics of a run, and an ensemble of runs.

        A member is mean + spread × z, with z a stationary Gaussian process of the correlations that the training's
        twins have: z_t = ρ z_{t−1} + √(1 − ρ²) L ε_t. Quantiles of a member are put in order.

        Args:
            scene: the drum with its motion, in the frame interval that the emulator was made for.
            settled: ``(2,)`` surface angle and centre-of-mass angle of the settled bed, deg.
            seed: of the ensemble.
            members: of the ensemble; null: those of the config.

        Raises:
            ValueError: a scene that the emulator says nothing of, or angles that are not finite.
        """
        self.refuse(scene, settled)
        mean, spread = (x[0].numpy() for x in self(torch.as_tensor(self.inputs(scene, settled))[None]))
        count = self.members if members is None else members
        random = torch.Generator().manual_seed(seed)
        # Single precision is far below the spread, and twice as fast.
        kicks = (torch.randn(count, *mean.shape, generator=random) @ self.together.T).numpy()
        stay = np.float32(self.persistence)
        kicks[:, 1:] *= np.sqrt(1.0 - stay**2)
        drawn = lfilter(np.ones(1, np.float32), np.array([1.0, -stay], np.float32), kicks, axis=1)
        found = np.concatenate([mean[None], mean + spread * drawn])
        speed = self.columns["speed"]
        found[..., speed] = np.sort(found[..., speed], axis=-1)
        found, spread = found.astype(np.float64), spread.astype(np.float64)
        time = scene.start_time + scene.frame_interval * np.arange(scene.frame_count)
        return Statistics(time, found[0], spread, found[1:], self.columns)

    def refuse(self, scene: Scene, settled: FloatArray) -> None:
        """Refuse, as a `ValueError`, what the emulator was not made for."""
        own = self.scene
        for name, given, known in (
            ("drum's radius, m", scene.drum_radius, own.drum_radius),
            ("drum's length, m", scene.length, own.length),
            ("sphere's diameter, m", scene.filling.diameter, own.filling.diameter),
            ("frame interval, s", scene.frame_interval, own.frame_interval),
        ):
            if given is None or abs(given - known) > 1e-9 * known:
                raise ValueError(f"scene {scene.name!r}: the {name}, is {given}; the emulator was made for {known:g}")
        if min(scene.rotation.speeds_rpm) < 0.0 < max(scene.rotation.speeds_rpm):
            raise ValueError(f"scene {scene.name!r} turns both ways; the emulator knows one sense in a run")
        if why := why_no_angle(scene):
            raise ValueError(f"scene {scene.name!r} has no angle of repose ({why}); the emulator says nothing of it")
        if len(settled) != 2 or not np.isfinite(settled).all():
            raise ValueError(f"settled={list(settled)} are no angles of a settled bed; give two finite ones, deg")

    def extrapolations(self, scene: Scene) -> list[str]:
        """A line for each thing in which a scene goes beyond the runs that the emulator learned from."""
        own, known = self.scene, self.schedules
        speeds = sorted({abs(speed) for speed in scene.rotation.speeds_rpm if speed})
        lines = [f"{v:g} rpm, trained from {known.slowest_rpm:g} to {known.fastest_rpm:g} rpm" for v in speeds
                 if not known.slowest_rpm <= v <= known.fastest_rpm]  # fmt: skip
        for name, given, usual, spread in (
            ("spheres", scene.filling.count, own.filling.count, known.filling_spread),
            ("friction", scene.material.friction, own.material.friction, known.friction_spread),
        ):
            if abs(given - usual) > (spread + 1e-9) * usual:
                lines.append(f"{name} {given:g}, trained at {usual:g} ± {100 * spread:g} %")
        return lines

    @property
    def parameter_count(self) -> int:
        """Number of trained weights."""
        return sum(p.numel() for p in self.parameters())


def settled_angles(scene: Scene, bed: ParticleState) -> FloatArray:
    """The two angles of a settled bed that the emulator is told, surface and centre of mass, ``(2,)`` deg.

    A bed without a straight surface gives NaN, which the emulator refuses.
    """
    still = bed.position[None], bed.radius, scene
    line, center = surface_lines(*still)[0], center_of_mass_angles(*still)[0]
    return np.degrees([line.angle if line.valid else math.nan, center])


def load_emulator(path: str | Path) -> Emulator:
    """The emulator of a ``model.pt``; a `CheckpointError` where it is none."""
    card, weights = load_card(Path(path))
    return emulator_of(card, weights, Path(path))


def emulator_of(card: ModelCard, weights: dict[str, Tensor], path: Path) -> Emulator:
    """An emulator from what its file holds; a `CheckpointError` where the file is of another model."""
    if card.model["name"] != "emulator":
        raise CheckpointError(f"{path} is of model={card.model['name']}, which steps particles; use load_model")
    scene = build_scene(read_config(SceneConfig, card.scene))
    emulator = Emulator(read_config(EmulatorConfig, card.model), scene, card.origin["figures"])
    emulator.load_state_dict(weights)
    return emulator.eval()
