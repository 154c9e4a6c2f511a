"""Step a surrogate from a state, frame by frame: nothing clipped, dropped or projected on the way."""

import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from gran_bench.config.rules import at_least, check_arguments, checked_value
from gran_bench.dem.walls import check_walls
from gran_bench.progress import Progress
from gran_bench.scene import Scene
from gran_bench.state import ParticleState, Trajectory
from gran_bench.surrogate.step import FrameState, Surrogate


@dataclass(frozen=True)
class Rollout:
    """What a rollout gave."""

    trajectory: Trajectory  # F frames; from the first non-finite one on NaN, so that every figure shows the failure
    failed_frame: int | None  # the first non-finite one
    seconds_per_frame: np.ndarray  # (F − 1,) wall time of each computed frame, s
    warnings: tuple[str, ...] = ()  # where scene or start are unlike what the model was trained for, a line each


def initial_frame(model: Surrogate, scene: Scene, state: ParticleState) -> FrameState:
    """The model's own form of a stored state, on the model's device, in its precision.

    Raises:
        ModelMismatch: a scene or state that the model cannot be right for.
    """
    check_arguments(model=(model, Surrogate), scene=(scene, Scene), state=(state, ParticleState))
    extrapolations(model, scene, state)
    parameter = next(model.parameters())

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.asarray(array), dtype=parameter.dtype, device=parameter.device)

    return model.begin(scene, tensor(state.position), tensor(state.velocity), tensor(state.angular_velocity))


def step_frames(model: Surrogate, scene: Scene, state: ParticleState) -> Iterator[FrameState]:
    """The state itself, then one frame after another without end, without gradients; ``state.time`` is the clock."""
    frame = initial_frame(model, scene, state)
    for index in itertools.count():
        yield frame
        with torch.no_grad():
            frame = model(frame, scene, state.time + index * scene.frame_interval)


def extrapolations(model: Surrogate, scene: Scene, state: ParticleState) -> tuple[str, ...]:
    """Where a scene or a start is unlike what a model was trained for, a line each.

    Raises:
        ModelMismatch: where the model cannot be right.
    """
    return () if model.trained_for is None else model.trained_for.warnings(scene, state)


def rollout(
    model: Surrogate, scene: Scene, state: ParticleState, frames: int | None = None, progress: bool = False
) -> Rollout:
    """Roll a surrogate out from a state.

    Args:
        model: any surrogate.
        scene: gives walls, motion, Δt.
        state: the settled state, as the DEM left it.
        frames: F, the first state included; None: as many as the scene has.
        progress: show a bar.

    Raises:
        ConfigError: an argument of a wrong type, or no frame.
        ModelMismatch: a scene or state that the model cannot be right for, such as spheres of another size.
        SceneError: a span of the scene that is no whole number of frames.
        ValueError: a wall without an end that turns about an axis that it is not symmetric about.
    """
    check_arguments(model=(model, Surrogate), scene=(scene, Scene), state=(state, ParticleState))
    frames = checked_value(int, at_least(1), scene.frame_count if frames is None else frames, "frames")
    check_walls(scene)
    warnings, steps = extrapolations(model, scene, state), step_frames(model, scene, state)
    names = ("position", "velocity", *(["angular_velocity"] if model.uses_spin else []))
    motion = {name: np.full((frames, state.count, 3), np.nan, np.float32) for name in names}
    seconds, failed_frame = np.full(max(frames - 1, 0), np.nan), None
    model.eval()
    for k in Progress(range(frames), desc="rollout", unit="frame", show=progress, leave=False):
        began = time.perf_counter()
        frame = next(steps)
        if k:
            seconds[k - 1] = time.perf_counter() - began
        if not all(bool(torch.isfinite(getattr(frame, name)).all()) for name in names):
            failed_frame = k
            break
        for name, array in motion.items():
            array[k] = getattr(frame, name).cpu().numpy()
    clock, radius = state.time + scene.frame_interval * np.arange(frames), np.asarray(state.radius)
    motion = {"angular_velocity": None} | motion
    trajectory = Trajectory(clock, **motion, radius=radius, velocity_kind=model.velocity_kind)
    return Rollout(trajectory, failed_frame, seconds, warnings)
