"""A trajectory of another code becomes a case: what is missing is derived and said, what is inconsistent is named."""

from __future__ import annotations

import hashlib
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
ROUNDING = 1e-4  # of the frame interval and of a radius: text dumps round

Refuse = Callable[[np.ndarray, str], None]


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
    (``frame_interval``). Overlaps and energies of each frame are computed as the DEM does. The first frame gets the
    scene's ``start_time`` and is the settled state; what its contacts remember is not known. The case's scene has the
    count, frame interval and end of the data.

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
        name: of the file; None: scene, speed, packing, replica and a hash.
        root: data cache; the case goes into its folder ``imported``.
        source: where the trajectory comes from, for the record.
        tell: gets a line for whatever was derived, and for each warning.

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
    given = {"velocity": velocity, "angular_velocity": angular_velocity}
    moving = {key: _series(key, values, position.shape) for key, values in given.items() if values is not None}
    frames, count = position.shape[:2]
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
        refuse(~np.isfinite(values).all(axis=2), f"a {key} that is not finite; repair it")
    radius, material = _radii(scene, radius, frames, refuse, said), _materials(scene, type, count)
    if "velocity" not in moving:
        step = nearest_image(np.diff(position, axis=0).reshape(-1, 3), scene.period).reshape(-1, count, 3)
        path = np.concatenate([position[:1], position[:1] + np.cumsum(step, axis=0)])
        moving["velocity"] = np.gradient(path, scene.frame_interval, axis=0, edge_order=2)
        said.append("velocities are central differences of the positions, which smooth impacts")
    if "angular_velocity" not in moving:
        moving["angular_velocity"] = np.zeros_like(position)
        said.append("spins are zero, for the data have none: train a model that predicts spin with loss.spin=0")
    position = nearest_image(position.reshape(-1, 3), scene.period).reshape(position.shape)
    clock = scene.start_time + scene.frame_interval * np.arange(frames)
    poses = wall_poses(scene, scene.start_time, scene.frame_interval, frames - 1)
    beyond = np.array([largest_excess(scene, *both) for both in zip(poses, position, strict=True)]) > radius
    inside = (taking_part(scene, centre) for centre in position)
    refuse(
        beyond & [np.ones(count, bool) if part is None else part for part in inside],
        f"its centre outside the walls of scene {scene.name!r} by more than its radius; give the container of the data "
        "(a drum lies along y, and gravity is scene.gravity)",
    )
    figures = []
    for k in range(frames):
        state = ParticleState(position[k], *(moving[key][k] for key in given), radius, clock[k], material=material)
        figures.append(contact_diagnostics(scene, replace(state, history=touching(scene, poses[k], state))))
    diagnostics = {key: np.array([row[key] for row in figures]) for key in figures[0]}
    deepest = np.maximum(diagnostics["overlap_max"], diagnostics["wall_overlap_max"]) / (2.0 * radius.mean())
    warnings = ""
    if deepest.max() > LARGEST_INITIAL_OVERLAP:
        warnings = (
            f"spheres overlap by {deepest.max():.0%} of the diameter in frame {np.argmax(deepest)}: are radius and "
        )
        warnings += "container those of the data?"
    facts = {
        "engine": ENGINE,
        "imported_from": source,
        "derived": "\n".join(said),
        "contact_history": "unknown: the settled state is the first frame, without what its contacts remember",
        "packing_seed": packing,
        "nudge_seed": replica,
        **dict.fromkeys(("time_step", "wall_seconds"), np.nan),  # of the other code: not known
        "warnings": warnings,
        "code_version": gran_bench.__version__,
        "made_at": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    arrays = hashlib.sha256(b"".join(values.tobytes() for values in (position, *moving.values(), radius, material)))
    key = {"kind": ENGINE, "format": FORMAT_VERSION, "scene": to_document(scene), "arrays": arrays.hexdigest()}
    label = CaseSpec(scene, packing_seed=packing).label + (f"_replica{replica}" if replica else "")
    file = Path(root) / FOLDER / f"{name or f'{label}_{key_hash(key)}'}.h5"
    settled = ParticleState(
        position[0], *(moving[key][0] for key in given), radius, scene.start_time, material=material
    )
    trajectory = Trajectory(clock, position, **moving, radius=radius, diagnostics=diagnostics)
    write_case(file, key, scene, trajectory, settled, facts)
    for line in (*said, *([f"warning: {warnings}"] if warnings else [])):
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
    found = [(here[pairs[near, 0]], here[pairs[near, 1]], overlap[near])]
    for wall, (sphere, distance, _) in enumerate(wall_touching(poses, position, radius, ContactHistory.empty())[0]):
        found.append((here[sphere], np.full(len(sphere), -1 - wall), radius[sphere] - distance))
    first, second, overlap = map(np.concatenate, zip(*found, strict=True))
    return ContactHistory(first, second, np.zeros((len(first), 3)), overlap)


def _series(name: str, values: Any, shape: tuple[int, ...]) -> FloatArray:
    values = np.asarray(values)
    if values.dtype.kind not in "iuf" or values.ndim != 3 or values.shape != shape:
        raise DatasetError(f"{name} has shape {values.shape} of {values.dtype}; give numbers of shape (F, N, 3)")
    if shape[2] != 3:
        raise DatasetError(f"{name} has {shape[2]} dimensions; scenes are of spheres in three, so give (F, N, 3)")
    if shape[0] < 3 or shape[1] < 1:
        raise DatasetError(f"{name} has {shape[0]} frames of {shape[1]} spheres; give three frames or more")
    return values.astype(np.float64)


def _timed(scene: Scene, time: Any, frames: int, interval: float | None, said: list[str]) -> tuple[Scene, FloatArray]:
    """The scene with the span of the data, and the times of the data."""
    if time is None:
        if interval is None:
            raise DatasetError("the data have no times; give --frame-interval, s")
        time = scene.start_time + checked_value(float, positive("s"), interval, "frame_interval") * np.arange(frames)
        said.append(f"times are {interval:g} s apart, as --frame-interval says")
    time = np.asarray(time, np.float64)
    if time.shape != (frames,) or not np.isfinite(time).all():
        raise DatasetError(f"time has shape {time.shape}; give {frames} finite times, s")
    step, usual = np.diff(time), float(np.median(np.diff(time)))
    back, odd = step <= 0, abs(step - usual) > ROUNDING * usual
    if back.any():
        k = int(np.argmax(back))
        raise DatasetError(
            f"frames are out of order: frame {k + 1} at {time[k + 1]:g} s follows frame {k} at {time[k]:g} s; sort them"
        )
    if odd.any():
        k = int(np.argmax(odd))
        raise DatasetError(
            f"frames are not equally spaced: frame {k + 1} at {time[k + 1]:g} s comes {step[k]:g} s after the last and "
            f"others {usual:g} s; give frames of one interval"
        )
    usual = float(f"{(time[-1] - time[0]) / (frames - 1):.9g}")  # without the rounding of a sum of steps
    if abs(scene.start_time - time[0]) > ROUNDING * usual:
        said.append(f"{time[0]:g} s of the data is the scene's start_time={scene.start_time:g} s")
    end = float(f"{scene.start_time + usual * (frames - 1):.12g}")
    return replace(scene, frame_interval=usual, end_time=end), time


def _radii(scene: Scene, radius: Any, frames: int, refuse: Refuse, said: list[str]) -> FloatArray:
    filling, low, high = scene.filling, scene.filling.smallest_radius, scene.filling.largest_radius
    if radius is None:
        if low < high:
            raise DatasetError("the data lack radius, and the scene's spheres have several; give radii")
        said.append(f"radii are half of scene.filling.diameter={filling.diameter:g} m")
        return np.full(filling.count, filling.radius)
    radius = np.asarray(radius, np.float64)
    if radius.shape not in ((filling.count,), (frames, filling.count)):
        raise DatasetError(f"radius has shape {radius.shape}; give one for each of {filling.count} spheres, m")
    radius = np.broadcast_to(radius, (frames, filling.count))
    refuse(~(np.isfinite(radius) & (radius > 0)), "a radius that is not positive and finite; repair it")
    refuse(abs(radius / radius[0] - 1.0) > ROUNDING, "another radius than in frame 0; give spheres that keep theirs")
    outside = (radius < low * (1 - ROUNDING)) | (radius > high * (1 + ROUNDING))
    refuse(outside, f"a radius that is not in the scene's {low:g} to {high:g} m; set scene.filling.diameter and sizes")
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
