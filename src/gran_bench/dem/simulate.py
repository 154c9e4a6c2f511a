"""Running the DEM: from a state to a trajectory, and from a filling to a bed at rest."""

import time as clock
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np

from gran_bench.config import DemConfig
from gran_bench.config.consistency import check_dem
from gran_bench.config.rules import check_arguments
from gran_bench.dem import engine_numpy
from gran_bench.dem.fast import engine as engine_numba
from gran_bench.dem.fast.tuning import Tuner
from gran_bench.dem.frame import Run, steps_between_looks
from gran_bench.dem.initial_checks import STIFFEN, check_initial_speed, check_initial_state, closing_speed
from gran_bench.dem.integrate import Physics
from gran_bench.dem.lammps import SKIN_DIAMETERS, Lammps
from gran_bench.dem.record import FrameRecord, SimulationError, impact_warnings
from gran_bench.dem.rest import Rest
from gran_bench.dem.time_step import choose_time_step, impact_speed, unresolved
from gran_bench.progress import Progress
from gran_bench.scene import Scene
from gran_bench.state import ParticleState, Trajectory

ENGINES: dict[str, ModuleType] = {"numba": engine_numba, "numpy": engine_numpy}


@dataclass(frozen=True)
class SimulationResult:
    """A finished run."""

    trajectory: Trajectory  # ``(F, N, 3)`` float64 frames with the engine's diagnostics
    final: ParticleState  # the last state with its contact history and its continuation, for an exact restart
    time_step: float  # s
    steps: int  # number of steps
    wall_seconds: float  # s of wall time, compilation excluded
    warnings: tuple[str, ...]  # what a reader of the results must know
    skin: float  # and threads: m and number that were fastest at the end; they change no bit of the result
    threads: int


def simulate(
    scene: Scene, state: ParticleState, end_time: float, *,
    dem: DemConfig | None = None, progress: bool | Callable[[float], None] = False,
) -> SimulationResult:  # fmt: skip
    """Runs ``state`` in ``scene`` until ``end_time``, with a frame every ``scene.frame_interval``.

    The first frame is the state itself. Frames change no bit, and a run that starts from another's final state goes on
    bit for bit as the first would have.

    Args:
        scene, state: walls, motion, materials, gravity; start, with its contact history.
        end_time: s in the scene's clock; a whole number of frames after the start.
        dem: engine, time step, precision, and what is else chosen by the clock: skin and threads.
        progress: whether to show how far it is; or a function that is called with the simulated time, s, at each frame.

    Raises:
        ConfigError: an argument of a wrong type, or settings that contradict each other.
        ValueError: an end before the start, or between two frames.
        StateError: a state that cannot start.
        TimeStepError: a step that cannot resolve a contact.
        SimulationError: divergence, or a centre further than its radius outside the container.
        SceneError, MissingProgramError, LammpsError: with ``dem.engine=lammps``, as of `Lammps`.
    """
    dem = DemConfig() if dem is None else dem
    check_arguments(scene=(scene, Scene), state=(state, ParticleState), dem=(dem, DemConfig))
    check_arguments(end_time=(end_time, float))
    check_dem(dem)
    times = _frame_times(scene, state.time, end_time)
    check_initial_state(scene, state)
    ends = state.radius if state.count else np.array((scene.filling.smallest_radius, scene.filling.largest_radius))
    smallest, largest = float(ends.min()), float(ends.max())
    time_step, said = choose_time_step(scene, dem.time_step, dem.allow_unsafe_step, smallest)
    check_initial_speed(state, time_step)
    closing = closing_speed(state)
    judged = max(impact_speed(scene), closing)
    if closing == judged:
        given = f"spheres of the first state close in at up to {closing:.3g} m/s: dem.time_step={time_step:g} s"
        said += unresolved(scene, time_step, given, dem.allow_unsafe_step, smallest, closing)
    substeps, names = round(scene.frame_interval / time_step), ("position", "velocity", "angular_velocity", "radius")
    state = replace(state, **{name: np.array(getattr(state, name), np.float64) for name in names})
    record = FrameRecord(scene, state, len(times) + 1)
    tuner = _tuner(scene, largest, state.count, dem)
    with _engine(scene, dem) as engine:
        run = Run(engine, state, scene, time_step, tuner, record)
        run.record_frame(state.time)
        started = clock.perf_counter()
        with _followed(progress, len(times) * substeps, "DEM") as follow:
            for time in times:
                run.advance(substeps)
                # The frame's clock, not the sum of its steps: a restart finds the same number.
                run.record_frame(time)
                follow(substeps, time)
        run.check_escapes()
        final, wall_seconds = run.final(record.time[-1]), clock.perf_counter() - started
    return SimulationResult(
        trajectory=record.trajectory(),
        final=final,
        time_step=time_step,
        steps=len(times) * substeps,
        wall_seconds=wall_seconds,
        warnings=said + impact_warnings(scene, smallest, time_step, judged, record.time, record.peaks),
        skin=tuner.chosen.skin,
        threads=tuner.chosen.threads,
    )


def settle(
    scene: Scene, seed: int, *, dem: DemConfig | None = None, progress: bool | Callable[[float], None] = False,
    warn: Callable[[str], None] = warnings.warn,
) -> ParticleState:  # fmt: skip
    """Fills the container, lets the spheres fall and come to rest between walls that stand still.

    Where ``filling.settles`` is false, the filling is what the scene starts with. At rest means staying so (rest.py).
    The bed settles at least until ``start_time`` and is then labelled ``start_time``, however long it took.

    Args:
        scene, seed: what is filled, and how.
        dem, progress: as of :func:`simulate`.
        warn: is called with what a reader of the bed must know: an impact on the way that was too deep for Hertz's
            law, or too short for the step.

    Raises:
        ConfigError: an argument of a wrong type, or settings that contradict each other.
        SceneError: a filling that does not fit, or a seed that is no whole number ≥ 0.
        SimulationError: divergence, escape, or a bed that is not at rest after ``scene.longest_settling``.
        StateError: a bed that its own weight crushes, so that nothing could start from it.
    """
    dem = DemConfig() if dem is None else dem
    check_arguments(scene=(scene, Scene), dem=(dem, DemConfig))
    check_dem(dem)
    dem = replace(dem, power=False)  # nobody looks at the energy of a bed that settles
    still, filling = scene.at_rest(), scene.filling
    state = scene.fresh_filling(seed)
    check_initial_state(still, state)
    if not filling.settles:
        return replace(state, time=scene.start_time)
    time_step, _ = choose_time_step(scene, dem.time_step, dem.allow_unsafe_step)
    rest = Rest(still)
    substeps = min(steps_between_looks(still, time_step), max(1, round(rest.look_interval / time_step)))
    tuner = _tuner(still, filling.largest_radius, state.count, dem)
    record = FrameRecord(still, state)  # of no frames but one where it fails
    rests = False
    with _engine(still, dem) as engine, _followed(progress, None, "settling") as follow:
        run = Run(engine, state, still, time_step, tuner, record)
        while state.count and (not rests or run.time < scene.start_time - 1e-7 * scene.frame_interval):
            if not rests and run.time > scene.longest_settling:
                raise SimulationError(
                    f"the bed of {scene.name!r} is not at rest after {scene.longest_settling:.4g} s of settling: "
                    f"{rest.what_moves()}",
                    record.trajectory((run.time, *run.moving())),
                )
            run.advance(substeps)
            rests = rest.look(run.time, *run.moving()[:2])
            follow(substeps, run.time, f", speed {rest.speed:.2g} m/s")
        state, peaks = run.state(run.time), run.take_peaks()
    check_initial_state(still, state, remedy=STIFFEN)
    for said in impact_warnings(still, filling.smallest_radius, time_step, impact_speed(scene), [run.time], [peaks]):
        warn(f"while the bed of {scene.name!r} settled: {said}")
    return replace(state, time=scene.start_time)


@contextmanager
def _engine(scene: Scene, dem: DemConfig) -> Iterator[ModuleType | Lammps]:
    """What a run is given to make stretches with."""
    if dem.engine == "lammps":
        with Lammps(scene, dem.ranks) as engine:
            yield engine
    else:
        yield ENGINES[dem.engine]


def _tuner(scene: Scene, largest_radius: float, count: int, dem: DemConfig) -> Tuner:
    skin, threads, single = dem.skin, dem.threads, dem.precision == "float32"
    if dem.engine == "lammps":  # which keeps its skin, and has no threads
        skin, threads = skin or SKIN_DIAMETERS * 2.0 * largest_radius, 1
    physics, full = Physics.of(scene, largest_radius, skin), dem.slip == "full_radius"
    physics = replace(physics, threads=threads or 1, single_precision=single, full_radius=full, power=dem.power)
    return Tuner(physics, count, skin is not None, threads)


def _frame_times(scene: Scene, start: float, end: float) -> list[float]:
    """Times of the next frames, on the scene's own grid where the start is on it: a restart finds the same ones.

    Raises:
        ValueError: an end before the start, or between two frames.
    """
    if end < start:
        raise ValueError(f"end_time={end:g} s lies before the state's time={start:g} s; choose a later end")
    interval = scene.frame_interval
    exact, passed = (end - start) / interval, round((start - scene.start_time) / interval)
    if abs(exact - round(exact)) > 1e-6 * max(1.0, abs(exact)):
        raise ValueError(f"end_time={end:g} s is not a whole number of frames of {interval:g} s after {start:g} s")
    on_grid = abs(scene.start_time + passed * interval - start) < 1e-6 * interval
    first, passed = (scene.start_time, passed) if on_grid else (start, 0)
    return [first + (passed + k) * interval for k in range(1, round(exact) + 1)]


@contextmanager
def _followed(progress: bool | Callable[[float], None], total: int | None, label: str) -> Iterator[Callable[..., None]]:
    """What is called with steps, time in s and more words: it moves a bar, or tells a listener the time."""
    show = progress is True
    with Progress(total=total, desc=label, unit="step", unit_scale=True, leave=False, show=show) as bar:

        def follow(steps: int, time: float, said: str = "") -> None:
            bar.update(steps)
            bar.set_postfix_str(f"t = {time:.2f} s{said}", refresh=False)
            if callable(progress):
                progress(time)

        yield follow
