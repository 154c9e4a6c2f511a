"""A trajectory of another code becomes a case: what is missing is derived and said, what is inconsistent is named."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

import gran_bench
from gran_bench.config.rules import Name, checked_value, positive
from gran_bench.dataset import CaseSpec, DatasetError, to_document
from gran_bench.dataset.case_file import write_case
from gran_bench.dataset.case_spec import FORMAT_VERSION, key_hash
from gran_bench.dataset.imported import ENGINE
from gran_bench.dem.engine_numpy import Stretch
from gran_bench.dem.initial_checks import LARGEST_INITIAL_OVERLAP
from gran_bench.dem.integrate import Physics
from gran_bench.dem.outlet import part_of, taking_part
from gran_bench.dem.record import contact_diagnostics, inertias
from gran_bench.dem.walls import largest_excess, wall_poses
from gran_bench.neighbors import nearest_image
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, ParticleState, Trajectory

FOLDER = "imported"  # of the cases, in the data cache
ROUNDING = 1e-4  # of the frame interval and of a radius: text dumps round
MOVES = 1e-3  # radii from frame to frame: less may be the rounding of a dump
TIMES_APART = 1.5  # by which positions and velocities may differ in how fast spheres move


def import_arrays(
    position: FloatArray,
    scene: Scene,
    *,
    time: FloatArray | None = None,
    frame_interval: float | None = None,
    velocity: FloatArray | None = None,
    angular_velocity: FloatArray | None = None,
    radius: FloatArray | None = None,
    type: Sequence[int] | None = None,  # the word of the other codes
    id: Sequence[int] | None = None,
    packing: int = 0,
    replica: int = 0,
    name: str | None = None,
    root: Path | str = "data",
    source: str = "arrays",
    tell: Callable[[str], None] = print,
) -> Path:
    """Write a trajectory of another code as a case, which trains and is judged like those of the DEM.

    Derived where missing, and said: velocities (central differences), spins (zero), radii (the scene's), times
    (``frame_interval``). The reference engine finds overlaps and energies. The first frame, at the scene's
    ``start_time``, is the settled state, whose contacts remember nothing. The scene gets the data's count and span.

    Args:
        position: ``(F, N, 3)`` m.
        scene: container, motion, material, diameter.
        time: ``(F,)`` s, equally spaced.
        frame_interval: s, where there is no ``time``.
        velocity, angular_velocity: ``(F, N, 3)`` m/s, rad/s.
        radius: ``(N,)`` m, or ``(F, N)``, which must not change.
        type: ``(N,)``; the k-th smallest is the scene's k-th material.
        id: ``(N,)`` names of the spheres for the messages.
        packing: number of the settled bed that it started from, for ``dataset.packing_seed``.
        replica: 0, or the number of a run from the same start, nudged: replicas give the noise floor.
        name: of the file, which is the answer; None: scene, speed, packing, replica and a hash.
        root: data cache; the case goes into its folder ``imported``.
        source: where the trajectory comes from, for the record.
        tell: gets a line for whatever was derived, and for each warning.

    Raises:
        DatasetError: what is no trajectory of spheres in this scene, with frame and id.
        StateError: arrays whose shapes do not fit.
        ConfigError: an argument of a wrong type.
    """
    spec = CaseSpec(scene, packing_seed=packing, nudge=float(replica != 0), nudge_seed=replica)
    checked_value(str | None, Name(), name, "name")
    said: list[str] = []
    if len(position) < 3:
        raise DatasetError(f"position has {len(position)} frames; give three or more")
    ticks, sizes = range(len(position)), np.ones(np.shape(position[0])[:1])
    motion = Trajectory(ticks, position, position if velocity is None else velocity, angular_velocity, sizes)
    position, (frames, count, _) = motion.position.astype(np.float64), motion.position.shape
    given = {"velocity": velocity, "angular_velocity": angular_velocity}
    moving = {key: getattr(motion, key).astype(np.float64) for key in given if given[key] is not None}
    scene, theirs = _timed(scene, time, frames, frame_interval, said)
    scene = replace(scene, filling=replace(scene.filling, count=count))
    names = np.arange(count) if id is None else np.asarray(id)

    def refuse(bad: np.ndarray, what: str) -> None:
        if bad.any():
            frame = int(np.argmax(bad.any(axis=1)))
            found = names[bad[frame]]
            more = f" and {len(found) - 1} more" if len(found) > 1 else ""
            raise DatasetError(f"frame {frame} ({theirs[frame]:g} s): id {found[0]}{more} has {what}")

    for key, values in {"position": position, **moving}.items():
        refuse(~(abs(values) < np.finfo(np.float32).max).all(axis=2), f"a {key} that is not finite; repair it")
    radius, material = _radii(scene, radius, frames, refuse, said), _materials(scene, type, count)
    step = nearest_image(np.diff(position, axis=0).reshape(-1, 3), scene.period).reshape(-1, count, 3)
    if "velocity" in moving:
        _check_clock(step, moving["velocity"], scene.frame_interval, radius)
    else:
        path = np.concatenate([position[:1], position[:1] + np.cumsum(step, axis=0)])
        moving["velocity"] = np.gradient(path, scene.frame_interval, axis=0, edge_order=2)
        said.append("velocities are central differences of the positions, which smooth impacts")
    if "angular_velocity" not in moving:
        moving["angular_velocity"] = np.zeros_like(position)
        said.append("spins are zero, for the data have none: train a model that predicts spin with loss.spin=0")
    position = nearest_image(position.reshape(-1, 3), scene.period).reshape(position.shape)
    clock = scene.start_time + scene.frame_interval * np.arange(frames)
    poses, physics = wall_poses(scene, clock[0], scene.frame_interval, frames - 1), Physics.of(scene, radius.max())
    beyond, figures = np.zeros((frames, count), bool), []
    rows = zip(position, *(moving[key] for key in given), strict=True)
    states = [ParticleState(*row, radius, clock[k], material=material) for k, row in enumerate(rows)]
    for k, state in enumerate(states):
        inside = taking_part(scene, state.position)
        part = part_of(state, inside)
        beyond[k] = (largest_excess(scene, poses[k], state.position) > radius) & inside
        with np.errstate(divide="ignore", invalid="ignore"):  # two centres in one place have no normal
            overlaps = Stretch(part, physics, 1.0, poses[k : k + 1]).overlaps() if part.count else (np.zeros(0),) * 2
        instant = state.position, state.velocity, state.angular_velocity
        figures.append(contact_diagnostics(scene, inertias(scene, state), instant, overlaps))
    refuse(
        beyond,
        f"its centre outside the walls of scene {scene.name!r} by more than its radius; give the container of the data "
        "(a drum lies along y, and gravity is scene.gravity)",
    )
    diagnostics = {key: np.array([row[key] for row in figures]) for key in figures[0]}
    deepest = np.maximum(diagnostics["overlap_max"], diagnostics["wall_overlap_max"]) / (2.0 * radius.mean())
    warnings = f"spheres overlap by {deepest.max():.0%} of the diameter in frame {np.argmax(deepest)}: are radius and "
    warnings = f"{warnings}container those of the data?" if deepest.max() > LARGEST_INITIAL_OVERLAP else ""
    unknown = "unknown: the settled state is the first frame, without what its contacts remember"
    facts = {"engine": ENGINE, "imported_from": source, "derived": "\n".join(said), "contact_history": unknown}
    facts |= {"packing_seed": packing, "nudge_seed": replica, "warnings": warnings}
    facts |= dict.fromkeys(("time_step", "wall_seconds"), np.nan)  # of the other code: not known
    facts |= {"code_version": gran_bench.__version__, "made_at": datetime.now(UTC).isoformat(timespec="seconds")}
    arrays = hashlib.sha256(b"".join(values.tobytes() for values in (position, *moving.values(), radius, material)))
    key = {"kind": ENGINE, "format": FORMAT_VERSION, "scene": to_document(scene), "arrays": arrays.hexdigest()}
    file = Path(root) / FOLDER / f"{name or f'{spec.label}_{key_hash(key)}'}.h5"
    trajectory = Trajectory(clock, position, **moving, radius=radius, diagnostics=diagnostics)
    write_case(file, key, scene, trajectory, states[0], facts)
    for line in (*said, *([f"warning: {warnings}"] if warnings else [])):
        tell(line)
    return file


def _timed(scene: Scene, time: Any, frames: int, interval: float | None, said: list[str]) -> tuple[Scene, FloatArray]:
    """The scene with the span of the data, and the times of the data."""
    if time is None:
        if interval is None:
            raise DatasetError("the data have no times; give --frame-interval, s")
        time = scene.start_time + checked_value(float, positive("s"), interval, "frame_interval") * np.arange(frames)
        said.append(f"times are {interval:g} s apart, as --frame-interval says")
    time = np.asarray(time, np.float64)
    if time.shape != (frames,):
        raise DatasetError(f"time has shape {time.shape}; give {frames} times, s")
    step = np.diff(time)
    usual = float(np.median(step))
    odd = ~((step > 0) & (abs(step - usual) <= ROUNDING * usual))
    if odd.any():
        k = int(np.argmax(odd))
        raise DatasetError(
            f"frames are out of order or not equally spaced: frame {k + 1} at {time[k + 1]:g} s comes {step[k]:g} s "
            f"after the last and others {usual:g} s; give frames in order, of one interval"
        )
    usual = float(f"{(time[-1] - time[0]) / (frames - 1):.9g}")  # without the rounding of a sum of steps
    if abs(scene.start_time - time[0]) > ROUNDING * usual:
        said.append(f"{time[0]:g} s of the data is the scene's start_time={scene.start_time:g} s")
    end = float(f"{scene.start_time + usual * (frames - 1):.12g}")
    return replace(scene, frame_interval=usual, end_time=end), time


def _check_clock(step: FloatArray, velocity: FloatArray, interval: float, radius: FloatArray) -> None:
    """Refuses times with which the spheres would move at another pace than their velocities say.

    Compared are |Δx|/Δt and |v̄|, the mean of both ends, where a sphere moves and no impact changes its velocity by
    half of that or more: between impacts both are one.
    """
    shown, said = np.linalg.norm(step, axis=2), np.linalg.norm(0.5 * (velocity[1:] + velocity[:-1]), axis=2) * interval
    steady = np.linalg.norm(np.diff(velocity, axis=0), axis=2) * interval <= 0.5 * said
    compared = steady & (np.maximum(shown, said) > MOVES * radius)
    if not compared.any():
        return
    with np.errstate(divide="ignore"):
        ratio = float(np.median(shown[compared] / said[compared]))
    if not 1.0 / TIMES_APART <= ratio <= TIMES_APART:
        right = f"frames {ratio * interval:.3g} s apart would agree: " if 0.0 < ratio < np.inf else ""
        raise DatasetError(
            f"at frames {interval:g} s apart the positions move {ratio:.2g} times as fast as the velocities say "
            f"(median of the spheres that move); {right}correct --time-step (or --frame-interval), or leave the "
            "velocities out"
        )


def _radii(scene: Scene, radius: Any, frames: int, refuse: Callable, said: list[str]) -> FloatArray:
    filling, low, high = scene.filling, scene.filling.smallest_radius, scene.filling.largest_radius
    if radius is None and low < high:
        raise DatasetError("the data lack radius, and the scene's spheres have several; give radii")
    if radius is None:
        said.append(f"radii are half of scene.filling.diameter={filling.diameter:g} m")
        return np.full(filling.count, filling.radius)
    radius = np.asarray(radius, np.float64)
    if radius.shape not in ((filling.count,), (frames, filling.count)):
        raise DatasetError(f"radius has shape {radius.shape}; give one for each of {filling.count} spheres, m")
    radius = np.broadcast_to(radius, (frames, filling.count))
    within = (radius >= low * (1 - ROUNDING)) & (radius <= high * (1 + ROUNDING))
    refuse(~within, f"a radius that is not in the scene's {low:g} to {high:g} m; set scene.filling.diameter and sizes")
    refuse(abs(radius / radius[0] - 1.0) > ROUNDING, "another radius than in frame 0; give spheres that keep theirs")
    # A dump rounds, and a model is asked for exactly the radius that it was trained on.
    return radius[0].copy() if low < high else np.full(filling.count, filling.radius)


def _materials(scene: Scene, kind: Any, count: int) -> np.ndarray:
    kinds, index = np.unique(np.zeros(count) if kind is None else np.asarray(kind), return_inverse=True)
    if index.shape != (count,) or len(kinds) > len(scene.materials):
        raise DatasetError(
            f"spheres of the types {', '.join(f'{k:g}' for k in kinds)} and a scene with {len(scene.materials)} "
            "material; choose the spheres with --type, or give scene.second_material"
        )
    return index.astype(np.uint8)
