"""The DEM with a bed: any container, motion, material, step or precision, and what must not change a bit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

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
from gran_bench.stress.impacts import deepest_overlap

STATE_ARRAYS = ("position", "velocity", "angular_velocity")


def settled_bed(bench: Bench, scene: Scene) -> ParticleState:
    """The bed that a scene starts with, at any motion; made once for all cases of a run."""
    job = Job(CaseSpec(scene, DemConfig()), bench.shared, settles=True)
    with locked(bench.shared / "beds.lock"):
        job.run(lambda seconds: None)
    return read_settled(job.path)[0]


def bed_in_place(
    bench: Bench, scene: str, speed_rpm: float | None, changes: dict | None = None, then: dict | None = None
) -> tuple[Scene, ParticleState]:
    """A scene and its settled bed, at the time when the scene starts.

    Args:
        scene: shipped one.
        speed_rpm: constant speed; None for the scene's own motion.
        changes: of its keys before the bed settles.
        then: further changes of its keys after that.
    """
    bed = settled_bed(bench, shipped_scene(scene, changes))
    place = shipped_scene(scene, (changes or {}) | (then or {}))
    place = place if speed_rpm is None else place.at_speed(speed_rpm)
    return place, replace(bed, time=place.start_time)


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
            f"{count.share(count.outside_tolerated):.2g} % of sphere states outside by > 0.1 d, "
            f"{count.share(count.outside_radius):.2g} % ({counted(count.outside_spheres, 'sphere')}) by > r, "
            f"farthest {1e3 * count.farthest:.3g} mm"
        )
    return tuple(told)


BED_UNITS = {
    "energy": "M(gD+½ω²R²)", "outside": "% of sphere states", "outside_5mm": "% of sphere states", "frames": "frames",
    "non_finite": "states",
}  # fmt: skip


def seen_of(trajectory: Trajectory, scene: Scene, bed: ParticleState) -> tuple[dict[str, float], tuple, FloatArray]:
    """What any trajectory of a bed shows: figures in `BED_UNITS`, flags, and each state's energy in `energy_scale`."""
    span = max(trajectory.frame_count - 1, 1) * scene.frame_interval
    count = count_failures(trajectory, replace(scene, end_time=scene.start_time + span))
    share = kinetic_energy(trajectory, scene) / (energy_scale(scene, bed) or 1.0)
    finite = share[np.isfinite(share)]
    figures = {
        "energy": float(finite.max()) if len(finite) else 0.0,
        "outside": count.share(count.outside_radius),
        "outside_5mm": count.share(count.outside_tolerated),
        "frames": float(trajectory.frame_count),
        "non_finite": float(count.non_finite_states),
    }
    return figures, escapes(count), share


def turning_bed(
    bench: Bench, scene: str = "drum_small", changes: dict | None = None, then: dict | None = None,
    speed_rpm: float | None = 30.0, seconds: float = 0.5, time_step: float | None = None, unsafe: bool = False,
) -> Observation:  # fmt: skip
    """A settled bed (`bed_in_place`) that is turned for some seconds.

    ``time_step`` (s) is the solver's choice where null; ``unsafe`` lets a step beyond a fifth of the contact time pass.
    """
    place, bed = bed_in_place(bench, scene, speed_rpm, changes, then)
    dem = DemConfig(time_step=time_step, allow_unsafe_step=unsafe)
    result = simulate(place, bed, place.start_time + seconds, dem=dem)
    figures, flags, _ = seen_of(result.trajectory, place, bed)
    deepest = deepest_overlap(result.trajectory.diagnostics)
    overlap = deepest / float(2.0 * bed.radius.min()) if bed.count else 0.0
    figures |= {"overlap": overlap, "spheres": float(bed.count)}
    return Observation(figures, (*result.warnings, *flags))


def differing(one: ParticleState, other: ParticleState) -> int:
    """How many numbers of two states, contact forces included, are not the same to the last bit."""
    count = sum(int((getattr(one, name) != getattr(other, name)).sum()) for name in STATE_ARRAYS)
    if len(one.history) != len(other.history):
        return count + abs(len(one.history) - len(other.history))
    return count + int((one.history.force != other.history.force).sum())


def farthest(one: FloatArray, other: FloatArray) -> float:
    """The largest distance of a particle's two positions, ``(N, 3)`` m each."""
    return float(np.linalg.norm(other - one, axis=1).max())


def bit_identical(bench: Bench, what: str, scene: str = "drum_small") -> Observation:
    """Two ways to say the same, which must give the same to the last bit after ten frames of a shipped scene.

    ``what`` is ``threads`` (1, 2 and 4), ``rest`` (0 rpm beside no motion), ``weightless`` (a bed that settles without
    gravity stays where it is put), ``restart`` (from a frame in the middle) or ``skin`` (2 and 20 mm).
    """
    still = shipped_scene(scene)
    if what == "weightless":
        still = replace(still, gravity=(0.0, 0.0, 0.0))
        put = replace(still.fresh_filling(0), time=still.start_time)
        return Observation({"differing": float(differing(settled_bed(bench, still), put)), "moved": 0.0})
    place, bed = still.at_speed(30.0), settled_bed(bench, still)
    half, end = (place.start_time + number * place.frame_interval for number in (5, 10))

    def final(scene: Scene = place, start: ParticleState = bed, until: float = end, **dem: object) -> ParticleState:
        return simulate(scene, start, until, dem=DemConfig(**dem)).final

    ways: dict[str, Callable[[], list[ParticleState]]] = {
        "rest": lambda: [final(place.at_rest()), final(place.at_speed(0.0))],
        "threads": lambda: [final(threads=number) for number in (1, 2, 4)],
        "skin": lambda: [final(skin=skin) for skin in (0.002, 0.02)],
        "restart": lambda: [final(), final(start=final(until=half))],
    }
    if what not in ways:
        raise ValueError(f"with.what={what} is unknown; choose weightless, {', '.join(ways)}")
    runs = ways[what]()
    off = float(sum(differing(runs[0], run) for run in runs[1:]))
    return Observation({"differing": off, "moved": farthest(bed.position, runs[0].position)})


TURN = np.radians(40.0)  # no multiple of an angle that a lattice could know
# What a drum looks like in other axes: matrices of a vector.
IMAGES = {
    "backwards": np.diag([-1.0, 1.0, 1.0]),
    "mirrored": np.diag([1.0, -1.0, 1.0]),
    "turned": np.array([[np.cos(TURN), 0, np.sin(TURN)], [0, 1, 0], [-np.sin(TURN), 0, np.cos(TURN)]]),
}


def image(
    what: str, scene: Scene, state: ParticleState
) -> tuple[Scene, ParticleState, Callable[[FloatArray], FloatArray]]:
    """A moving drum and its bed, turned (with gravity), mirrored along the axis or across it, or renumbered.

    Args:
        what: ``turned``, ``mirrored``, ``backwards`` (the mirror image across the axis, which turns the other way) or
            ``renumbered``.
        scene, state: as they are.

    Returns:
        Scene and state, and what brings positions back, ``(N, 3)`` m.
    """
    if what == "renumbered":
        order = np.random.default_rng(3).permutation(state.count)
        names = (*STATE_ARRAYS, "radius", "material")
        changed = replace(state, **{name: getattr(state, name)[order] for name in names})
        return scene, changed, lambda position: position[np.argsort(order)]
    linear = IMAGES[what]
    vectors = {name: getattr(state, name) @ linear.T for name in STATE_ARRAYS}
    vectors["angular_velocity"] *= np.sign(np.linalg.det(linear))  # spins are axial vectors
    if what == "backwards":
        scene = scene.at_speed(-scene.rotation.speeds_rpm[-1])
    scene = replace(scene, gravity=tuple(linear @ np.array(scene.gravity)))
    return scene, replace(state, **vectors), lambda position: position @ linear


def alike(bench: Bench, what: str) -> Observation:
    """Two ways that must agree to a stated rounding: positions after five frames of ``drum_small``.

    ``what`` is ``backwards``, ``turned`` or ``renumbered`` as in `image`, ``float32`` (of the contact forces) or
    ``engines`` (numpy beside numba).
    """
    place, bed = bed_in_place(bench, "drum_small", 30.0)
    bed = replace(bed, history=ContactHistory.empty())  # both runs begin with contacts that remember nothing
    dems = {"float32": DemConfig(precision="float32"), "engines": DemConfig(engine="numpy")}
    if what not in {*dems, *IMAGES, "renumbered"}:
        raise ValueError(f"with.what={what} is unknown; choose renumbered, {', '.join([*dems, *IMAGES])}")
    end = place.start_time + 5 * place.frame_interval
    one = simulate(place, bed, end).final.position
    there, start, back = (place, bed, np.asarray) if what in dems else image(what, place, bed)
    other = back(simulate(there, start, end, dem=dems.get(what)).final.position)
    return Observation({"position_off": farthest(one, other), "moved": farthest(bed.position, one)})


BEDS = {
    "turning_bed": Experiment(turning_bed, BED_UNITS | {"overlap": "d", "spheres": "spheres"}),
    "bit_identical": Experiment(bit_identical, {"differing": "numbers", "moved": "m"}),
    "alike": Experiment(alike, {"position_off": "m", "moved": "m"}),
}
