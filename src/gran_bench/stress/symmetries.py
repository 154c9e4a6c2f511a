"""What must not change a surrogate's answer: numbering, threads, and the symmetries of a drum."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from gran_bench.scene import Scene
from gran_bench.shipped import shipped_scene
from gran_bench.state import FloatArray, ParticleState
from gran_bench.stress.beds import settled_bed
from gran_bench.stress.expectation import Observation
from gran_bench.stress.experiment import Bench, Experiment
from gran_bench.surrogate.rollout import initial_frame, rollout
from gran_bench.surrogate.step import Surrogate

TURN_DEG = 40.0  # about the axis; no multiple of an angle that a lattice could know
ARRAYS = ("position", "velocity", "angular_velocity")


def model_symmetry(
    bench: Bench, what: str, scene: str = "drum_small", speed_rpm: float = 40.0, warm: int = 20, frames: int = 1
) -> Observation:
    """Transform the state, step, transform back: where is a sphere that should be where it was?

    Args:
        what: ``renumbered``, ``turned`` (bed and gravity by 40° about the axis) or ``mirrored`` (along the axis).
        scene: shipped one.
        speed_rpm: of the drum.
        warm: frames before, so that the bed moves.
        frames: to compare.
    """
    place = shipped_scene(scene).at_speed(speed_rpm)
    model = bench.model.model
    state = _moving(model, place, settled_bed(place, bench.shared), warm)
    other_place = place
    if what == "renumbered":
        order = np.random.default_rng(3).permutation(state.count)
        back = np.argsort(order)
        changed = _rows(state, order)
        undo: Callable[[FloatArray], FloatArray] = lambda position: position[back]  # noqa: E731
    elif what == "turned":
        angle = np.radians(TURN_DEG)
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        other_place = replace(place, gravity=tuple(turn @ np.array(place.gravity)))
        changed = replace(state, **{name: getattr(state, name) @ turn.T for name in ARRAYS})
        undo = lambda position: position @ turn  # noqa: E731
    elif what == "mirrored":
        polar, axial = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, -1.0])
        changed = replace(
            state,
            position=state.position * polar,
            velocity=state.velocity * polar,
            angular_velocity=state.angular_velocity * axial,
        )
        undo = lambda position: position * polar  # noqa: E731
    else:
        raise ValueError(f"with.what={what} is unknown; choose renumbered, turned or mirrored")
    one = _ahead(model, place, state, frames)
    other = undo(_ahead(model, other_place, changed, frames))
    off, moved = np.linalg.norm(other - one, axis=1), np.linalg.norm(one - state.position, axis=1)
    return Observation({"position_off": float(off.max()), "moved": float(moved.max())})


def model_threads(bench: Bench, scene: str = "drum_small", speed_rpm: float = 40.0, frames: int = 20) -> Observation:
    """One, two and four threads of torch: how many numbers of a rollout differ.

    Args:
        scene: shipped one.
        speed_rpm: of the drum.
        frames: to compute.
    """
    place = shipped_scene(scene).at_speed(speed_rpm)
    bed, before, runs = settled_bed(place, bench.shared), torch.get_num_threads(), []
    try:
        for number in (1, 2, 4):
            torch.set_num_threads(number)
            runs.append(rollout(bench.model.model, place, bed, frames + 1).trajectory.position)
    finally:
        torch.set_num_threads(before)
    moved = float(np.linalg.norm(runs[0][-1] - runs[0][0], axis=1).max())
    return Observation({"differing": float(sum((run != runs[0]).sum() for run in runs[1:])), "moved": moved})


def _moving(model: Surrogate, scene: Scene, bed: ParticleState, frames: int) -> ParticleState:
    """The state after some frames of the model itself; a memory, if it has one, begins anew there."""
    motion = rollout(model, scene, bed, frames + 1).trajectory
    spin = np.zeros_like(motion.position[-1]) if motion.angular_velocity is None else motion.angular_velocity[-1]
    arrays = {
        name: np.asarray(values, np.float64)
        for name, values in zip(ARRAYS, (motion.position[-1], motion.velocity[-1], spin), strict=True)
    }
    return ParticleState(**arrays, radius=bed.radius, time=float(motion.time[-1]))


def _ahead(model: Surrogate, scene: Scene, state: ParticleState, frames: int) -> FloatArray:
    """Positions some frames on, ``(N, 3)`` m."""
    frame = initial_frame(model, scene, state)
    with torch.no_grad():
        for k in range(frames):
            frame = model(frame, scene, state.time + k * scene.frame_interval)
    return frame.position.cpu().numpy().astype(np.float64)


def _rows(state: ParticleState, order: FloatArray) -> ParticleState:
    names = (*ARRAYS, "radius", "material")
    return replace(state, **{name: getattr(state, name)[order] for name in names})


SYMMETRIES = {
    "model_symmetry": Experiment(model_symmetry, {"position_off": "m", "moved": "m"}, of_model=True),
    "model_threads": Experiment(model_threads, {"differing": "numbers", "moved": "m"}, of_model=True),
}
