"""One frame of a run: the walls' poses, the engine's stretch, who has left, and what may have gone wrong."""

from __future__ import annotations

import gc
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from gran_bench.dem.integrate import Divergence, Physics
from gran_bench.dem.outlet import leaked, part_of, rejoined, taking_part
from gran_bench.dem.record import FrameRecord, SimulationError
from gran_bench.dem.walls import largest_excess, wall_poses
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, ParticleState, Trajectory, name_some

Advance = Callable[[ParticleState, Physics, float, FloatArray], ParticleState]


def advance_frame(
    advance: Advance,
    state: ParticleState,
    physics: Physics,
    scene: Scene,
    time_step: float,
    substeps: int,
    time: float,
    record: FrameRecord | None,
) -> ParticleState:
    """The state one frame on. Spheres beyond the outlet at its start keep their state.

    Args:
        advance: of an engine.
        state: at the start.
        physics: of the scene.
        scene: walls, motion, outlet.
        time_step: s.
        substeps: of the frame.
        time: of its end, s.
        record: the frames so far; None where there is none.

    Raises:
        SimulationError: divergence, or a centre further than its radius outside the container; it carries the
            frames so far and its own.
    """

    def failed(position: FloatArray, velocity: FloatArray, spin: FloatArray) -> Trajectory:
        if record is not None:
            return record.trajectory((time, position, velocity, spin))
        return Trajectory(np.array([time]), position[None], velocity[None], spin[None], state.radius)

    poses = wall_poses(scene, state.time, time_step, substeps)
    inside = taking_part(scene, state.position)
    part = state if inside is None else part_of(state, inside)
    try:
        part = advance(part, physics, time_step, poses)
    except Divergence as divergence:
        number = np.arange(state.count) if inside is None else np.flatnonzero(inside)
        frame = [np.array(a, np.float64) for a in (state.position, state.velocity, state.angular_velocity)]
        found = (divergence.position, divergence.velocity, divergence.angular_velocity)
        for whole, part in zip(frame, found, strict=True):
            whole[number] = part
        i, when = number[divergence.particle], state.time + divergence.steps * time_step
        speed = float(np.linalg.norm(frame[1][i]))
        raise SimulationError(
            f"the run diverged at t = {when:.6g} s: particle {i} moves at {speed:.3g} m/s, more than a quarter of "
            f"the smallest radius in one step of {time_step:g} s; choose a smaller dem.time_step",
            failed(*frame),
        ) from divergence
    state = part if inside is None else rejoined(state, inside, part)
    remedy = "choose a smaller dem.time_step or a stiffer material"
    excess = largest_excess(scene, poses[-1], state.position)
    gone = np.flatnonzero((excess > state.radius) & (True if inside is None else inside))
    if len(gone):
        raise SimulationError(
            f"{name_some(gone)} escaped by t = {time:.6g} s: particle {gone[0]} is {excess[gone[0]]:.3g} m "
            f"beyond a wall, more than its radius; {remedy}",
            failed(state.position, state.velocity, state.angular_velocity),
        )
    astray = leaked(scene, state.position)
    if len(astray):
        raise SimulationError(
            f"{name_some(astray)} escaped by t = {time:.6g} s, past the outlet more than "
            f"{scene.outlet.radius:g} m from its middle, so through a wall; {remedy}",
            failed(state.position, state.velocity, state.angular_velocity),
        )
    # The frame's clock, not the sum of its steps: a restart finds the same number.
    return replace(state, time=time)


def first_contacts(
    advance: Advance, state: ParticleState, physics: Physics, scene: Scene, time_step: float
) -> ParticleState:
    """The state with a list of its touching contacts; the first call of an engine, so it compiles here."""
    poses, inside = wall_poses(scene, state.time, time_step, 0), taking_part(scene, state.position)
    with _compiling_notice():
        if inside is None:
            return replace(state, history=advance(state, physics, time_step, poses).history)
        return rejoined(state, inside, advance(part_of(state, inside), physics, time_step, poses))


@contextmanager
def _compiling_notice(patience: float = 1.0) -> Iterator[None]:
    """Says on stderr what a user waits for when the kernels are not in Numba's cache."""
    # A cached load takes less than the patience, so nothing has to be known of how Numba caches.
    notice = threading.Timer(
        patience, lambda: print("compiling the DEM kernels (once, some ten seconds) …", file=sys.stderr, flush=True)
    )
    notice.daemon = True
    notice.start()
    collects = gc.isenabled()
    # The compiler makes millions of small objects that live: looking for garbage among them is a tenth of its time.
    gc.disable()
    try:
        yield
    finally:
        notice.cancel()
        if collects:
            gc.enable()
