"""A surrogate far from what it was trained on; whatever it does wrong is counted, timed and bounded."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from gran_bench.config import BoundaryConfig, TrainConfig
from gran_bench.config.reading import read_config
from gran_bench.entry import checked_config, compose
from gran_bench.metrics.outside import count_failures, distance_outside
from gran_bench.scene import Scene
from gran_bench.shipped import shipped_scene
from gran_bench.state import FloatArray, ParticleState
from gran_bench.stress.beds import bed_in_place, energy_scale, escapes, kinetic_energy, settled_bed
from gran_bench.stress.expectation import Observation
from gran_bench.stress.experiment import Bench, Experiment, Subject
from gran_bench.surrogate.rollout import Rollout, rollout
from gran_bench.surrogate.step import FrameState, Surrogate, build_model

WILD = 2.0  # M (g D + ½ ω² R²): more kinetic energy than falling and turning can give, with room for a model's errors
UNITS = {
    "time_to_failure": "s", "horizon": "s", "outside": "% of sphere states", "outside_5mm": "% of sphere states",
    "energy": "M(gD+½ω²R²)", "failed_frame": "frames", "non_finite": "states", "frames": "frames",
}  # fmt: skip


def model_rollout(
    bench: Bench,
    scene: str = "drum",
    changes: dict[str, Any] | None = None,
    then: dict[str, Any] | None = None,
    speed_rpm: float | None = 30.0,
    frames: int = 400,
) -> Observation:
    """Roll the model out from a settled bed of the DEM.

    Args:
        scene: shipped one.
        changes: of its keys before the bed settles.
        then: further changes of its keys after that.
        speed_rpm: constant speed; null for the scene's own motion.
        frames: to compute.
    """
    place, bed = bed_in_place(bench, scene, changes, then, speed_rpm)
    return observed(rollout(bench.model.model, place, bed, frames + 1), place, bed)


def observed(result: Rollout, scene: Scene, start: ParticleState) -> Observation:
    """What a rollout did, for any model alike: failures told, timed and bounded.

    It fails at the first state that is not finite, has a centre outside by more than a radius, or has more kinetic
    energy than falling and turning can give. Bounds hold for the finite states.
    """
    trajectory = result.trajectory
    frames = trajectory.frame_count
    place = replace(scene, end_time=scene.start_time + max(frames - 1, 1) * scene.frame_interval)
    count = count_failures(trajectory, place)
    energy = kinetic_energy(trajectory, place)
    scale = energy_scale(place, start)
    share = energy / scale if scale else energy
    with np.errstate(invalid="ignore"):
        outside = np.array([_farthest(frame, trajectory.radius, place) for frame in trajectory.position])
        failed = ~np.isfinite(share) | (share > WILD) | (outside > 0.0)
    first = int(np.argmax(failed)) if failed.any() else None
    finite = share[np.isfinite(share)]
    flags = [*escapes(count)]
    if result.failed_frame is not None:
        flags.insert(0, f"failed at frame {result.failed_frame}: not finite")
    if len(finite) and finite.max() > WILD:
        flags.append(f"kinetic energy up to {finite.max():.3g} M(gD+½ω²R²)")
    seconds = place.frame_interval * (frames - 1)
    # A state that is not finite must lie at or after the frame that the rollout itself calls failed.
    told = frames if result.failed_frame is None else result.failed_frame
    hidden = int((~np.isfinite(share[:told])).sum())
    return Observation(
        {
            "time_to_failure": seconds if first is None else place.frame_interval * first,
            "horizon": seconds,
            "outside": count.share(count.outside_radius),
            "outside_5mm": count.share(count.outside_tolerated),
            "energy": float(finite.max()) if len(finite) else 0.0,
            "failed_frame": float(frames if result.failed_frame is None else result.failed_frame),
            "non_finite": float(count.non_finite_states),
            "frames": float(frames),
        },
        tuple(flags),
        {
            "speed_rpm": [place.rotation.speeds_rpm[-1]],
            "time_to_failure": [seconds if first is None else place.frame_interval * first],
            "survived": [float(first is None)],
            "horizon": [seconds],
        },
        hidden,
    )  # fmt: skip


def _farthest(position: FloatArray, radius: FloatArray, scene: Scene) -> float:
    """How far beyond its radius the farthest centre is outside, m; negative where none is."""
    beyond = distance_outside(position.astype(np.float64), radius, scene) - radius
    return float(beyond[np.isfinite(beyond)].max(initial=-np.inf))


def untrained_rollout(
    bench: Bench, model: str, scene: str = "drum_small", speed_rpm: float = 40.0, frames: int = 100, seed: int = 0
) -> Observation:
    """Roll out a model with random weights, which must fail: whether its failure is seen is what is tested.

    Args:
        model: ``contact``, ``radial`` or ``ccnn``.
        scene: shipped one.
        speed_rpm: of the drum.
        frames: to compute.
        seed: of the weights.
    """
    subject = untrained(model, shipped_scene(scene), seed)
    return model_rollout(replace(bench, subject=subject), scene, speed_rpm=speed_rpm, frames=frames)


def untrained(name: str, scene: Scene, seed: int) -> Subject:
    """A model of the default configuration with its first weights."""
    config = checked_config(compose("train", [f"model={name}"]), TrainConfig)
    torch.manual_seed(seed)
    model = build_model(config.model, read_config(BoundaryConfig, vars(config.boundary)), scene).eval()
    return Subject(f"{name}, untrained", name, model, scene.filling.diameter)


class Poisoned(Surrogate):
    """A model whose input has a NaN in one sphere's position at one frame.

    Args:
        model: to poison.
        frame: whose input it is.
    """

    def __init__(self, model: Surrogate, frame: int) -> None:
        super().__init__()
        self.model, self.frame, self.asked = model, frame, 0
        self.velocity_kind, self.uses_spin, self.has_memory = model.velocity_kind, model.uses_spin, model.has_memory

    def begin(self, *values: Any, **named: Any) -> FrameState:
        """As the model begins."""
        return self.model.begin(*values, **named)

    def forward(self, state: FrameState, scene: Scene, time: float) -> FrameState:
        """As the model steps, from a poisoned state where it is due."""
        if self.asked == self.frame:
            position = state.position.clone()
            position[len(position) // 2, 1] = torch.nan
            state = replace(state, position=position)
        self.asked += 1
        return self.model(state, scene, time)


def model_nan(bench: Bench, frame: int, frames: int = 20, scene: str = "drum_small") -> Observation:
    """A NaN in the state that the model is given at a frame: it must show from the next one on, and not be cured.

    Args:
        frame: whose state it is in.
        frames: to compute.
        scene: shipped one.
    """
    place = shipped_scene(scene).at_speed(30.0)
    bed = settled_bed(place, bench.shared)
    return observed(rollout(Poisoned(bench.model.model, frame), place, bed, frames + 1), place, bed)


def model_start(bench: Bench, field: str, scene: str = "drum_small") -> Observation:
    """A start state with a NaN.

    Args:
        field: of the state.
        scene: shipped one.
    """
    place = shipped_scene(scene).at_speed(30.0)
    bed = settled_bed(place, bench.shared)
    values = np.array(getattr(bed, field))
    values[0] = np.nan
    broken = replace(bed, **{field: values})
    return observed(rollout(bench.model.model, place, broken, 3), place, bed)


ROLLOUTS = {
    "model_rollout": Experiment(model_rollout, UNITS, of_model=True),
    "untrained_rollout": Experiment(untrained_rollout, UNITS),
    "model_nan": Experiment(model_nan, UNITS, of_model=True),
    "model_start": Experiment(model_start, UNITS, of_model=True),
}
