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
from gran_bench.metrics.energy import rotational_energy, sphere_masses, translational_energy
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
    mass = sphere_masses(trajectory.radius, scene.material.density)
    energy, spin = translational_energy(trajectory.time, trajectory.velocity, mass).value, trajectory.angular_velocity
    return energy if spin is None else energy + rotational_energy(trajectory.time, spin, mass, trajectory.radius).value


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
    changes: dict | None = None,
    then: dict | None = None,
    speed_rpm: float | None = 30.0,
    seconds: float = 0.5,
    time_step: float | None = None,
    unsafe: bool = False,
    engine: str = "numba",
) -> Observation:
    """A settled bed that is turned.

    Args:
        scene, changes, then, speed_rpm: as in `bed_in_place`.
        seconds: simulated.
        time_step: s; the solver's choice where null.
        unsafe: whether a step beyond a fifth of the contact time is let through.
        engine: of the DEM.
    """
    place, bed = bed_in_place(bench, scene, speed_rpm, changes, then)
    dem, end = DemConfig(engine=engine, time_step=time_step, allow_unsafe_step=unsafe), place.start_time + seconds
    result = simulate(place, bed, end, dem=dem)
    count = count_failures(result.trajectory, replace(place, end_time=end))
    energy, scale = float(kinetic_energy(result.trajectory, place).max()), energy_scale(place, bed)
    deepest = deepest_overlap(result.trajectory.diagnostics)
    quantities = {
        "energy": energy / scale if scale else energy,
        "outside": count.share(count.outside_radius),
        "outside_5mm": count.share(count.outside_tolerated),
        "overlap": deepest / float(2.0 * bed.radius.min()) if bed.count else 0.0,
        "frames": float(result.trajectory.frame_count),
        "spheres": float(bed.count),
        "non_finite": float(count.non_finite_states),
    }
    return Observation(quantities, (*result.warnings, *escapes(count)))


def differing(one: ParticleState, other: ParticleState) -> int:
    """How many numbers of two states, contact forces included, are not the same to the last bit."""
    count = sum(int((getattr(one, name) != getattr(other, name)).sum()) for name in STATE_ARRAYS)
    if len(one.history) != len(other.history):
        return count + abs(len(one.history) - len(other.history))
    return count + int((one.history.force != other.history.force).sum())


def farthest(one: FloatArray, other: FloatArray) -> float:
    """The largest distance of a particle's two positions, ``(N, 3)`` m each."""
    return float(np.linalg.norm(other - one, axis=1).max())


def bit_identical(bench: Bench, what: str, scene: str = "drum_small", frames: int = 10) -> Observation:
    """Two ways to say the same, which must give the same to the last bit.

    Args:
        what: ``threads`` (1, 2 and 4), ``rest`` (0 rpm beside no motion), ``weightless`` (a bed that settles without
            gravity stays where it is put), ``restart`` (from a frame in the middle), ``skin`` (2 and 20 mm).
        scene: shipped one.
        frames: to run.
    """
    still = shipped_scene(scene)
    if what == "weightless":
        still = replace(still, gravity=(0.0, 0.0, 0.0))
        put = replace(still.fresh_filling(0), time=still.start_time)
        return Observation({"differing": float(differing(settled_bed(bench, still), put)), "moved": 0.0})
    place, bed = still.at_speed(30.0), settled_bed(bench, still)
    half, end = (place.start_time + number * place.frame_interval for number in (frames // 2, frames))

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


def alike(bench: Bench, what: str, scene: str = "drum_small", frames: int = 5) -> Observation:
    """Two ways that must agree to a stated rounding: positions at the end.

    Args:
        what: ``backwards``, ``turned`` or ``renumbered`` as in `image`, ``float32`` (of the contact forces),
            ``engines`` (numpy beside numba).
        scene: shipped one.
        frames: to run.
    """
    place, bed = bed_in_place(bench, scene, 30.0)
    bed = replace(bed, history=ContactHistory.empty())  # both runs begin with contacts that remember nothing
    dems = {"float32": DemConfig(precision="float32"), "engines": DemConfig(engine="numpy")}
    if what not in {*dems, *IMAGES, "renumbered"}:
        raise ValueError(f"with.what={what} is unknown; choose renumbered, {', '.join([*dems, *IMAGES])}")
    end = place.start_time + frames * place.frame_interval
    one = simulate(place, bed, end).final.position
    there, start, back = (place, bed, np.asarray) if what in dems else image(what, place, bed)
    other = back(simulate(there, start, end, dem=dems.get(what)).final.position)
    return Observation({"position_off": farthest(one, other), "moved": farthest(bed.position, one)})


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
