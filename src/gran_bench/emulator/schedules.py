"""Under which schedules the emulator learns and is judged, and the runs of the DEM that this takes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gran_bench.config import DatasetConfig, DemConfig, JudgeConfig, SchedulesConfig
from gran_bench.config.emulator import MOST_SCHEDULES
from gran_bench.dataset import CaseSpec, DatasetError, replicas
from gran_bench.scene import Scene
from gran_bench.scene.motion import Rotation

JUDGED_SEED = MOST_SCHEDULES  # of the first random schedule that judging takes; training has those below
OWN_PACKING = 10  # seed of the first packing that belongs to one training run alone
# Of the time that a scene moves: from one change of speed to the next, a ramp, a ramp from rest, the end without one.
HOLD, RAMP, FIRST_RAMP, LAST = (0.1, 0.45), (0.025, 0.2), (0.05, 0.25), 0.05
# Chances of a start by a ramp, of a stop at a change while the drum turns, and of a jump instead of a ramp.
SLOW_START, STOP, JUMP = 0.15, 0.35, 0.5
OFTEN = 0.7  # chance of a stop in runs that are there for the sake of stops and of what follows them
SHARED = 4  # of these, every so many starts from the bed of the first run


@dataclass(frozen=True)
class Judged:
    """A schedule that is judged from one packing: its name, and nudged runs of the DEM."""

    name: str  # ``30 rpm``, ``drum_stop``, ``random 1003``
    unseen: bool  # whether the packing is the one that training never saw
    replicas: tuple[CaseSpec, ...]

    @property
    def label(self) -> str:
        """``drum_stop`` or ``drum_stop, unseen packing``."""
        return self.name + ", unseen packing" * self.unseen


def random_rotation(scene: Scene, seed: int, slowest: float, fastest: float, stop: float = STOP) -> Rotation:
    """A random schedule over the time that a scene moves: speeds within a range (rpm), jumps, ramps, stops, restarts.

    It is a pure function of its arguments; ``stop`` is the chance of a stop at a change of speed.
    """
    rng, length, axis = np.random.default_rng(seed), scene.end_time - scene.start_time, scene.rotation.axis
    time, speed = scene.start_time, _speed(rng, slowest, fastest)
    times, speeds = [time], [speed]
    if rng.random() < SLOW_START:
        time += length * rng.uniform(*FIRST_RAMP)
        times, speeds = [scene.start_time, time], [0.0, speed]
    while (time := time + length * rng.uniform(*HOLD)) < scene.end_time - LAST * length:
        before = speeds[-1]
        after = 0.0 if before and rng.random() < stop else _speed(rng, slowest, fastest)
        ramp = 0.0 if rng.random() < JUMP else length * rng.uniform(*RAMP)
        times, speeds = [*times, time, time + ramp], [*speeds, before, after]
        time += ramp
    return Rotation(tuple(round(float(t), 3) for t in times), tuple(speeds), axis)


def _speed(rng: np.random.Generator, slowest: float, fastest: float) -> float:
    return round(float(rng.uniform(slowest, fastest)), 2)


def training_cases(
    scene: Scene, dem: DemConfig, dataset: DatasetConfig, schedules: SchedulesConfig, shipped: Mapping[str, Rotation]
) -> list[CaseSpec]:
    """The runs that the emulator learns from, twins last: constant speeds, then random schedules.

    Two of five start from the shared packing, two from a packing of their own, one from a packing of its own with
    another filling and friction. A twin is a run again from a nudged start, so the two say how far runs scatter.
    Further runs stop often, because most of the others flow all the time; they start from beds that are there.

    Raises:
        DatasetError: a schedule among them that is judged, or a held-out speed.
    """
    slowest, fastest, cases = schedules.slowest_rpm, schedules.fastest_rpm, []
    held = [abs(speed) for speed in (*dataset.holdout_speeds_rpm, *dataset.validation_speeds_rpm)]
    constant = [v for v in np.linspace(slowest, fastest, schedules.constants) if abs(v) not in held]
    for k in range(schedules.runs):
        if k < len(constant):
            rotation = replace(scene.rotation, times=(scene.start_time,), speeds_rpm=(float(constant[k]),))
        else:
            rotation = random_rotation(scene, k, slowest, fastest)
        case, packing = replace(scene, rotation=rotation), dataset.packing_seed
        kind = k % 5 if k >= len(constant) else 0
        if kind > 1:
            packing = OWN_PACKING + k
            packing += schedules.runs * (packing in (dataset.packing_seed, dataset.unseen_packing_seed))
        if kind == 4:
            case = _another(case, np.random.default_rng((k, 4)), schedules)
        cases.append(CaseSpec(case, dem, packing))
    stopping = _stopping(cases, schedules)
    forbidden = [replace(scene.rotation, times=(scene.start_time,), speeds_rpm=(v,)) for v in held]
    refuse_unfair([*cases, *stopping], forbidden, shipped)
    every = max(1, len(cases) // schedules.twins)
    return [*cases, *stopping, *(replicas(case, 1)[0] for case in cases[::every][: schedules.twins])]


def _stopping(cases: Sequence[CaseSpec], schedules: SchedulesConfig) -> list[CaseSpec]:
    """Further runs, whose drum stops often: every fourth from the first run's bed, the others from a bed of another."""
    first, found = cases[0], []
    known = {case.packing_seed: case for case in cases if _filled(case) == _filled(first)}
    others = [case for seed, case in known.items() if seed != first.packing_seed]
    for k in range(schedules.stopping):
        bed = others[k % len(others)] if others and k % SHARED else first
        turn = random_rotation(bed.scene, schedules.runs + k, schedules.slowest_rpm, schedules.fastest_rpm, OFTEN)
        found.append(replace(bed, scene=replace(bed.scene, rotation=turn)))
    return found


def _filled(case: CaseSpec) -> tuple[object, object]:
    return case.scene.filling, case.scene.material


def _another(scene: Scene, rng: np.random.Generator, schedules: SchedulesConfig) -> Scene:
    """The scene with another number of spheres and another friction, each within its spread."""
    filling, friction = scene.filling, scene.material.friction
    share, slide = 1.0 + np.array([schedules.filling_spread, schedules.friction_spread]) * rng.uniform(-1.0, 1.0, 2)
    material = replace(scene.material, friction=round(friction * float(slide), 4))
    return replace(scene, filling=replace(filling, count=round(filling.count * float(share))), material=material)


def refuse_unfair(cases: Sequence[CaseSpec], held: Sequence[Rotation], shipped: Mapping[str, Rotation]) -> None:
    """Refuse, as a `DatasetError`, training runs whose wall moves as in a run that is judged; either sense counts.

    Args:
        cases: training runs.
        held: held-out speeds as constant rotations.
        shipped: schedules of the package that are judged, by name.
    """
    judged = {f"the held-out {rotation.speeds_rpm[0]:g} rpm": rotation for rotation in held} | dict(shipped)
    for case in cases:
        scene = case.scene
        times = scene.start_time + scene.frame_interval * np.arange(scene.frame_count)
        turned = np.abs(scene.rotation.angles(times))
        for name, rotation in judged.items():
            if np.allclose(turned, np.abs(rotation.angles(times)), rtol=1e-6, atol=1e-6):
                raise DatasetError(
                    f"a training run turns as {name} does, which is judged; choose another model.schedules.constants, "
                    "slowest_rpm or fastest_rpm"
                )


def judged_schedules(
    scene: Scene, dem: DemConfig, dataset: DatasetConfig, judge: JudgeConfig, schedules: SchedulesConfig,
    shipped: Mapping[str, Rotation],
) -> list[Judged]:  # fmt: skip
    """What is judged: a speed, shipped schedules and random ones, from the shared and the unseen packing.

    The speed is the validation speed where there is one, because whoever chooses must not see the held-out one.
    """
    speed = float((dataset.validation_speeds_rpm or dataset.holdout_speeds_rpm)[0])
    rotations = {f"{speed:g} rpm": scene.at_speed(speed).rotation, **shipped}
    for seed in range(JUDGED_SEED, JUDGED_SEED + judge.random_schedules):
        rotations[f"random {seed}"] = random_rotation(scene, seed, schedules.slowest_rpm, schedules.fastest_rpm)
    packings = {False: dataset.packing_seed} | ({True: dataset.unseen_packing_seed} if judge.unseen_packing else {})
    return [
        Judged(name, unseen, tuple(replicas(CaseSpec(replace(scene, rotation=turn), dem, seed), dataset.replicas)))
        for unseen, seed in packings.items()
        for name, turn in rotations.items()
    ]
