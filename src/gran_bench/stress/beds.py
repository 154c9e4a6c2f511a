"""The DEM with a bed: any container, motion, material, step or precision, and what must not change a bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gran_bench.config import DemConfig
from gran_bench.dataset import CaseSpec, read_settled
from gran_bench.dataset.generation import Job
from gran_bench.dem.simulate import simulate
from gran_bench.files import locked
from gran_bench.metrics.bed import rotational_energy, sphere_masses, translational_energy
from gran_bench.metrics.outside import FailureCount, count_failures, counted
from gran_bench.scene import Scene
from gran_bench.shipped import shipped_scene
from gran_bench.state import ContactHistory, FloatArray, ParticleState, Trajectory
from gran_bench.stress.expectation import Observation
from gran_bench.stress.experiment import Bench, Experiment

STATE_ARRAYS = ("position", "velocity", "angular_velocity")


def settled_bed(scene: Scene, shared: Path, dem: DemConfig | None = None) -> ParticleState:
    """The bed that a scene starts with, made once for all cases of a run.

    Args:
        scene: at any motion.
        shared: folder of the beds.
        dem: that it settles with.
    """
    job = Job(CaseSpec(scene, dem or DemConfig()), shared, settles=True)
    with locked(shared / "beds.lock"):
        job.run(lambda seconds: None)
    return read_settled(job.path)[0]


def bed_in_place(
    bench: Bench, scene: str, changes: dict[str, Any] | None, then: dict[str, Any] | None, speed_rpm: float | None
) -> tuple[Scene, ParticleState]:
    """A scene and its settled bed, at the time when the scene starts.

    Args:
        scene: shipped one.
        changes: of its keys before the bed settles.
        then: further changes of its keys after that.
        speed_rpm: constant speed; None for the scene's own motion.
    """
    bed = settled_bed(shipped_scene(scene, changes), bench.shared)
    place = turned(shipped_scene(scene, (changes or {}) | (then or {})), speed_rpm)
    return place, replace(bed, time=place.start_time)


def turned(scene: Scene, speed_rpm: float | None) -> Scene:
    """The scene at a constant speed; as it is where None."""
    return scene if speed_rpm is None else scene.at_speed(speed_rpm)


def energy_scale(scene: Scene, state: ParticleState) -> float:
    """Energy of a bed that has fallen through its container and moves with its wall, M (g D + ½ ω² R²), J."""
    mass = sphere_masses(state.radius, scene.material.density).sum()
    fall, rim = scene.fall_height or 1.0, scene.rotation.largest_angular_speed * (scene.drum_radius or 0.0)
    return float(mass) * (scene.gravity_strength * fall + 0.5 * rim**2)


def kinetic_energy(trajectory: Trajectory, scene: Scene) -> FloatArray:
    """Translational and, where there is spin, rotational energy of each frame, ``(F,)`` J; NaN where not finite."""
    energy = translational_energy(trajectory, scene).value
    if trajectory.angular_velocity is not None:
        energy = energy + rotational_energy(trajectory, scene).value
    return energy


def escapes(count: FailureCount) -> tuple[str, ...]:
    """What a count of failures says, as flags; nothing where nothing is further out than the soft walls let it."""
    told = []
    if count.non_finite_states:
        told.append(f"{count.non_finite_states} of {count.states} states not finite from {count.first_non_finite:g} s")
    if count.outside_tolerated:
        told.append(
            f"{count.share(count.outside_tolerated):.2g} % of sphere states outside by > 5 mm, "
            f"{count.share(count.outside_radius):.2g} % ({counted(count.outside_spheres, 'sphere')}) by > r, "
            f"farthest {1e3 * count.farthest:.3g} mm"
        )
    return tuple(told)


def turning_bed(
    bench: Bench,
    scene: str = "drum_small",
    changes: dict[str, Any] | None = None,
    then: dict[str, Any] | None = None,
    speed_rpm: float | None = 30.0,
    seconds: float = 0.5,
    time_step: float | None = None,
    unsafe: bool = False,
    engine: str = "numba",
) -> Observation:
    """A settled bed that is turned.

    Args:
        scene: shipped one.
        changes: of its keys before the bed settles.
        then: further changes of its keys after that.
        speed_rpm: constant speed; null for the scene's own motion.
        seconds: simulated.
        time_step: s; the solver's choice where null.
        unsafe: whether a step beyond a fifth of the contact time is let through.
        engine: of the DEM.
    """
    place, bed = bed_in_place(bench, scene, changes, then, speed_rpm)
    dem = DemConfig(engine=engine, time_step=time_step, allow_unsafe_step=unsafe)
    result = simulate(place, bed, place.start_time + seconds, dem=dem)
    ended = replace(place, end_time=place.start_time + seconds)
    count = count_failures(result.trajectory, ended)
    energy, scale = kinetic_energy(result.trajectory, place), energy_scale(place, bed)
    overlap = result.trajectory.diagnostics
    deepest = max(overlap["overlap_peak"].max(), overlap["wall_overlap_peak"].max())
    return Observation(
        {
            "energy": float(energy.max() / scale) if scale else float(energy.max()),
            "outside": count.share(count.outside_radius),
            "outside_5mm": count.share(count.outside_tolerated),
            "overlap": float(deepest / (2.0 * bed.radius.min())) if bed.count else 0.0,
            "frames": float(result.trajectory.frame_count),
            "spheres": float(bed.count),
            "non_finite": float(count.non_finite_states),
        },
        (*result.warnings, *escapes(count)),
    )


def differing(one: ParticleState, other: ParticleState) -> int:
    """How many numbers of two states, contact forces included, are not the same to the last bit."""
    count = sum(int((getattr(one, name) != getattr(other, name)).sum()) for name in STATE_ARRAYS)
    if len(one.history) != len(other.history):
        return count + abs(len(one.history) - len(other.history))
    return count + int((one.history.force != other.history.force).sum())


def bit_identical(bench: Bench, what: str, scene: str = "drum_small", frames: int = 10) -> Observation:
    """Two ways to say the same, which must give the same to the last bit.

    Args:
        what: ``threads`` (1, 2 and 4), ``rest`` (0 rpm beside no motion), ``weightless`` (a bed that settles without
            gravity stays where it is put), ``restart`` (from a frame in the middle), ``skin`` (2 and 20 mm).
        scene: shipped one.
        frames: to run.
    """
    place = shipped_scene(scene)
    if what == "weightless":
        place = replace(place, gravity=(0.0, 0.0, 0.0))
        put = replace(place.fresh_filling(0), time=place.start_time)
        return Observation({"differing": float(differing(settled_bed(place, bench.shared), put)), "moved": 0.0})
    place, bed = place.at_speed(30.0), settled_bed(place, bench.shared)
    end = place.start_time + frames * place.frame_interval
    half = place.start_time + frames // 2 * place.frame_interval
    if what == "rest":
        runs = [simulate(one, bed, end).final for one in (place.at_rest(), place.at_speed(0.0))]
    elif what == "threads":
        runs = [simulate(place, bed, end, dem=DemConfig(threads=n)).final for n in (1, 2, 4)]
    elif what == "skin":
        runs = [simulate(place, bed, end, dem=DemConfig(skin=skin)).final for skin in (0.002, 0.02)]
    elif what == "restart":
        runs = [simulate(place, bed, end).final, simulate(place, simulate(place, bed, half).final, end).final]
    else:
        raise ValueError(f"with.what={what} is unknown; choose threads, rest, weightless, restart or skin")
    moved = float(np.linalg.norm(runs[0].position - bed.position, axis=1).max())
    return Observation({"differing": float(sum(differing(runs[0], run) for run in runs[1:])), "moved": moved})


def alike(bench: Bench, what: str, scene: str = "drum_small", frames: int = 5) -> Observation:
    """Two ways that must agree to a stated rounding: positions at the end.

    Args:
        what: ``backwards`` (the mirror image at −30 rpm), ``float32`` (of the contact forces), ``engines`` (numpy
            beside numba), ``turned`` (bed and gravity turned by 40° about the axis), ``renumbered``.
        scene: shipped one.
        frames: to run.
    """
    place, bed = shipped_scene(scene).at_speed(30.0), settled_bed(shipped_scene(scene), bench.shared)
    bed = replace(bed, history=ContactHistory.empty())  # both runs begin with contacts that remember nothing
    end = place.start_time + frames * place.frame_interval
    one = simulate(place, bed, end).final
    if what == "backwards":
        image = _mapped(bed, np.diag([-1.0, 1.0, 1.0]), proper=False)
        other = _mapped(simulate(place.at_speed(-30.0), image, end).final, np.diag([-1.0, 1.0, 1.0]), proper=False)
    elif what == "turned":
        angle = np.radians(40.0)
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        tilted = replace(place, gravity=tuple(turn @ np.array(place.gravity)))
        other = _mapped(simulate(tilted, _mapped(bed, turn), end).final, turn.T)
    elif what == "renumbered":
        order = np.random.default_rng(3).permutation(bed.count)
        there = simulate(place, _reordered(bed, order), end).final
        other = _reordered(replace(there, history=ContactHistory.empty()), np.argsort(order))
    elif what in ("float32", "engines"):
        dem = DemConfig(precision="float32") if what == "float32" else DemConfig(engine="numpy")
        other = simulate(place, bed, end, dem=dem).final
    else:
        raise ValueError(f"with.what={what} is unknown; choose backwards, turned, renumbered, float32 or engines")
    moved = float(np.linalg.norm(one.position - bed.position, axis=1).max())
    off = float(np.linalg.norm(other.position - one.position, axis=1).max())
    return Observation({"position_off": off, "moved": moved})


def _mapped(state: ParticleState, linear: FloatArray, proper: bool = True) -> ParticleState:
    """A state turned, or mirrored: spins are axial vectors."""
    vectors = {name: getattr(state, name) @ linear.T for name in STATE_ARRAYS}
    if not proper:
        vectors["angular_velocity"] = -vectors["angular_velocity"]
    return replace(state, **vectors)


def _reordered(state: ParticleState, order: FloatArray) -> ParticleState:
    names = (*STATE_ARRAYS, "radius", "material")
    return replace(state, **{name: getattr(state, name)[order] for name in names})


BEDS = {
    "turning_bed": Experiment(
        turning_bed,
        {
            "energy": "M(gD+½ω²R²)", "outside": "% of sphere states", "outside_5mm": "% of sphere states",
            "overlap": "d", "frames": "frames", "spheres": "spheres", "non_finite": "states",
        },
    ),
    "bit_identical": Experiment(bit_identical, {"differing": "numbers", "moved": "m"}),
    "alike": Experiment(alike, {"position_off": "m", "moved": "m"}),
}  # fmt: skip
