"""One case, one HDF5 file: layout, writing, reading, integrity.

::

    time              (F,)       float64  s
    position          (F, N, 3)  float32  m        chunked by frame, fletcher32
    velocity          (F, N, 3)  float32  m/s      chunked by frame, fletcher32
    angular_velocity  (F, N, 3)  float32  rad/s    chunked by frame, fletcher32
    diagnostics/*     (F,)       float64  overlaps and energies, computed in the engine in float64
    energy/*          (F, …)     float64  with dem.power: powers, losses, spectra (dem/energy.py)
    settled/          the state at the first frame in float64: position, velocity, angular_velocity (N, 3),
                      radius (N,), material (N,) uint8; attribute time
    settled/history/  first, second (M,) int64, force (M, 3) N, overlap (M,) m, rolling_moment (M, 3) N m

A file of a settled bed has the group ``settled`` alone. Attributes of the file: scene, material, engine, step,
seeds, code version, cost; ``scene`` and ``key`` hold YAML. Two of them guard the rest:

- ``digest``, SHA-256 of ``key`` and of all arrays: the same whenever and wherever the same numbers were made.
- ``seal``, SHA-256 of all other attributes, the cost and the machine included.
"""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml

from gran_bench.config.rules import check_arguments, checked_value
from gran_bench.dataset.case_spec import FORMAT_VERSION, DatasetError
from gran_bench.dataset.scene_document import from_document
from gran_bench.files import write_atomically
from gran_bench.scene import Scene, SceneError
from gran_bench.state import ContactHistory, ParticleState, StateError, Trajectory

_BY_FRAME = ("position", "velocity", "angular_velocity")
_STATE = ("position", "velocity", "angular_velocity", "radius", "material")
_HISTORY = ("first", "second", "force", "overlap", "rolling_moment")
_SIGNS_OF_DAMAGE = (AttributeError, LookupError, OSError, RuntimeError, TypeError, ValueError, yaml.YAMLError)


@dataclass(frozen=True)
class Case:
    """A case as it was read."""

    scene: Scene  # as it was simulated
    trajectory: Trajectory  # float32, F frames; the first is the settled state
    settled: ParticleState  # at the first frame, float64, with its contact history
    attributes: dict[str, Any]  # scalars and text by name: engine, time step, seeds, code version, cost
    digest: str  # of the contents
    path: Path


def write_case(
    path: Path, key: dict[str, Any], scene: Scene, trajectory: Trajectory, settled: ParticleState, facts: dict[str, Any]
) -> str:
    """Write a case, whole or not at all; returns the digest.

    Args:
        key: what determines the case.
        trajectory: F frames with spin; ``settled`` is the state at the first one, float64.
        facts: attributes beside those of scene and material.
    """
    arrays = {name: np.asarray(getattr(trajectory, name), np.float32) for name in _BY_FRAME}
    arrays["time"] = np.asarray(trajectory.time, np.float64)
    for name, values in trajectory.diagnostics.items():
        arrays[f"diagnostics/{name}"] = np.asarray(values, np.float64)
    for name, values in trajectory.energy.items():
        arrays[f"energy/{name}"] = np.asarray(values, np.float64)
    attributes = {
        "scene": yaml.safe_dump(key["scene"], sort_keys=False),
        "scene_name": scene.name,
        "frame_interval": scene.frame_interval,
    }
    for owner in ("material", "wall_material"):
        attributes |= {f"{owner}.{name}": value for name, value in key["scene"][owner].items()}
    return _write(path, key, arrays, settled, attributes | facts)


def write_settled(path: Path, key: dict[str, Any], state: ParticleState, facts: dict[str, Any]) -> str:
    """Write a settled bed, whole or not at all; returns the digest."""
    return _write(path, key, {}, state, facts)


def read_case(path: Path | str, frames: slice | None = None) -> Case:
    """Read a case and check it.

    Args:
        path: of the file.
        frames: which frames; None for all, which also recomputes the digest. Part of the frames is checked
            frame by frame, by HDF5's fletcher32.

    Raises:
        DatasetError: the file is missing, cut short, damaged or of another format.
        ConfigError: an argument of a wrong type.
    """
    check_arguments(frames=(frames, slice | None))
    path = Path(checked_value(str, None, path, "path"))
    with _opened(path) as file:
        chosen = slice(None) if frames is None else frames
        arrays = {name: file[name][chosen] for name in (*_BY_FRAME, "time")}
        diagnostics = {name: values[chosen] for name, values in file["diagnostics"].items()}
        attributes = _checked_attributes(file)
        energy = {name: values[chosen] for name, values in file.get("energy", {}).items()}
        named = arrays | {f"diagnostics/{name}": values for name, values in diagnostics.items()}
        named |= {f"energy/{name}": values for name, values in energy.items()}
        settled = _read_state(file, attributes["digest"] if frames is None else None, attributes["key"], named)
        scene = from_document(yaml.safe_load(attributes["scene"]))
        radius = settled.radius.astype(np.float32)
        trajectory = Trajectory(**arrays, radius=radius, diagnostics=diagnostics, energy=energy)
        return Case(scene, trajectory, settled, attributes, attributes["digest"], path)


def read_settled(path: Path | str) -> tuple[ParticleState, dict[str, Any]]:
    """Read a settled bed and its attributes, and check its digest.

    Raises:
        DatasetError: the file is missing, cut short, damaged or of another format.
    """
    with _opened(path) as file:
        attributes = _checked_attributes(file)
        return _read_state(file, attributes["digest"], attributes["key"], {}), attributes


def read_attributes(path: Path | str) -> dict[str, Any]:
    """Attributes of a file, checked against their seal; the quick look that finds a file cut short.

    Raises:
        DatasetError: as :func:`read_case`, but flipped bits in the arrays stay unseen.
    """
    with _opened(path) as file:
        return _checked_attributes(file)


def _write(path: Path, key: dict, arrays: dict[str, np.ndarray], state: ParticleState, attributes: dict) -> str:
    key_text, state_time = yaml.safe_dump(key, sort_keys=True), float(state.time)
    for group, owner, names in (("settled", state, _STATE), ("settled/history", state.history, _HISTORY)):
        for name in names:
            values = np.asarray(getattr(owner, name))
            arrays[f"{group}/{name}"] = np.asarray(values, np.float64) if values.dtype.kind == "f" else values
    digest = _digest(key_text, arrays, state_time)
    attributes = attributes | {"format_version": FORMAT_VERSION, "key": key_text, "digest": digest}
    # v110 puts checksums on HDF5's own structures too; any HDF5 since 1.10 (2016) reads it. Built in memory, because
    # HDF5 crashes the process where a disk is full.
    with h5py.File(path.name, "w", driver="core", backing_store=False, libver=("v110", "v110")) as file:
        for name, values in arrays.items():
            options: dict[str, Any] = {}
            if values.size:  # HDF5 knows no chunk of size zero
                chunk = (1, *values.shape[1:]) if name in _BY_FRAME else values.shape
                options = {"chunks": chunk, "fletcher32": True}
                if name.startswith("energy/"):  # most bins of most frames are empty
                    options |= {"compression": "gzip", "compression_opts": 1, "shuffle": True}
            file.create_dataset(name, data=values, **options)
        file.require_group("diagnostics")
        file["settled"].attrs["time"] = state_time
        for name, value in attributes.items():
            file.attrs[name] = value
        file.attrs["seal"] = _seal(dict(file.attrs))
        file.flush()
        image = file.id.get_file_image()
    write_atomically(path, lambda disk: disk.write(image))
    return digest


@contextmanager
def _opened(path: Path | str) -> Iterator[h5py.File]:
    """The file, open for reading; whatever is wrong with it becomes one clear error."""
    path = Path(checked_value(str, None, path, "path"))
    if not path.exists():
        raise DatasetError(f"{path} does not exist; make it with python -m gran_bench.generate")
    if path.is_dir():
        raise DatasetError(f"{path} is a folder; give the file of a case")
    try:
        # Finished files never change, so they need no lock, and a read-only disk can hold them.
        with h5py.File(path, "r", locking=False) as file:
            yield file
    except PermissionError as error:
        raise DatasetError(f"{path} may not be read ({error.strerror}); change its permissions") from error
    except DatasetError:
        raise
    except _SIGNS_OF_DAMAGE as error:
        if isinstance(error, StateError | SceneError):
            reason = "impossible contents"
        else:
            reason = str(error).strip("'\"").splitlines()[0] if str(error) else type(error).__name__
        raise DatasetError(
            f"{path} is cut short or damaged ({reason}); delete it and run the same command again, which makes it anew"
        ) from error


def _checked_attributes(file: h5py.File) -> dict[str, Any]:
    attributes = {name: _native(value) for name, value in file.attrs.items()}
    if attributes.get("format_version") not in (None, FORMAT_VERSION):
        raise DatasetError(
            f"{file.filename} has format {attributes['format_version']}; this version reads {FORMAT_VERSION}. "
            "Delete it and run the same command again"
        )
    if attributes.pop("seal") != _seal(dict(file.attrs)):
        raise ValueError("its attributes do not match their seal")
    return attributes


def _read_state(file: h5py.File, digest: str | None, key: str, others: dict[str, np.ndarray]) -> ParticleState:
    """The settled state; a digest that is given must be the one of the key, the state and the other arrays."""
    names = [f"settled/{name}" for name in _STATE] + [f"settled/history/{name}" for name in _HISTORY]
    arrays, time = {name: file[name][...] for name in names}, float(file["settled"].attrs["time"])
    if digest is not None and _digest(key, arrays | others, time) != digest:
        raise ValueError("its contents do not match their digest")
    history = ContactHistory(*(arrays[f"settled/history/{name}"] for name in _HISTORY))
    return ParticleState(**{name: arrays[f"settled/{name}"] for name in _STATE}, time=time, history=history)


def _digest(key: str, arrays: dict[str, np.ndarray], state_time: float) -> str:
    """SHA-256 over key, state time, and name, type, shape and bytes of every array."""
    digest = hashlib.sha256(f"{key}\n{state_time!r}\n".encode())
    for name in sorted(arrays):
        values = np.ascontiguousarray(arrays[name])
        values = values.astype(values.dtype.newbyteorder("<"), copy=False)
        digest.update(f"{name} {values.dtype.str} {values.shape}\n".encode())
        digest.update(values.data if values.size else b"")
    return digest.hexdigest()


def _seal(attributes: dict[str, Any]) -> str:
    """SHA-256 over every attribute but the seal."""
    text = "\n".join(f"{name}={_native(value)!r}" for name, value in sorted(attributes.items()) if name != "seal")
    return hashlib.sha256(text.encode()).hexdigest()


def _native(value: Any) -> Any:
    """NumPy scalars and arrays as Python values."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value
