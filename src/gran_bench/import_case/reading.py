"""Trajectories as other codes write them: text dumps of LAMMPS and LIGGGHTS, and NumPy archives.

A dump has one block a frame: ``ITEM: TIMESTEP`` or ``ITEM: TIME``, ``ITEM: NUMBER OF ATOMS``, ``ITEM: BOX BOUNDS`` and
``ITEM: ATOMS`` with the names of its columns. An archive is plain (``position``, ``time``, ``radius``, …, as
`gran_bench.export` writes it) or has the layout of learning-to-simulate and gns: trajectories as pairs of positions
``(F, N, 3)`` and particle types.
"""

from __future__ import annotations

import gzip
import pickle
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import StringIO
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from gran_bench.dataset import DatasetError
from gran_bench.state import FloatArray

_VECTORS = {
    "position": [("x", "y", "z"), ("xu", "yu", "zu")],
    "velocity": [("vx", "vy", "vz")],
    "angular_velocity": [("omegax", "omegay", "omegaz")],
}
# Names of an archive's arrays, ours first.
_ARRAYS = {
    "position": ("position", "positions"),
    "velocity": ("velocity", "velocities"),
    "angular_velocity": ("angular_velocity", "angular_velocities"),
    "time": ("time", "times"),
    "radius": ("radius", "radii"),
    "type": ("material", "type", "types", "particle_type", "particle_types"),
    "id": ("id", "ids"),
}


@dataclass(frozen=True)
class Frames:
    """A trajectory as a file has it; what the file lacks is None.

    Attributes:
        position: ``(F, N, 3)`` m.
        time: ``(F,)`` s.
        velocity, angular_velocity: ``(F, N, 3)`` m/s, rad/s.
        radius: ``(N,)`` or ``(F, N)`` m.
        type: ``(N,)`` as the other code counts materials.
        id: ``(N,)`` as the other code names spheres.
    """

    position: FloatArray
    time: FloatArray | None = None
    velocity: FloatArray | None = None
    angular_velocity: FloatArray | None = None
    radius: FloatArray | None = None
    type: np.ndarray | None = None
    id: np.ndarray | None = None


def read_frames(
    paths: Sequence[Path], time_step: float | None = None, types: Sequence[int] = (), trajectory: int | None = None
) -> Frames:
    """Read one trajectory.

    Args:
        paths: one archive, or dumps (also .gz), which are put in the order of their first frames.
        time_step: s, of a dump that counts steps.
        types: of the spheres to keep; empty: all.
        trajectory: which one of an archive that has several, from 0.

    Raises:
        DatasetError: names file, frame and column.
    """
    for path in paths:
        if not path.is_file():
            raise DatasetError(f"{path} is no file; give a dump of LAMMPS or LIGGGHTS (also .gz) or an .npz")
    try:
        if paths[0].suffix == ".npz":
            if len(paths) > 1:
                raise DatasetError(f"{paths[1]}: an .npz is imported alone; give one file")
            return _of_types(_archive(paths[0], trajectory), types, paths[0])
        dumps = [list(_blocks(path)) for path in paths]
    except (OSError, EOFError, UnicodeDecodeError, zipfile.BadZipFile, pickle.UnpicklingError, ValueError) as error:
        raise DatasetError(f"{paths[0]} cannot be read: {str(error).splitlines()[0]}; write it again") from error
    blocks = [
        block for dump in sorted(dumps, key=lambda dump: dump[0][0].get("time", dump[0][0]["step"])) for block in dump
    ]
    return _joined(blocks, time_step, types, str(paths[0]))


# ---- dumps ---------------------------------------------------------------------------------------------------


def _blocks(path: Path) -> Iterator[tuple[dict[str, Any], pd.DataFrame]]:
    """Each frame's head (step, time) and its table, sorted by id."""
    found = 0
    with (gzip.open if path.suffix == ".gz" else open)(path, "rt") as file:
        head: dict[str, Any] = {}
        for line in file:
            item, words = line.removeprefix("ITEM:").strip(), line.split()
            if not words:
                continue
            if words[0] != "ITEM:":
                raise DatasetError(
                    f"{path} is no dump of LAMMPS or LIGGGHTS: frame {found} has the line {line.strip()[:40]!r}"
                )
            if item in ("TIMESTEP", "TIME", "NUMBER OF ATOMS"):
                name = {"TIMESTEP": "step", "TIME": "time"}.get(item, "count")
                head = ({} if name == "step" and "count" in head else head) | {name: float(next(file, ""))}
            elif item == "UNITS":
                if (units := next(file, "").strip()) != "si":
                    raise DatasetError(f"{path} is in units {units}; write it in units si (m, s, kg)")
            elif item.startswith("BOX BOUNDS"):
                list(islice(file, 3))
            elif words[1] == "ATOMS" and "count" in head:
                yield (
                    {"step": found} | head,
                    _table(path, found, words[2:], list(islice(file, int(head["count"]))), head),
                )
                found += 1
            else:
                raise DatasetError(f"{path} is no dump of spheres: frame {found} has the unknown ITEM: {item}")
    if not found:
        raise DatasetError(f"{path} has no frame; give a dump with ITEM: ATOMS")


def _table(path: Path, frame: int, columns: list[str], lines: list[str], head: dict[str, Any]) -> pd.DataFrame:
    if len(lines) < head["count"]:
        raise DatasetError(f"{path} is cut short in frame {frame}: {len(lines)} of {head['count']:.0f} spheres")
    kept = [name for names in _VECTORS.values() for triple in names for name in triple]
    kept = [name for name in columns if name in (*kept, "id", "type", "radius", "diameter")]
    missing = [name for name in ("id", "x", "y", "z") if name not in columns and f"{name}u" not in columns]
    for first, *rest in (triple for names in _VECTORS.values() for triple in names):
        missing += [name for name in rest if first in columns and name not in columns and name not in missing]
    if missing:
        raise DatasetError(
            f"{path} lacks the column {', '.join(missing)} (it has {', '.join(columns)}); write it with dump custom "
            "id type x y z vx vy vz omegax omegay omegaz radius"
        )
    table = pd.read_csv(StringIO("".join(lines)), sep=r"\s+", names=columns, usecols=kept, index_col=False)
    words = [name for name in kept if table[name].dtype.kind not in "iuf"]
    if words:
        raise DatasetError(
            f"{path}: frame {frame} has words in column {words[0]}, where numbers belong; write it again"
        )
    return table.sort_values("id", kind="stable")


def _joined(
    blocks: list[tuple[dict[str, Any], pd.DataFrame]], time_step: float | None, types: Sequence[int], path: str
) -> Frames:
    timed = all("time" in head for head, _ in blocks)
    if not timed and time_step is None:
        raise DatasetError(f"{path} counts steps and has no ITEM: TIME; give --time-step, s")
    tables, first = [], None
    for frame, (_, table) in enumerate(blocks):
        if types and "type" in table:
            table = table[table["type"].isin(types)]
        ids = table["id"].to_numpy()
        first = ids if first is None else first
        twice = ids[1:][np.diff(ids) == 0]
        gone, new = np.setdiff1d(first, ids), np.setdiff1d(ids, first)
        for what, names in (("twice", twice), ("no more", gone), ("which frame 0 lacks", new)):
            if len(names):
                more = f" and {len(names) - 1} more" if len(names) > 1 else ""
                raise DatasetError(
                    f"{path}: frame {frame} has id {names[0]:.0f}{more} {what}; import a span in which all spheres are "
                    "there (--from, --until), or choose the spheres with --type"
                )
        tables.append(table)
    if not len(first):
        raise DatasetError(f"{path} has no sphere{f' of type {list(types)}' if types else ''}; choose another --type")

    def column(*names: str) -> np.ndarray | None:
        if any(name not in table for table in tables for name in names):
            return None
        return np.stack([table[list(names)].to_numpy(np.float64) for table in tables])

    arrays: dict[str, Any] = {}
    for name, triples in _VECTORS.items():
        arrays[name] = next((found for triple in triples if (found := column(*triple)) is not None), None)
    radius, diameter, kind = column("radius"), column("diameter"), column("type")
    if radius is None and diameter is not None:
        radius = 0.5 * diameter
    arrays |= {"radius": None if radius is None else radius[..., 0], "type": None if kind is None else kind[0, :, 0]}
    time = [head["time"] if timed else head["step"] * time_step for head, _ in blocks]
    return Frames(**arrays, time=np.array(time), id=first)


# ---- archives ------------------------------------------------------------------------------------------------


class _ArraysAlone(pickle.Unpickler):
    """Loads arrays of objects, of which gns makes its archives, and runs nothing that a file names."""

    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] == "numpy" and name in ("_reconstruct", "ndarray", "dtype", "scalar"):
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"it names {module}.{name}, which is no array")


def _archive(path: Path, trajectory: int | None) -> Frames:
    with zipfile.ZipFile(path) as archive:
        arrays = {name.removesuffix(".npy"): _member(archive, name) for name in archive.namelist()}
    objects = [values for values in arrays.values() if values.dtype.hasobject]
    if objects:
        several = list(objects[0]) if "gns_data" in arrays else objects
        if trajectory is None and len(several) > 1:
            raise DatasetError(f"{path} has {len(several)} trajectories; choose one with --trajectory, from 0")
        if not 0 <= (trajectory or 0) < len(several):
            raise DatasetError(f"--trajectory {trajectory}: {path} has {len(several)}, from 0")
        positions, kinds = several[trajectory or 0][:2]
        found = {"position": positions, "type": np.broadcast_to(kinds, np.shape(positions)[1:2])}
    else:
        names = {ours: next((name for name in theirs if name in arrays), None) for ours, theirs in _ARRAYS.items()}
        found = {ours: arrays[name] for ours, name in names.items() if name is not None}
    if "position" not in found:
        raise DatasetError(f"{path} lacks the array position or gns_data; it has {', '.join(arrays) or 'none'}")
    return Frames(**found)


def _member(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    with archive.open(name) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        if dtype.hasobject:
            return np.asarray(_ArraysAlone(file).load(), object).reshape(shape)
    with archive.open(name) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def _of_types(frames: Frames, types: Sequence[int], path: Path) -> Frames:
    if not types:
        return frames
    if frames.type is None:
        raise DatasetError(f"--type {list(types)}: {path} has no types; leave it out")
    kept = np.isin(frames.type, types)
    if not kept.any():
        raise DatasetError(f"{path} has no sphere of type {list(types)}; choose from {sorted(set(frames.type))}")
    arrays = {name: values for name, values in vars(frames).items() if values is not None}
    for name, values in arrays.items():
        if name != "time":
            arrays[name] = values[:, kept] if np.ndim(values) > 1 else values[kept]
    return Frames(**arrays)
