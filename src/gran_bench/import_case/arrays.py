"""A trajectory of another code becomes a case: what is missing is derived and said, what is inconsistent is named."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

import gran_bench
from gran_bench.config import SEED
from gran_bench.config.rules import Name, checked_value, positive
from gran_bench.dataset import CaseSpec, DatasetError, to_document
from gran_bench.dataset.case_file import write_case
from gran_bench.dataset.case_spec import FORMAT_VERSION, key_hash
from gran_bench.dataset.imported import ENGINE
from gran_bench.dem.initial_checks import LARGEST_INITIAL_OVERLAP
from gran_bench.dem.outlet import taking_part
from gran_bench.dem.record import contact_diagnostics
from gran_bench.dem.seams import wall_touching
from gran_bench.dem.walls import largest_excess, wall_poses
from gran_bench.neighbors import nearest_image, tree_pairs
from gran_bench.scene import Scene
from gran_bench.state import ContactHistory, FloatArray, ParticleState, Trajectory

FOLDER = "imported"  # of the cases, in the data cache
SAME_TIME = 1e-4  # of the frame interval: text dumps round their times
SAME_RADIUS = 1e-5  # relative: text dumps round to six digits

Tell = Callable[[str], None]


def import_arrays(
    position: FloatArray,
    scene: Scene,
    *,
    time: FloatArray | None = None,
    velocity: FloatArray | None = None,
    angular_velocity: FloatArray | None = None,
    radius: FloatArray | None = None,
    type: Sequence[int] | None = None,  # the other codes' word
    id: Sequence[int] | None = None,
    frame_interval: float | None = None,
    packing: int = 0,
    replica: int = 0,
    name: str | None = None,
    root: Path | str = "data",
    source: str = "arrays",
    seconds: float = np.nan,
    tell: Tell = print,
) -> Path:
    """Write a trajectory of another code as a case, which trains and is judged like those of the DEM.

    Derived where it is missing, and said: velocities from central differences, spins of zero, radii from the scene,
    times from ``frame_interval``. Overlaps and energies of each frame are computed as the DEM does. The first frame
    gets the scene's ``start_time`` and is the settled state; what its contacts remember is not known. The scene takes
    count, frame interval and end from the data.

    Args:
        position: ``(F, N, 3)`` m.
        scene: container, motion, material, diameter.
        time: ``(F,)`` s, equally spaced.
        velocity, angular_velocity: ``(F, N, 3)`` m/s, rad/s.
        radius: ``(N,)`` m, or ``(F, N)``, which must not change.
        type: ``(N,)``; the k-th smallest is the scene's k-th material.
        id: ``(N,)`` names of the spheres for the messages.
        frame_interval: s, where there is no ``time``.
        packing: number of the settled bed that it started from, for ``dataset.packing_seed``.
        replica: 0, or the number of a run of the same start, nudged: replicas give the noise floor.
        name: of the file; None: scene, speed, packing, replica.
        root: data cache; the case is written into its folder ``imported``.
        source: where the trajectory comes from, for the record.
        seconds: wall time that it took the other code, s, where it is known.
        tell: gets a line for whatever was derived.

    Returns:
        The file.

    Raises:
        DatasetError: what is no trajectory of spheres in this scene, with frame and id.
        ConfigError: an argument of a wrong type.
    """
    for number, word in ((packing, "packing"), (replica, "replica")):
        checked_value(int, SEED, number, word)
    checked_value(str | None, Name(), name, "name")
    checked_value(Scene, None, scene, "scene")
    said: list[str] = []
    position = _series("position", position, np.shape(position))
    frames, count = position.shape[:2]
    names = np.arange(count) if id is None else np.asarray(id)
    given = {"velocity": velocity, "angular_velocity": angular_velocity}
    moving = {key: _series(key, values, position.shape) for key, values in given.items() if values is not None}
    scene, shift = _timed(scene, time, frames, frame_interval, said)
    clock = scene.start_time + scene.frame_interval * np.arange(frames)
    for key, values in {"position": position, **moving}.items():
        _refuse(~np.isfinite(values).all(axis=2), names, clock - shift, f"a {key} that is not finite; repair it")
    scene = replace(scene, filling=replace(scene.filling, count=count))
    radius, material = _radii(scene, radius, names, frames, clock - shift, said), _materials(scene, type, count)
    path = position
    if scene.period:
        step = nearest_image(np.diff(position, axis=0).reshape(-1, 3), scene.period).reshape(-1, count, 3)
        path = np.concatenate([position[:1], position[:1] + np.cumsum(step, axis=0)])
        position = nearest_image(position.reshape(-1, 3), scene.period).reshape(position.shape)
    if "velocity" not in moving:
        moving["velocity"] = np.gradient(path, scene.frame_interval, axis=0, edge_order=2)
        said.append("velocities are central differences of the positions, which smooth impacts")
    if "angular_velocity" not in moving:
        moving["angular_velocity"] = np.zeros_like(position)
        said.append("spins are zero, for the data have none: train a model that predicts spin with loss.spin=0")
    poses = wall_poses(scene, scene.start_time, scene.frame_interval, frames - 1)
    _refuse_outside(scene, poses, position, radius, names, clock - shift)
    states = [
        ParticleState(
            position[k], moving["velocity"][k], moving["angular_velocity"][k], radius, clock[k], material=material
        )
        for k in range(frames)
    ]
    states = [replace(state, history=touching(scene, poses[k], state)) for k, state in enumerate(states)]
    figures = [contact_diagnostics(scene, state) for state in states]
    diagnostics = {key: np.array([row[key] for row in figures]) for key in figures[0]}
    warnings = _deep(diagnostics, radius)
    settled = replace(states[0], history=ContactHistory.empty())
    trajectory = Trajectory(clock, position, **moving, radius=radius, diagnostics=diagnostics)
    facts = {
        "engine": ENGINE,
        "imported_from": source,
        "derived": "\n".join(said),
        "contact_history": "unknown: the settled state is the first frame, without what its contacts remember",
        "packing_seed": packing,
        "nudge_seed": replica,
        "time_step": np.nan,  # of the other code: not known here
        "wall_seconds": float(seconds),
        "warnings": "\n".join(warnings),
        "code_version": gran_bench.__version__,
        "machine": platform.platform(),
        "made_at": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    digest = hashlib.sha256()
    for values in (position, *moving.values(), radius, material):
        digest.update(np.ascontiguousarray(values).tobytes())
    key = {"kind": ENGINE, "format": FORMAT_VERSION, "scene": to_document(scene), "arrays": digest.hexdigest()}
    label = name or CaseSpec(scene, packing_seed=packing).label + (f"_replica{replica}" if replica else "")
    file = Path(root) / FOLDER / (f"{label}.h5" if name else f"{label}_{key_hash(key)}.h5")
    write_case(file, key, scene, trajectory, settled, facts)
    for line in (*said, *(f"warning: {line}" for line in warnings)):
        tell(line)
    return file


def touching(scene: Scene, poses: FloatArray, state: ParticleState) -> ContactHistory:
    """The contacts of a state with their overlaps, as the DEM finds them, and no forces.

    Args:
        scene: its period and its outlet.
        poses: ``(W, 22)`` of its walls at this instant.
        state: N spheres.
    """
    inside = taking_part(scene, state.position)
    here = np.arange(state.count) if inside is None else np.flatnonzero(inside)
    position, radius = state.position[here], state.radius[here]
    pairs = tree_pairs(position, 2.0 * float(radius.max(initial=0.0)), scene.period)
    offset = nearest_image(position[pairs[:, 1]] - position[pairs[:, 0]], scene.period)
    overlap = radius[pairs].sum(axis=1) - np.linalg.norm(offset, axis=1)
    near = overlap > 0
    first, second, depth = [here[pairs[near, 0]]], [here[pairs[near, 1]]], [overlap[near]]
    for wall, found in enumerate(wall_touching(poses, position, radius, ContactHistory.empty())[0]):
        first.append(here[found.sphere])
        second.append(np.full(len(found.sphere), -1 - wall))
        depth.append(radius[found.sphere] - found.distance)
    many = sum(map(len, first))
    return ContactHistory(np.concatenate(first), np.concatenate(second), np.zeros((many, 3)), np.concatenate(depth))


def _series(name: str, values: Any, shape: tuple[int, ...]) -> FloatArray:
    values = np.asarray(values)
    if values.dtype.kind not in "iuf" or values.ndim != 3 or values.shape != shape:
        raise DatasetError(f"{name} has shape {values.shape} of {values.dtype}; give numbers of shape (F, N, 3)")
    if shape[2] != 3:
        raise DatasetError(f"{name} has {shape[2]} dimensions; scenes are of spheres in three, so give (F, N, 3)")
    if shape[0] < 3 or shape[1] < 1:
        raise DatasetError(f"{name} has {shape[0]} frames of {shape[1]} spheres; give three frames or more")
    return values.astype(np.float64)


def _timed(
    scene: Scene, time: FloatArray | None, frames: int, interval: float | None, said: list[str]
) -> tuple[Scene, float]:
    """The scene with the span of the data, and how much its clock is ahead of theirs, s."""
    if time is None:
        if interval is None:
            raise DatasetError("the data have no times; give --frame-interval, s")
        checked_value(float, positive("s"), interval, "frame_interval")
        time = scene.start_time + interval * np.arange(frames)
        said.append(f"times are {interval:g} s apart, as --frame-interval says")
    time = np.asarray(time, np.float64)
    if time.shape != (frames,) or not np.isfinite(time).all():
        raise DatasetError(f"time has shape {time.shape}; give {frames} finite times, s")
    step = np.diff(time)
    back = np.flatnonzero(step <= 0)
    if len(back):
        k = back[0] + 1
        raise DatasetError(
            f"frames are out of order: frame {k} at {time[k]:g} s follows frame {k - 1} at {time[k - 1]:g} s; sort them"
        )
    usual = float(np.median(step))
    odd = np.flatnonzero(abs(time - time[0] - usual * np.arange(frames)) > SAME_TIME * usual)
    if len(odd):
        k = odd[0]
        raise DatasetError(
            f"frames are not equally spaced: frame {k} at {time[k]:g} s comes {time[k] - time[k - 1]:g} s after the "
            f"last, the others {usual:g} s; write every frame, or cut the span (--from, --until)"
        )
    usual = float(f"{(time[-1] - time[0]) / (frames - 1):.9g}")  # without the rounding of a sum of steps
    shift = scene.start_time - float(time[0])
    if abs(shift) > SAME_TIME * usual:
        said.append(f"{time[0]:g} s of the data is the scene's start_time={scene.start_time:g} s")
    end = scene.start_time + usual * (frames - 1)
    return replace(scene, frame_interval=usual, end_time=float(f"{end:.12g}")), shift


def _radii(scene: Scene, radius: Any, names: np.ndarray, frames: int, clock: FloatArray, said: list[str]) -> FloatArray:
    filling, count = scene.filling, len(names)
    alike = filling.smallest_radius == filling.largest_radius
    if radius is None:
        if not alike:
            raise DatasetError("the data lack radius, and the scene's spheres have several; give radii")
        said.append(f"radii are half of scene.filling.diameter={filling.diameter:g} m")
        return np.full(count, filling.radius)
    radius = np.asarray(radius, np.float64)
    if radius.shape not in ((count,), (frames, count)):
        raise DatasetError(f"radius has shape {radius.shape}; give ({count},) or ({frames}, {count}), m")
    radius = np.broadcast_to(radius, (frames, count))
    _refuse(~(np.isfinite(radius) & (radius > 0)), names, clock, "a radius that is not positive and finite; repair it")
    changed = abs(radius / radius[0] - 1.0) > SAME_RADIUS
    _refuse(changed, names, clock, "another radius than in frame 0; spheres that change are no DEM's")
    low, high = filling.smallest_radius * (1 - SAME_RADIUS), filling.largest_radius * (1 + SAME_RADIUS)
    odd = np.flatnonzero((radius[0] < low) | (radius[0] > high))
    if len(odd):
        raise DatasetError(
            f"id {names[odd[0]]} has radius {radius[0, odd[0]]:g} m and the scene's spheres "
            f"{filling.smallest_radius:g} to {filling.largest_radius:g} m; set scene.filling.diameter (and sizes) to "
            "those of the data"
        )
    # A dump rounds, and a model is asked for exactly the radius that it was trained on.
    return np.full(count, filling.radius) if alike else radius[0].copy()


def _materials(scene: Scene, kind: Any, count: int) -> np.ndarray:
    if kind is None:
        return np.zeros(count, np.uint8)
    kinds, index = np.unique(np.asarray(kind), return_inverse=True)
    if index.shape != (count,) or len(kinds) > len(scene.materials):
        raise DatasetError(
            f"spheres of the types {', '.join(f'{k:g}' for k in kinds)} and a scene with {len(scene.materials)} "
            "material; choose the spheres with --type, or give scene.second_material"
        )
    return index.astype(np.uint8)


def _refuse_outside(
    scene: Scene, poses: FloatArray, position: FloatArray, radius: FloatArray, names: np.ndarray, clock: FloatArray
) -> None:
    excess = np.array([largest_excess(scene, *both) for both in zip(poses, position, strict=True)]) - radius
    inside = [taking_part(scene, frame) for frame in position]
    out = (excess > 0) & [np.ones(len(radius), bool) if part is None else part for part in inside]
    depth = f"its centre outside the walls of scene {scene.name!r} by more than its radius"
    _refuse(
        out, names, clock, f"{depth}; give the container of the data (a drum lies along y, gravity is scene.gravity)"
    )


def _refuse(bad: np.ndarray, names: np.ndarray, clock: FloatArray, what: str) -> None:
    """Refuse data in which a sphere of a frame is bad, ``(F, N)`` bool."""
    if bad.any():
        frame = int(np.flatnonzero(bad.any(axis=1))[0])
        found = names[bad[frame]]
        more = f" and {len(found) - 1} more" if len(found) > 1 else ""
        raise DatasetError(f"frame {frame} ({clock[frame]:g} s): id {found[0]}{more} has {what}")


def _deep(diagnostics: dict[str, FloatArray], radius: FloatArray) -> list[str]:
    deepest = np.maximum(diagnostics["overlap_max"], diagnostics["wall_overlap_max"])
    worst, share = int(np.argmax(deepest)), float(deepest.max() / (2.0 * radius.mean()))
    if share < LARGEST_INITIAL_OVERLAP:
        return []
    return [
        f"spheres overlap by {share:.0%} of the diameter in frame {worst}: are radius and container those of the data?"
    ]
