"""Running the DEM: from a state to a trajectory, and from a filling to a bed at rest."""

from __future__ import annotations

import sys
import threading
import time as clock
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from tqdm import tqdm

from gran_bench.config import DemConfig
from gran_bench.dem import engine_numba, engine_numpy
from gran_bench.dem.initial_checks import check_initial_state
from gran_bench.dem.integrate import Divergence, Physics
from gran_bench.dem.record import FrameRecord, SimulationError
from gran_bench.dem.time_step import TimeStepError, choose_time_step, dividing_step
from gran_bench.dem.walls import largest_excess
from gran_bench.scene import Rotation, Scene
from gran_bench.state import ContactHistory, FloatArray, ParticleState, Trajectory, name_some

__all__ = [
    "SimulationError", "SimulationResult", "TimeStepError", "choose_time_step", "dividing_step", "settle", "simulate",
]  # fmt: skip

ENGINES: dict[str, Callable[[ParticleState, Physics, float, FloatArray], ParticleState]] = {
    "numba": engine_numba.advance,
    "numpy": engine_numpy.advance,
}
# Longest stretch between two looks at a bed that settles: short enough not to overshoot rest by much.
SETTLING_LOOK = 0.01  # s


@dataclass(frozen=True)
class SimulationResult:
    """A finished run.

    Attributes:
        trajectory: ``(F, N, 3)`` float64 frames with the engine's diagnostics.
        final: the last state with its contact history, for an exact restart.
        time_step: s.
        steps: number of steps.
        wall_seconds: s of wall time, compilation excluded.
        warnings: what a reader of the results must know.
    """

    trajectory: Trajectory
    final: ParticleState
    time_step: float
    steps: int
    wall_seconds: float
    warnings: tuple[str, ...]


def simulate(
    scene: Scene,
    state: ParticleState,
    end_time: float,
    *,
    dem: DemConfig | None = None,
    progress: bool | Callable[[float], None] = False,
) -> SimulationResult:
    """Runs ``state`` in ``scene`` until ``end_time``, with a frame every ``scene.frame_interval``.

    The first frame is the state itself. A run that starts from another's final state goes on bit for bit as the
    first would have.

    Args:
        scene: walls, motion, materials, gravity.
        state: start, with its contact history.
        end_time: s in the scene's clock; a whole number of frames after the start.
        dem: engine, time step and skin.
        progress: whether to show a bar (simulated time, steps a second, time left); silent without a terminal. A
            function is called with the simulated time in s at each frame instead.

    Raises:
        StateError: a state that cannot start.
        TimeStepError: a step that cannot resolve a contact.
        SimulationError: divergence, or a centre further than its radius outside the container.
    """
    dem = dem or DemConfig()
    frames = _frames_between(scene, state.time, end_time)
    check_initial_state(scene, state)
    smallest, largest = _radius_range(scene, state)
    time_step, warnings = choose_time_step(scene, dem.time_step, dem.allow_unsafe_step, smallest)
    substeps = round(scene.frame_interval / time_step)
    physics, advance = Physics.of(scene, largest, dem.skin), _engine(dem)
    state = _as_float64(state)
    record = FrameRecord(scene, state.radius)
    record.add(_first_contacts(advance, state, physics, scene, time_step), state.time)
    times = _frame_times(scene, state.time, frames)
    started = clock.perf_counter()
    listen = progress if callable(progress) else _nobody
    with _bar(progress is True, frames * substeps, "DEM") as bar:
        for time in times:
            state = _advance_checked(advance, state, physics, scene, time_step, substeps, time, record)
            record.add(state, time)
            bar.update(substeps)
            bar.set_postfix_str(f"t = {time:.2f} s", refresh=False)
            listen(time)
    return SimulationResult(
        trajectory=record.trajectory(),
        final=replace(state, history=_sorted_history(state.history)),
        time_step=time_step,
        steps=frames * substeps,
        wall_seconds=clock.perf_counter() - started,
        warnings=warnings,
    )


def settle(
    scene: Scene, seed: int, *, dem: DemConfig | None = None, progress: bool | Callable[[float], None] = False
) -> ParticleState:
    """Fills the container, lets the spheres fall and come to rest between walls that stand still.

    At rest means a mean speed below ``filling.settled_speed``. The bed settles at least until ``start_time``, if
    that is positive, and is then labelled ``start_time``, however long it took. The contact history is kept.

    Args:
        scene: to fill.
        seed: of the filling.
        dem: engine, time step and skin.
        progress: whether to show a bar, or a function that is called with the simulated time in s.

    Raises:
        SceneError: a filling that does not fit.
        SimulationError: divergence, escape, or a bed that still moves after ``filling.longest_settling``.
    """
    dem, still, filling = dem or DemConfig(), scene.at_rest(), scene.filling
    state = scene.fresh_filling(seed)
    check_initial_state(still, state)
    time_step, _ = choose_time_step(scene, dem.time_step, dem.allow_unsafe_step)
    look = min(SETTLING_LOOK, scene.frame_interval)
    substeps = max(1, round(look / time_step))
    physics, advance = Physics.of(still, filling.radius, dem.skin), _engine(dem)
    _first_contacts(advance, state, physics, still, time_step)
    speed, looks = np.inf, 0
    listen = progress if callable(progress) else _nobody
    with _bar(progress is True, None, "settling") as bar:
        while state.count and (speed >= filling.settled_speed or state.time < scene.start_time - 1e-9):
            if state.time > filling.longest_settling:
                raise SimulationError(
                    f"the bed of {scene.name!r} still moves at {speed:.2g} m/s after "
                    f"{filling.longest_settling:g} s of settling; raise scene.filling.longest_settling or "
                    "scene.filling.settled_speed",
                    _one_frame(state),
                )
            looks += 1
            state = _advance_checked(
                advance, state, physics, still, time_step, substeps, looks * substeps * time_step, None
            )
            speed = float(np.linalg.norm(state.velocity, axis=1).mean())
            bar.update(substeps)
            bar.set_postfix_str(f"t = {state.time:.2f} s, mean speed {speed:.2g} m/s", refresh=False)
            listen(state.time)
    return replace(state, time=scene.start_time, history=_sorted_history(state.history))


def _advance_checked(
    advance: Callable[..., ParticleState],
    state: ParticleState,
    physics: Physics,
    scene: Scene,
    time_step: float,
    substeps: int,
    time: float,
    record: FrameRecord | None,
) -> ParticleState:
    """One frame on; a failure leaves as a SimulationError that carries the frames so far and its own."""

    def failed(*frame: FloatArray) -> Trajectory:
        if record is not None:
            return record.trajectory((time, *frame))
        return Trajectory(np.array([time]), *(array[None] for array in frame), state.radius)

    try:
        state = advance(state, physics, time_step, _wall_speeds(scene.rotation, state.time, time_step, substeps))
    except Divergence as divergence:
        i, when = divergence.particle, state.time + divergence.steps * time_step
        speed = float(np.linalg.norm(divergence.velocity[i]))
        raise SimulationError(
            f"the run diverged at t = {when:.6g} s: particle {i} moves at {speed:.3g} m/s, more than a quarter of "
            f"the smallest radius in one step of {time_step:g} s; choose a smaller dem.time_step",
            failed(divergence.position, divergence.velocity, divergence.angular_velocity),
        ) from divergence
    excess = largest_excess(scene.walls, state.position)
    gone = np.flatnonzero(excess > state.radius)
    if len(gone):
        raise SimulationError(
            f"particles {name_some(gone)} escaped by t = {time:.6g} s: particle {gone[0]} is {excess[gone[0]]:.3g} m "
            "beyond a wall, more than its radius; choose a smaller dem.time_step or a stiffer material",
            failed(state.position, state.velocity, state.angular_velocity),
        )
    # The frame's clock, not the sum of its steps: a restart finds the same number.
    return replace(state, time=time)


def _one_frame(state: ParticleState) -> Trajectory:
    return Trajectory(
        np.array([state.time]), state.position[None], state.velocity[None], state.angular_velocity[None], state.radius
    )


def _first_contacts(
    advance: Callable[..., ParticleState], state: ParticleState, physics: Physics, scene: Scene, time_step: float
) -> ParticleState:
    """The state with a list of its touching contacts; the first call of an engine, so it compiles here."""
    with _compiling_notice():
        touching = advance(state, physics, time_step, _wall_speeds(scene.rotation, state.time, time_step, 0))
    return replace(state, history=touching.history)


@contextmanager
def _compiling_notice(patience: float = 3.0) -> Iterator[None]:
    """Says on stderr what a user waits for when the kernels are not in Numba's cache."""
    # A cached load takes less than the patience, so nothing has to be known of how Numba caches.
    notice = threading.Timer(patience, lambda: print("compiling the DEM kernels (once) …", file=sys.stderr, flush=True))
    notice.daemon = True
    notice.start()
    try:
        yield
    finally:
        notice.cancel()


def _engine(dem: DemConfig) -> Callable[..., ParticleState]:
    if dem.engine not in ENGINES:
        raise ValueError(f"dem.engine={dem.engine!r} is unknown; choose {' or '.join(ENGINES)}")
    return ENGINES[dem.engine]


def _radius_range(scene: Scene, state: ParticleState) -> tuple[float, float]:
    if state.count == 0:
        return scene.filling.radius, scene.filling.radius
    return float(state.radius.min()), float(state.radius.max())


def _as_float64(state: ParticleState) -> ParticleState:
    arrays = {
        name: np.array(getattr(state, name), np.float64)
        for name in ("position", "velocity", "angular_velocity", "radius")
    }
    return replace(state, **arrays)


def _frames_between(scene: Scene, start: float, end: float) -> int:
    """Whole frames from start to end.

    Raises:
        ValueError: an end before the start, or between two frames.
    """
    exact = (end - start) / scene.frame_interval
    frames = round(exact)
    if not np.isfinite(exact) or frames < 0 or abs(exact - frames) > 1e-6 * max(1.0, abs(exact)):
        raise ValueError(
            f"end_time={end:g} s is not a whole number of frames of {scene.frame_interval:g} s after {start:g} s"
        )
    return frames


def _frame_times(scene: Scene, start: float, frames: int) -> list[float]:
    """Times of the next frames, on the scene's own grid where the start is on it: a restart finds the same ones."""
    interval = scene.frame_interval
    passed = round((start - scene.start_time) / interval)
    if abs(scene.start_time + passed * interval - start) < 1e-6 * interval:
        return [scene.start_time + (passed + k) * interval for k in range(1, frames + 1)]
    return [start + k * interval for k in range(1, frames + 1)]


def _wall_speeds(rotation: Rotation, start: float, time_step: float, steps: int) -> FloatArray:
    """Angular speed of the walls at the start and at the middle of each step, ``(steps + 1,)`` rad/s."""
    if rotation.is_still:
        return np.zeros(steps + 1)
    if start >= rotation.times[-1]:
        return np.full(steps + 1, rotation.angular_speed(start))
    middle = start + (np.arange(steps) + 0.5) * time_step
    return np.array([rotation.angular_speed(t) for t in (start, *middle)])


def _sorted_history(history: ContactHistory) -> ContactHistory:
    """By first, then second, whatever order an engine found the contacts in."""
    order = np.lexsort((history.second, history.first))
    return ContactHistory(
        history.first[order],
        history.second[order],
        history.force[order],
        history.overlap[order],
        history.rolling_moment[order],
    )


def _nobody(time: float) -> None:
    """Listens to the progress of a run that nobody follows."""


def _bar(progress: bool, total: int | None, label: str) -> tqdm:
    return tqdm(
        total=total,
        desc=label,
        unit=" steps",
        unit_scale=True,
        leave=False,
        # None: silent where stderr is no terminal.
        disable=None if progress else True,
    )
