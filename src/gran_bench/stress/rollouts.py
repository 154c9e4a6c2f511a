"""A surrogate far from what it was trained on, and what must not change its answer: what it does wrong is counted."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import torch

from gran_bench.compose import checked_config, compose
from gran_bench.config import BoundaryConfig, TrainConfig
from gran_bench.config.reading import read_config
from gran_bench.metrics.outside import distance_outside
from gran_bench.scene import Scene
from gran_bench.shipped import shipped_scene
from gran_bench.state import FloatArray, ParticleState
from gran_bench.stress.beds import BED_UNITS, bed_in_place, farthest, image, seen_of
from gran_bench.stress.expectation import Observation
from gran_bench.stress.experiment import Bench, Experiment
from gran_bench.stress.impacts import with_nan
from gran_bench.surrogate.rollout import Rollout, rollout, step_frames
from gran_bench.surrogate.step import FrameState, Surrogate, build_model

WILD = 2.0  # M (g D + ½ ω² R²): more kinetic energy than falling and turning can give, with room for a model's errors
UNITS = BED_UNITS | {"time_to_failure": "s", "horizon": "s", "failed_frame": "frames"}


def model_rollout(
    bench: Bench, scene: str = "drum", changes: dict | None = None, then: dict | None = None,
    speed_rpm: float | None = 30.0, frames: int = 400,
) -> Observation:  # fmt: skip
    """Roll the model out from a settled bed of the DEM (`bed_in_place`), for a number of frames."""
    place, bed = bed_in_place(bench, scene, speed_rpm, changes, then)
    return observed(rollout(bench.model, place, bed, frames + 1), place, bed)


def observed(result: Rollout, scene: Scene, start: ParticleState) -> Observation:
    """What a rollout did, for any model alike: failures told, timed and bounded.

    It fails at the first state that is not finite, has a centre outside by more than a radius, or has more kinetic
    energy than falling and turning can give. Bounds hold for the finite states.
    """
    trajectory, frames = result.trajectory, result.trajectory.frame_count
    figures, flags, share = seen_of(trajectory, scene, start)
    with np.errstate(invalid="ignore"):
        outside = np.array([_farthest_out(frame, trajectory.radius, scene) for frame in trajectory.position])
        failed = ~np.isfinite(share) | (share > WILD) | (outside > 0.0)
    if result.failed_frame is not None:
        flags = (f"failed at frame {result.failed_frame}: not finite", *flags)
    if figures["energy"] > WILD:
        flags = (*flags, f"kinetic energy up to {figures['energy']:.3g} M(gD+½ω²R²)")
    # A state that is not finite must lie at or after the frame that the rollout itself calls failed.
    told = frames if result.failed_frame is None else result.failed_frame
    horizon = scene.frame_interval * (frames - 1)
    until = scene.frame_interval * int(np.argmax(failed)) if failed.any() else horizon
    figures |= {"time_to_failure": until, "horizon": horizon, "failed_frame": float(told)}
    curves = {"speed_rpm": [scene.rotation.speeds_rpm[-1]], "time_to_failure": [until], "horizon": [horizon]}
    curves["survived"] = [float(not failed.any())]
    return Observation(figures, flags, curves, int((~np.isfinite(share[:told])).sum()))


def _farthest_out(position: FloatArray, radius: FloatArray, scene: Scene) -> float:
    """How far beyond its radius the farthest centre is outside, m; negative where none is."""
    beyond = distance_outside(position.astype(np.float64), radius, scene) - radius
    return float(beyond[np.isfinite(beyond)].max(initial=-np.inf))


def untrained_rollout(
    bench: Bench, model: str, scene: str = "drum_small", speed_rpm: float = 40.0, frames: int = 100
) -> Observation:
    """Roll out a model of the default configuration with random weights, which must fail: whether it is seen is tested.

    ``model`` is ``contact``, ``radial`` or ``ccnn``.
    """
    config = checked_config(compose("train", [f"model={model}"]), TrainConfig)
    torch.manual_seed(0)
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


def model_nan(bench: Bench, frame: int) -> Observation:
    """A NaN in the state that the model is given at a frame of twenty: it must show from the next one on, for good."""
    return model_rollout(replace(bench, model=Poisoned(bench.model, frame)), "drum_small", frames=20)


def model_start(bench: Bench, field: str) -> Observation:
    """A start state with a NaN in one of its fields."""
    place, bed = bed_in_place(bench, "drum_small", 30.0)
    return observed(rollout(bench.model, place, with_nan(bed, field, 0), 3), place, bed)


def model_symmetry(bench: Bench, what: str) -> Observation:
    """Transform the state, step a frame, transform back: where is a sphere that should be where it was?

    Twenty frames of the model come before, so that the bed moves; a memory, if it has one, begins anew after them.

    Args:
        what: ``renumbered``, ``turned`` or ``mirrored`` as in `image`.
    """
    if what not in ("renumbered", "turned", "mirrored"):
        raise ValueError(f"with.what={what} is unknown; choose renumbered, turned or mirrored")
    place, bed = bed_in_place(bench, "drum_small", 40.0)
    motion = rollout(bench.model, place, bed, 21).trajectory
    spin = np.zeros_like(motion.position) if motion.angular_velocity is None else motion.angular_velocity
    last = (np.asarray(values[-1], np.float64) for values in (motion.position, motion.velocity, spin))
    state = ParticleState(*last, bed.radius, time=float(motion.time[-1]))
    there, changed, back = image(what, place, state)

    def ahead(scene: Scene, start: ParticleState) -> FloatArray:
        _, frame = islice(step_frames(bench.model, scene, start), 2)
        return frame.position.cpu().numpy().astype(np.float64)

    one, other = ahead(place, state), back(ahead(there, changed))
    return Observation({"position_off": farthest(one, other), "moved": farthest(state.position, one)})


def model_threads(bench: Bench) -> Observation:
    """One, two and four threads of torch: how many numbers of a rollout over twenty frames differ."""
    (place, bed), before, runs = bed_in_place(bench, "drum_small", 40.0), torch.get_num_threads(), []
    try:
        for number in (1, 2, 4):
            torch.set_num_threads(number)
            runs.append(rollout(bench.model, place, bed, 21).trajectory.position)
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
