"""A bed under stress, of the DEM or of a surrogate: what is wrong is counted, what must not change is compared."""

from collections.abc import Callable
from dataclasses import replace
from itertools import count, islice
from typing import Any

import numpy as np
import torch

from gran_bench.compose import checked_config, compose
from gran_bench.config import BoundaryConfig, DemConfig, TrainConfig
from gran_bench.config.reading import read_config
from gran_bench.dataset import CaseSpec, read_settled
from gran_bench.dataset.generation import Job
from gran_bench.dem.simulate import simulate
from gran_bench.files import locked
from gran_bench.metrics.bed import rotational_energy, sphere_masses, translational_energy
from gran_bench.metrics.outside import count_failures, counted, distance_outside
from gran_bench.scene import Scene
from gran_bench.shipped import shipped_scene
from gran_bench.state import ContactHistory, FloatArray, ParticleState, Trajectory
from gran_bench.stress.expectation import Bench, Experiment, Observation
from gran_bench.surrogate.rollout import Rollout, rollout, step_frames
from gran_bench.surrogate.step import Surrogate, build_model

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
    """A shipped scene and its settled bed, at the time when the scene starts.

    ``speed_rpm`` is a constant speed, or None for the scene's own motion; ``changes`` of keys come before the bed
    settles, ``then`` after that.
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


def deepest_overlap(diagnostics: dict[str, FloatArray]) -> float:
    """The largest overlap of a run, of pairs and walls, m."""
    return float(max(diagnostics[name].max() for name in ("overlap_peak", "wall_overlap_peak")))


def with_nan(state: ParticleState, field: str, particle: int) -> ParticleState:
    """The state with a NaN for one particle in one of its arrays."""
    values = np.array(getattr(state, field))
    values[particle] = np.nan
    return replace(state, **{field: values})


BED_UNITS = {
    "energy": "M(gD+½ω²R²)", "outside": "% of sphere states", "outside_5mm": "% of sphere states", "frames": "frames",
    "non_finite": "states",
}  # fmt: skip


def seen_of(trajectory: Trajectory, scene: Scene, bed: ParticleState) -> tuple[dict[str, float], tuple, FloatArray]:
    """What any trajectory of a bed shows: figures in `BED_UNITS`, flags, and each state's energy in `energy_scale`."""
    span = max(trajectory.frame_count - 1, 1) * scene.frame_interval
    count = count_failures(trajectory, replace(scene, end_time=scene.start_time + span))
    share = translational_energy(trajectory, scene).value / (energy_scale(scene, bed) or 1.0)
    if trajectory.angular_velocity is not None:
        share = share + rotational_energy(trajectory, scene).value / (energy_scale(scene, bed) or 1.0)
    finite = share[np.isfinite(share)]
    figures = {
        "energy": float(finite.max()) if len(finite) else 0.0,
        "outside": count.share(count.outside_radius),
        "outside_5mm": count.share(count.outside_tolerated),
        "frames": float(trajectory.frame_count),
        "non_finite": float(count.non_finite_states),
    }
    flags = []
    if count.non_finite_states:
        flags.append(f"{count.non_finite_states} of {count.states} states not finite from {count.first_non_finite:g} s")
    if count.outside_tolerated:
        flags.append(
            f"{count.share(count.outside_tolerated):.2g} % of sphere states outside by > 0.1 d, "
            f"{count.share(count.outside_radius):.2g} % ({counted(count.outside_spheres, 'sphere')}) by > r, "
            f"farthest {1e3 * count.farthest:.3g} mm"
        )
    return figures, tuple(flags), share


def turning_bed(
    bench: Bench, scene: str = "drum_small", changes: dict | None = None, then: dict | None = None,
    speed_rpm: float | None = 30.0, seconds: float = 0.5, time_step: float | None = None, unsafe: bool = False,
) -> Observation:  # fmt: skip
    """A settled bed (`bed_in_place`) that turns for some seconds; ``time_step`` (s) is the solver's choice where null.

    ``unsafe`` lets a step beyond a fifth of the contact time pass.
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
    off = sum(int((getattr(one, name) != getattr(other, name)).sum()) for name in STATE_ARRAYS)
    more = abs(len(one.history) - len(other.history))
    return off + (more or int((one.history.force != other.history.force).sum()))


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
    """A moving drum and its bed in other axes or another order, and what brings positions back, ``(N, 3)`` m.

    ``what`` is ``turned`` (with gravity), ``mirrored`` along the axis, ``backwards`` (across it, turning the other way)
    or ``renumbered``.
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


WILD = 2.0  # M (g D + ½ ω² R²): more kinetic energy than falling and turning can give, with room for a model's errors
UNITS = BED_UNITS | {"time_to_failure": "s", "horizon": "s", "failed_frame": "frames"}


def model_rollout(
    bench: Bench, scene: str = "drum", changes: dict | None = None, then: dict | None = None,
    speed_rpm: float | None = 30.0, frames: int = 400,
) -> Observation:  # fmt: skip
    """Roll the model out from a settled bed of the DEM (`bed_in_place`), for a number of frames."""
    place, bed = bed_in_place(bench, scene, speed_rpm, changes, then)
    return observed(rollout(bench.model, place, bed, frames + 1), place, bed)


def observed(result: Rollout, scene: Scene, start: ParticleState) -> Observation:
    """What a rollout did: failures told, timed and bounded; bounds hold for the finite states.

    It fails at the first state that is not finite, has a centre outside by more than a radius, or is `WILD`.
    """
    trajectory, frames = result.trajectory, result.trajectory.frame_count
    figures, flags, share = seen_of(trajectory, scene, start)
    with np.errstate(invalid="ignore"):
        positions = trajectory.position.astype(np.float64)
        beyond = np.array([distance_outside(x, trajectory.radius, scene) for x in positions]) - trajectory.radius
        outside = np.where(np.isfinite(beyond), beyond, -np.inf).max(axis=1, initial=-np.inf)
        failed = ~np.isfinite(share) | (share > WILD) | (outside > 0.0)
    if result.failed_frame is not None:
        flags = (f"failed at frame {result.failed_frame}: not finite", *flags)
    if figures["energy"] > WILD:
        flags = (*flags, f"kinetic energy up to {figures['energy']:.3g} M(gD+½ω²R²)")
    # A state that is not finite must lie at or after the frame that the rollout itself calls failed.
    told = frames if result.failed_frame is None else result.failed_frame
    horizon = scene.frame_interval * (frames - 1)
    until = scene.frame_interval * int(np.argmax(failed)) if failed.any() else horizon
    figures |= {"time_to_failure": until, "horizon": horizon, "failed_frame": float(told)}
    curves = {"speed_rpm": [scene.rotation.speeds_rpm[-1]], "time_to_failure": [until], "horizon": [horizon]}
    curves["survived"] = [float(not failed.any())]
    return Observation(figures, flags, curves, int((~np.isfinite(share[:told])).sum()))


def untrained_rollout(
    bench: Bench, model: str, scene: str = "drum_small", speed_rpm: float = 40.0, frames: int = 100
) -> Observation:
    """Roll out a model of the default configuration with random weights, which must fail: whether it is seen is tested.

    ``model`` is ``contact``, ``radial``, ``ccnn`` or ``gns``.
    """
    config = checked_config(compose("train", [f"model={model}"]), TrainConfig)
    torch.manual_seed(0)
    built = build_model(config.model, read_config(BoundaryConfig, vars(config.boundary)), shipped_scene(scene)).eval()
    return model_rollout(replace(bench, model=built), scene, speed_rpm=speed_rpm, frames=frames)


def model_nan(bench: Bench, frame: int) -> Observation:
    """A NaN in the state that the model is given at a frame of twenty: it must show from the next one on, for good."""
    asked = count()

    def poison(_: Surrogate, inputs: tuple[Any, ...]) -> tuple[Any, ...]:
        state, *others = inputs
        if next(asked) == frame:
            position = state.position.clone()
            position[len(position) // 2, 1] = torch.nan
            state = replace(state, position=position)
        return state, *others

    hook = bench.model.register_forward_pre_hook(poison)
    try:
        return model_rollout(bench, "drum_small", frames=20)
    finally:
        hook.remove()


def model_start(bench: Bench, field: str) -> Observation:
    """A start state with a NaN in one of its fields."""
    place, bed = bed_in_place(bench, "drum_small", 30.0)
    return observed(rollout(bench.model, place, with_nan(bed, field, 0), 3), place, bed)


def model_symmetry(bench: Bench, what: str) -> Observation:
    """Transform the state as `image` does, step a frame, transform back: is every sphere where it was?

    Twenty frames of the model come before, so that the bed moves; a memory, if it has one, begins anew after them.
    """
    if what not in ("renumbered", "turned", "mirrored"):
        raise ValueError(f"with.what={what} is unknown; choose renumbered, turned or mirrored")
    place, bed = bed_in_place(bench, "drum_small", 40.0)
    motion = rollout(bench.model, place, bed, 21).trajectory
    spin = np.zeros_like(motion.position) if motion.angular_velocity is None else motion.angular_velocity
    last = (np.asarray(values[-1], np.float64) for values in (motion.position, motion.velocity, spin))
    state = ParticleState(*last, bed.radius, time=float(motion.time[-1]))
    there, changed, back = image(what, place, state)

    def ahead(scene: Scene, start: ParticleState) -> FloatArray:
        _, frame = islice(step_frames(bench.model, scene, start), 2)
        return frame.position.cpu().numpy().astype(np.float64)

    one, other = ahead(place, state), back(ahead(there, changed))
    return Observation({"position_off": farthest(one, other), "moved": farthest(state.position, one)})


def model_threads(bench: Bench) -> Observation:
    """One, two and four threads of torch: how many numbers of a rollout over twenty frames differ."""
    (place, bed), before, runs = bed_in_place(bench, "drum_small", 40.0), torch.get_num_threads(), []
    try:
        for number in (1, 2, 4):
            torch.set_num_threads(number)
            runs.append(rollout(bench.model, place, bed, 21).trajectory.position)
    finally:
        torch.set_num_threads(before)
    off = float(sum((run != runs[0]).sum() for run in runs[1:]))
    return Observation({"differing": off, "moved": farthest(runs[0][0], runs[0][-1])})


BEDS = {
    "turning_bed": Experiment(turning_bed, BED_UNITS | {"overlap": "d", "spheres": "spheres"}),
    "bit_identical": Experiment(bit_identical, {"differing": "numbers", "moved": "m"}),
    "alike": Experiment(alike, {"position_off": "m", "moved": "m"}),
    "model_rollout": Experiment(model_rollout, UNITS, of_model=True),
    "untrained_rollout": Experiment(untrained_rollout, UNITS),
    "model_nan": Experiment(model_nan, UNITS, of_model=True),
    "model_start": Experiment(model_start, UNITS, of_model=True),
    "model_symmetry": Experiment(model_symmetry, {"position_off": "m", "moved": "m"}, of_model=True),
    "model_threads": Experiment(model_threads, {"differing": "numbers", "moved": "m"}, of_model=True),
}
