"""A surrogate far from what it was trained on, and what must not change its answer: what it does wrong is counted."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import torch

from gran_bench.config import BoundaryConfig, TrainConfig
from gran_bench.config.reading import read_config
from gran_bench.entry import checked_config, compose
from gran_bench.metrics.outside import count_failures, distance_outside
from gran_bench.rollout import Rollout, rollout, step_frames
from gran_bench.scene import Scene
from gran_bench.shipped import shipped_scene
from gran_bench.state import FloatArray, ParticleState
from gran_bench.stress.beds import (
    STATE_ARRAYS,
    bed_in_place,
    energy_scale,
    escapes,
    farthest,
    image,
    kinetic_energy,
)
from gran_bench.stress.expectation import Observation
from gran_bench.stress.experiment import Bench, Experiment
from gran_bench.stress.impacts import with_nan
from gran_bench.surrogate.build import build_model
from gran_bench.surrogate.step import FrameState, Surrogate

WILD = 2.0  # M (g D + ½ ω² R²): more kinetic energy than falling and turning can give, with room for a model's errors
UNITS = {
    "time_to_failure": "s", "horizon": "s", "outside": "% of sphere states", "outside_5mm": "% of sphere states",
    "energy": "M(gD+½ω²R²)", "failed_frame": "frames", "non_finite": "states", "frames": "frames",
}  # fmt: skip


def model_rollout(
    bench: Bench,
    scene: str = "drum",
    changes: dict | None = None,
    then: dict | None = None,
    speed_rpm: float | None = 30.0,
    frames: int = 400,
) -> Observation:
    """Roll the model out from a settled bed of the DEM, for a number of frames; the scene as in `bed_in_place`."""
    place, bed = bed_in_place(bench, scene, speed_rpm, changes, then)
    return observed(rollout(bench.model, place, bed, frames + 1), place, bed)


def observed(result: Rollout, scene: Scene, start: ParticleState) -> Observation:
    """What a rollout did, for any model alike: failures told, timed and bounded.

    It fails at the first state that is not finite, has a centre outside by more than a radius, or has more kinetic
    energy than falling and turning can give. Bounds hold for the finite states.
    """
    trajectory, frames = result.trajectory, result.trajectory.frame_count
    place = replace(scene, end_time=scene.start_time + max(frames - 1, 1) * scene.frame_interval)
    count, scale = count_failures(trajectory, place), energy_scale(place, start)
    share = kinetic_energy(trajectory, place) / (scale or 1.0)
    with np.errstate(invalid="ignore"):
        outside = np.array([_farthest_out(frame, trajectory.radius, place) for frame in trajectory.position])
        failed = ~np.isfinite(share) | (share > WILD) | (outside > 0.0)
    finite, flags = share[np.isfinite(share)], [*escapes(count)]
    if result.failed_frame is not None:
        flags.insert(0, f"failed at frame {result.failed_frame}: not finite")
    if len(finite) and finite.max() > WILD:
        flags.append(f"kinetic energy up to {finite.max():.3g} M(gD+½ω²R²)")
    horizon = place.frame_interval * (frames - 1)
    until = place.frame_interval * int(np.argmax(failed)) if failed.any() else horizon
    # A state that is not finite must lie at or after the frame that the rollout itself calls failed.
    told = frames if result.failed_frame is None else result.failed_frame
    quantities = {
        "time_to_failure": until,
        "horizon": horizon,
        "outside": count.share(count.outside_radius),
        "outside_5mm": count.share(count.outside_tolerated),
        "energy": float(finite.max()) if len(finite) else 0.0,
        "failed_frame": float(told),
        "non_finite": float(count.non_finite_states),
        "frames": float(frames),
    }
    curves = {"speed_rpm": [place.rotation.speeds_rpm[-1]], "time_to_failure": [until], "horizon": [horizon]}
    curves["survived"] = [float(not failed.any())]
    return Observation(quantities, tuple(flags), curves, int((~np.isfinite(share[:told])).sum()))


def _farthest_out(position: FloatArray, radius: FloatArray, scene: Scene) -> float:
    """How far beyond its radius the farthest centre is outside, m; negative where none is."""
    beyond = distance_outside(position.astype(np.float64), radius, scene) - radius
    return float(beyond[np.isfinite(beyond)].max(initial=-np.inf))


def untrained_rollout(
    bench: Bench, model: str, scene: str = "drum_small", speed_rpm: float = 40.0, frames: int = 100, seed: int = 0
) -> Observation:
    """Roll out a model of the default configuration with random weights, which must fail: whether it is seen is tested.

    Args:
        model: ``contact``, ``radial`` or ``ccnn``.
        scene: shipped one.
        speed_rpm: of the drum.
        frames: to compute.
        seed: of the weights.
    """
    config = checked_config(compose("train", [f"model={model}"]), TrainConfig)
    torch.manual_seed(seed)
    built = build_model(config.model, read_config(BoundaryConfig, vars(config.boundary)), shipped_scene(scene)).eval()
    return model_rollout(replace(bench, model=built), scene, speed_rpm=speed_rpm, frames=frames)


class Poisoned(Surrogate):
    """A model whose input has a NaN in one sphere's position at one frame."""

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
    """A NaN in the state that the model is given at a frame: it must show from the next one on, and not be cured."""
    return model_rollout(replace(bench, model=Poisoned(bench.model, frame)), scene, frames=frames)


def model_start(bench: Bench, field: str, scene: str = "drum_small") -> Observation:
    """A start state with a NaN in one of its fields."""
    place, bed = bed_in_place(bench, scene, 30.0)
    return observed(rollout(bench.model, place, with_nan(bed, field, 0), 3), place, bed)


def model_symmetry(
    bench: Bench, what: str, scene: str = "drum_small", speed_rpm: float = 40.0, warm: int = 20, frames: int = 1
) -> Observation:
    """Transform the state, step, transform back: where is a sphere that should be where it was?

    Args:
        what: ``renumbered``, ``turned`` or ``mirrored`` as in `image`.
        scene: shipped one.
        speed_rpm: of the drum.
        warm: frames of the model before, so that the bed moves; a memory, if it has one, begins anew after them.
        frames: to compare.
    """
    if what not in ("renumbered", "turned", "mirrored"):
        raise ValueError(f"with.what={what} is unknown; choose renumbered, turned or mirrored")
    place, bed = bed_in_place(bench, scene, speed_rpm)
    motion = rollout(bench.model, place, bed, warm + 1).trajectory
    spin = np.zeros_like(motion.position) if motion.angular_velocity is None else motion.angular_velocity
    last = (np.asarray(values[-1], np.float64) for values in (motion.position, motion.velocity, spin))
    state = ParticleState(**dict(zip(STATE_ARRAYS, last, strict=True)), radius=bed.radius, time=float(motion.time[-1]))
    there, changed, back = image(what, place, state)

    def ahead(scene: Scene, start: ParticleState) -> FloatArray:
        (frame,) = islice(step_frames(bench.model, scene, start), frames, frames + 1)
        return frame.position.cpu().numpy().astype(np.float64)

    one = ahead(place, state)
    other = back(ahead(there, changed))
    return Observation({"position_off": farthest(one, other), "moved": farthest(state.position, one)})


def model_threads(bench: Bench, scene: str = "drum_small", speed_rpm: float = 40.0, frames: int = 20) -> Observation:
    """One, two and four threads of torch: how many numbers of a rollout differ."""
    (place, bed), before, runs = bed_in_place(bench, scene, speed_rpm), torch.get_num_threads(), []
    try:
        for number in (1, 2, 4):
            torch.set_num_threads(number)
            runs.append(rollout(bench.model, place, bed, frames + 1).trajectory.position)
    finally:
        torch.set_num_threads(before)
    off = float(sum((run != runs[0]).sum() for run in runs[1:]))
    return Observation({"differing": off, "moved": farthest(runs[0][0], runs[0][-1])})


ROLLOUTS = {
    "model_rollout": Experiment(model_rollout, UNITS, of_model=True),
    "untrained_rollout": Experiment(untrained_rollout, UNITS),
    "model_nan": Experiment(model_nan, UNITS, of_model=True),
    "model_start": Experiment(model_start, UNITS, of_model=True),
    "model_symmetry": Experiment(model_symmetry, {"position_off": "m", "moved": "m"}, of_model=True),
    "model_threads": Experiment(model_threads, {"differing": "numbers", "moved": "m"}, of_model=True),
}
