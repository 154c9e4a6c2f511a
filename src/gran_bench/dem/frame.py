"""A run between its frames: stretches of an engine, the walls' poses, who has left, and what may have gone wrong."""

import gc
import hashlib
import sys
import threading
import time as clock
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import ModuleType

import numpy as np

from gran_bench.dem.energy import Work, energy_figures
from gran_bench.dem.fast.tuning import Tuner
from gran_bench.dem.integrate import Divergence, Peaks
from gran_bench.dem.lammps import Lammps
from gran_bench.dem.outlet import leaked, part_of, rejoined, taking_part
from gran_bench.dem.record import FrameRecord, SimulationError
from gran_bench.dem.walls import PATH, largest_excess, wall_poses
from gran_bench.scene import Scene
from gran_bench.state import ContactHistory, Continuation, FloatArray, Held, Moving, ParticleState, name_some

# Between two looks at who leaves and who escaped, √(d/g): 10 ms for 50 mm. Where nothing falls, a frame.
LOOK_FALL_TIMES = 0.14
MOST_POSES = 100_000  # at a time: with steps of 1e-10 s all those up to a look would be 10 GB
# Looks until the particles are sorted anew: neighbours in space soon lie apart in memory, and sorting takes new lists.
LOOKS_BETWEEN_SORTS = 10


def steps_between_looks(scene: Scene, time_step: float) -> int:
    """Whole steps."""
    interval = LOOK_FALL_TIMES * scene.fall_time if scene.needs.gravity else scene.frame_interval
    return max(1, round(interval / time_step))


class Run:
    """A state, in float64, on its way; it goes on from its continuation where that holds for this scene and step.

    What changes a run follows from the count of its steps: at a look spheres beyond the outlet leave and whoever came
    through a wall stops the run. Frames are copies, so they change no bit.

    ``engine`` is a module with a ``Stretch``, or `Lammps`; ``tuner`` gives it its physics; ``record`` has the frames.
    """

    def __init__(
        self, engine: ModuleType | Lammps, state: ParticleState, scene: Scene, time_step: float, tuner: Tuner,
        record: FrameRecord,
    ) -> None:  # fmt: skip
        self._engine, self._scene, self._time_step, self._tuner, self._record = engine, scene, time_step, tuner, record
        self._look_steps = steps_between_looks(scene, time_step)
        self._sort_steps = LOOKS_BETWEEN_SORTS * self._look_steps
        # Lists know the way that walls go for as long as poses are given, which costs where walls go any.
        one_step = wall_poses(scene, state.time, time_step, 1)
        self._pose_steps = self._look_steps if one_step[:, :, PATH].any() else self._sort_steps
        # State and what is held of all where the stretch began; the stretch is None where it is still to begin.
        self._whole, self._held, self._stretch = state, None, None
        self._start, self._steps, self._peaks = state.time, 0, Peaks()
        self._work = Work.none(len(scene.walls))
        with _compiling_notice(isinstance(engine, ModuleType)):
            # Where the run goes on, this tells what the first frame's contacts do, and nothing else.
            self._begin()
            self.moving()
        kept = state.continuation
        if kept is not None and kept.key == self._key(state):
            self._take_from_stretch()
            self._start, self._steps, self._held, self._stretch = kept.start, kept.steps, kept.held, None

    @property
    def time(self) -> float:
        """The run's clock, s."""
        return self._start + self._steps * self._time_step

    def advance(self, steps: int) -> None:
        """Goes on, so many steps.

        Raises:
            SimulationError: divergence, or a centre further than its radius outside the container; it carries the
                frames so far and its own.
        """
        while steps:
            began = clock.perf_counter()
            if self._stretch is None:
                self._begin()
            elif self._steps == self._posed_until:
                self._stretch.set_walls(self._poses())
            some = min(steps, self._look_steps - self._steps % self._look_steps)
            if self._stretch is not None:
                some = min(some, self._posed_until - self._steps)
                with self._divergence():
                    self._stretch.run(some)
            self._steps, steps, self._now = self._steps + some, steps - some, None
            self._spent += clock.perf_counter() - began
            if self._steps % self._look_steps == 0:
                self._look()

    def moving(self, into: Moving | None = None) -> Moving:
        """What moves, as it is now, in arrays if given; spheres beyond the outlet keep what they left with."""
        if self._now is None:
            self._now = self._whole.position, self._whole.velocity, self._whole.angular_velocity
            if self._stretch is not None:
                everybody = self._inside.all()
                with self._divergence():
                    part = self._stretch.moving(into if everybody else None)
                self._now = part if everybody else tuple(map(self._among_all, self._now, part))
        if into is not None and self._now is not into:
            for room, array in zip(into, self._now, strict=True):
                room[:] = array
        return self._now

    def state(self, time: float) -> ParticleState:
        """All that there is now, at a time by the clock of the frames, s, with contacts in order."""
        state = self._whole
        if self._stretch is not None:
            with self._divergence():
                state = rejoined(state, self._inside, self._stretch.state())
        history = state.history
        order = np.lexsort((history.second, history.first))
        history = ContactHistory(*(array[order] for array in vars(history).values()))
        return replace(state, time=time, history=history)

    def final(self, time: float) -> ParticleState:
        """The state with what another run needs to go on from it."""
        state = self.state(time)
        return replace(state, continuation=Continuation(self._key(state), self._start, self._steps, self._holds()))

    def record_frame(self, time: float) -> None:
        """Keeps a frame, at a time by the clock of the frames, s."""
        if self._stretch is None:
            overlap, pairs = self._whole.history.overlap, self._whole.history.second >= 0
            overlaps = overlap[pairs], overlap[~pairs]
        else:
            overlaps = self._stretch.overlaps()
        self.moving(self._record.room())
        self._record.add(time, overlaps, self.take_peaks(), self._energy(time))

    def take_peaks(self) -> Peaks:
        """Largest overlaps and approach since they were last asked for."""
        self._take_from_stretch()
        peaks, self._peaks = self._peaks, Peaks()
        return peaks

    def _energy(self, time: float) -> dict[str, FloatArray]:
        """What a frame says of energy, by name, of the steps since the frame before; nothing where nobody asks."""
        physics = self._tuner.physics
        if not physics.power:
            return {}
        self._take_from_stretch()
        work, self._work = self._work, Work.none(len(self._scene.walls))
        laws = physics.pair_laws, physics.wall_laws
        return energy_figures(self._scene, self.state(time), work, self._time_step, laws)

    def check_escapes(self, walls: bool = True) -> None:
        """Looks whether anybody came through a wall, who would be found at the next look.

        Raises:
            SimulationError: a centre further than its radius outside the container, or beyond the outlet's rim.
        """
        scene, gone = self._scene, ()
        if not walls and scene.outlet is None:
            return
        moving = self.moving()
        if walls:
            poses = wall_poses(scene, self._start, self._time_step, 0, self._steps)[0]
            excess = largest_excess(scene, poses, moving[0])
            gone = np.flatnonzero((excess > self._whole.radius) & self._inside)
        if len(gone):
            what = f"particle {gone[0]} is {excess[gone[0]]:.3g} m beyond a wall, more than its radius"
        elif len(gone := leaked(scene, moving[0])):
            what = f"past the outlet more than {scene.outlet.radius:g} m from its middle, so through a wall"
        else:
            return
        raise SimulationError(
            f"{name_some(gone)} escaped by t = {self.time:.6g} s: {what}; choose a smaller dem.time_step or a "
            "stiffer material",
            self._record.trajectory((self.time, *moving)),
        )

    def _poses(self) -> FloatArray:
        """Poses from here to the next look or sort, or as many as may be."""
        steps = min(self._pose_steps - self._steps % self._pose_steps, MOST_POSES)
        self._posed_until = self._steps + steps
        return wall_poses(self._scene, self._start, self._time_step, steps, self._steps)

    def _begin(self) -> None:
        """A stretch from here on; none where nobody takes part."""
        whole, held, self._begun, self._spent, self._now = self._whole, self._held, self._steps, 0.0, None
        self._sorted, self._seen = self._steps, None  # the steps of the last sort, and when peaks were last taken
        self._inside = inside = taking_part(self._scene, whole.position)
        if held is not None and self._steps % self._look_steps:
            self._inside = inside = np.isin(np.arange(whole.count), held.order)  # nobody leaves between two looks
        number = np.flatnonzero(inside)
        if held is not None:
            order = None
            if self._steps % self._sort_steps and len(held.order) == len(number):
                # Nothing is sorted, so all is as it was left.
                whole, order = replace(whole, position=held.position), np.searchsorted(number, held.order)
            self._held = held._replace(order=number)
            held = Held(*(array[number] for array in held[:3]), order)
        if len(number):
            part, poses = part_of(whole, inside), self._poses()
            with self._divergence():
                self._stretch = self._engine.Stretch(part, self._tuner.physics, self._time_step, poses, held)

    def _look(self) -> None:
        """Who came through a wall, and who has left, without whom a new stretch begins; sorts after some looks."""
        self._take_from_stretch()
        # A centre that is beyond a wall by its radius lies in it by its diameter.
        self.check_escapes(walls=self._peaks.share > 0.99)
        if self._steps - self._sorted == self._sort_steps:
            self._tuner.took(self._spent)
        if self._scene.outlet is not None and (taking_part(self._scene, self.moving()[0]) < self._inside).any():
            self._held, self._whole, self._stretch = self._holds(), self.state(self.time), None
        elif self._steps % self._sort_steps == 0 and self._stretch is not None:
            self._stretch.sort(self._tuner.physics)
            self._sorted, self._spent = self._steps, 0.0

    def _holds(self) -> Held | None:
        """What goes on beside the state, of all particles."""
        if self._stretch is None:
            return self._held
        held, none = self._stretch.held(), np.zeros_like(self._whole.position)
        arrays = map(self._among_all, (self._whole.position, none, none), held[:3])
        return Held(*arrays, np.flatnonzero(self._inside)[held.order])

    def _among_all(self, whole: FloatArray, part: FloatArray) -> FloatArray:
        """What those that take part have, beside what the others keep."""
        whole = whole.copy()
        whole[self._inside] = part
        return whole

    def _take_from_stretch(self) -> None:
        if self._stretch is not None and self._seen != self._steps:
            self._seen = self._steps
            self._peaks = Peaks(*map(max, self._peaks, self._stretch.take_peaks()))
            if self._tuner.physics.power:
                self._work.add(self._stretch.take_work())

    def _key(self, state: ParticleState) -> str:
        """Of everything that a continuation holds for; frames, threads, skin and engine are not part of it."""
        scene, physics, history = self._scene, self._tuner.physics, state.history
        text = (
            scene.walls, scene.rotation, scene.outlet, physics.period, physics.full_radius, self._time_step, state.time,
        )  # fmt: skip
        digest = hashlib.sha256(repr(text).encode())
        for array in (
            physics.pair_laws, physics.wall_laws, physics.density, physics.gravity, state.position, state.velocity,
            state.angular_velocity, state.radius, state.material, *vars(history).values(),
        ):  # fmt: skip
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    @contextmanager
    def _divergence(self) -> Iterator[None]:
        """A divergence in the body becomes an error that carries the frames so far and its own."""
        try:
            yield
        except Divergence as divergence:
            whole, number = self._whole, np.flatnonzero(self._inside)
            frame = [np.array(a, np.float64) for a in (whole.position, whole.velocity, whole.angular_velocity)]
            for array, part in zip(frame, divergence.moving, strict=True):
                array[number] = part
            when = self._start + (self._begun + divergence.steps) * self._time_step
            i = number[divergence.particle]
            raise SimulationError(
                f"the run diverged at t = {when:.6g} s: particle {i} moves at {np.linalg.norm(frame[1][i]):.3g} m/s, "
                f"more than a quarter of the smallest radius in one step of {self._time_step:g} s; choose a smaller "
                "dem.time_step",
                # Of the step that was begun: a frame may have been taken where it began.
                self._record.trajectory((when + self._time_step, *frame)),
            ) from divergence


@contextmanager
def _compiling_notice(compiles: bool) -> Iterator[None]:
    """Says on stderr what a user waits for when the kernels are not in Numba's cache, from where they load sooner."""
    if not compiles:
        yield
        return
    said = "compiling the DEM kernels (once, about 10 s) …"
    notice = threading.Timer(1.0, print, (said,), {"file": sys.stderr, "flush": True})
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
