"""Trajectories as other codes write them: text dumps of LAMMPS and LIGGGHTS, and NumPy archives.

A dump has one block a frame: ``ITEM: TIMESTEP`` or ``ITEM: TIME``, ``ITEM: NUMBER OF ATOMS``, ``ITEM: BOX BOUNDS`` and
``ITEM: ATOMS`` with the names of its columns. An archive is plain, as `gran_bench.export` writes it, or has the layout
of learning-to-simulate and gns: trajectories as pairs of positions ``(F, N, 3)`` and particle types.
"""

import gzip
import pickle
import zipfile
from collections.abc import Iterator, Sequence
from io import StringIO
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from gran_bench.dataset import DatasetError

TAKEN = "a text dump of LAMMPS or LIGGGHTS (also .gz) or an .npz"
_LINES = {"TIMESTEP": 1, "TIME": 1, "NUMBER": 1, "UNITS": 1, "BOX": 3}  # of each item but ATOMS
_COLUMNS = {"position": [*"xyz"], "velocity": ["vx", "vy", "vz"], "angular_velocity": ["omegax", "omegay", "omegaz"]}
# Arguments of `import_arrays` by the names of an archive's arrays.
_ARRAYS = {name: name for name in (*_COLUMNS, "time", "radius", "type", "id")}
_ARRAYS |= {"positions": "position", "velocities": "velocity", "radii": "radius", "times": "time", "ids": "id"}
_ARRAYS |= dict.fromkeys(("material", "types", "particle_type", "particle_types"), "type")


def read_trajectory(
    paths: Sequence[Path], time_step: float | None = None, types: Sequence[int] = (), trajectory: int | None = None
) -> dict[str, np.ndarray]:
    """Read one trajectory.

    Args:
        paths: one archive, or dumps (also .gz), which are put in the order of their first frames.
        time_step: s, of a dump that counts steps.
        types: of the spheres to keep; empty: all.
        trajectory: which one of an archive that has several, from 0.

    Returns:
        What the files have of ``position``, ``velocity``, ``angular_velocity (F, N, 3)``, ``time (F,)``, ``radius``
        ``(N,)`` or ``(F, N)``, ``type`` and ``id (N,)``; in SI units.

    Raises:
        DatasetError: names file, frame and column.
    """
    for path in paths:
        if not path.is_file():
            raise DatasetError(f"{path} is no file; give {TAKEN}")
        if path.suffix in (".h5", ".hdf5"):
            raise DatasetError(
                f"{path} is an HDF5 file; give {TAKEN}. A case needs no import: speeds find one that generate made, "
                "and dataset.files names one that was imported"
            )
    try:
        if paths[0].suffix == ".npz":
            return _archive(paths[0], types, trajectory)
        dumps = sorted((list(_frames(path, time_step, types)) for path in paths), key=lambda frames: frames[0][0])
        return _joined([frame for frames in dumps for frame in frames], paths[0])
    except UnicodeDecodeError as error:
        raise DatasetError(f"{paths[0]} is no text; give {TAKEN}") from error
    except (OSError, EOFError, zipfile.BadZipFile, pickle.UnpicklingError, ValueError) as error:
        raise DatasetError(f"{paths[0]} cannot be read: {str(error).splitlines()[0]}; write it again") from error


def _frames(path: Path, time_step: float | None, types: Sequence[int]) -> Iterator[tuple[float, pd.DataFrame]]:
    """Time, s, and table of each frame."""
    found, head = 0, {}
    with (gzip.open if path.suffix == ".gz" else open)(path, "rt") as file:
        for line in filter(str.strip, file):
            word, *columns = line.removeprefix("ITEM:").split()
            if not line.startswith("ITEM:") or not (word in _LINES or (word == "ATOMS" and "NUMBER" in head)):
                raise DatasetError(f"{path} is no dump of spheres: frame {found} has the line {line.strip()[:40]!r}")
            count = _LINES.get(word) or int(head["NUMBER"])
            lines = list(islice(file, count))
            if len(lines) < count:
                raise DatasetError(f"{path} is cut short in frame {found}: {len(lines)} of {count} lines of {word}")
            if word == "UNITS" and lines[0].strip() != "si":
                raise DatasetError(f"{path} is in units {lines[0].strip()}; write it in units si (m, s, kg)")
            if word != "ATOMS":
                head[word] = lines[0]
                continue
            if "TIME" not in head and time_step is None:
                raise DatasetError(f"{path} counts steps and has no ITEM: TIME; give --time-step, s")
            time = float(head["TIME"]) if "TIME" in head else time_step * float(head.get("TIMESTEP", "nan"))
            yield time, _table(path, found, columns, lines, types)
            found, head = found + 1, {}
    if not found:
        raise DatasetError(f"{path} has no frame; give a dump with ITEM: ATOMS")


def _table(path: Path, frame: int, columns: list[str], lines: list[str], types: Sequence[int]) -> pd.DataFrame:
    if "x" not in columns:  # unwrapped coordinates will do
        columns = [name[0] if name in ("xu", "yu", "zu") else name for name in columns]
    vectors = [triple for key, triple in _COLUMNS.items() if key == "position" or {*triple} & {*columns}]
    wanted = ["id", *(["type"] if types else []), *(name for triple in vectors for name in triple)]
    if missing := [name for name in wanted if name not in columns]:
        raise DatasetError(
            f"{path} lacks the column {', '.join(missing)} (it has {', '.join(columns)}); write it with dump custom "
            "id type x y z vx vy vz omegax omegay omegaz radius"
        )
    kept = [name for name in columns if name in (*wanted, "type", "radius", "diameter")]
    table = pd.read_csv(StringIO("".join(lines)), sep=r"\s+", names=columns, usecols=kept, index_col=False)
    for name in kept:
        if table[name].dtype.kind not in "iuf":
            raise DatasetError(f"{path}: frame {frame} has words in column {name}; give numbers there")
    return table[table["type"].isin(types)] if types else table


def _joined(frames: list[tuple[float, pd.DataFrame]], path: Path) -> dict[str, np.ndarray]:
    tables = [table.assign(frame=k) for k, (_, table) in enumerate(frames)]
    whole = pd.concat(tables, join="inner").sort_values(["frame", "id"], kind="stable")
    if whole.empty:
        raise DatasetError(f"{path} has no sphere to import; choose another --type")
    times = pd.crosstab(whole["frame"], whole["id"]).reindex(range(len(frames)), fill_value=0)
    for frame, column in np.argwhere(times.to_numpy() != 1)[:1]:
        raise DatasetError(
            f"{path}: frame {frame} has id {times.columns[column]:.0f} {times.iat[frame, column]} times; give a dump "
            "that has every sphere once in each frame, or choose spheres with --type"
        )

    def of(columns: str | list[str]) -> np.ndarray:
        return whole[columns].to_numpy(np.float64).reshape(len(frames), times.shape[1], -1)

    arrays = {"time": np.array([time for time, _ in frames]), "id": times.columns.to_numpy()}
    arrays |= {name: of(triple) for name, triple in _COLUMNS.items() if {*triple} <= {*whole}}
    if "diameter" in whole or "radius" in whole:
        arrays["radius"] = of("radius")[..., 0] if "radius" in whole else 0.5 * of("diameter")[..., 0]
    return arrays | ({"type": of("type")[0, :, 0]} if "type" in whole else {})


class _ArraysAlone(pickle.Unpickler):
    """Loads arrays of objects, of which gns makes its archives, and runs nothing that a file names."""

    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] == "numpy" and name in ("_reconstruct", "ndarray", "dtype", "scalar"):
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"it names {module}.{name}, which is no array")


def _archive(path: Path, types: Sequence[int], trajectory: int | None) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(path) as archive:
        arrays = {name.removesuffix(".npy"): _member(archive, name) for name in archive.namelist()}
    found = {_ARRAYS[name]: values for name, values in arrays.items() if name in _ARRAYS}
    if pairs := [values for values in arrays.values() if values.dtype.hasobject]:
        pairs = list(pairs[0]) if "gns_data" in arrays else pairs
        if (trajectory is None and len(pairs) > 1) or not 0 <= (trajectory or 0) < len(pairs):
            raise DatasetError(f"{path} has {len(pairs)} trajectories; choose one with --trajectory, from 0")
        positions, kinds = pairs[trajectory or 0][:2]
        found = {"position": positions, "type": np.broadcast_to(kinds, np.shape(positions)[1:2])}
    if "position" not in found:
        raise DatasetError(f"{path} lacks the array position or gns_data; it has {', '.join(arrays) or 'none'}")
    if types:
        kept = np.isin(found.get("type", []), types)
        if not kept.any():
            raise DatasetError(f"{path} has no sphere of type {list(types)}; choose another --type, or none")
        for name in found.keys() - {"time"}:
            found[name] = found[name][:, kept] if found[name].ndim > 1 else found[name][kept]
    return found


def _member(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    with archive.open(name) as file:
        old = np.lib.format.read_magic(file) == (1, 0)
        read_header = np.lib.format.read_array_header_1_0 if old else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(file)
        if dtype.hasobject:
            return np.asarray(_ArraysAlone(file).load(), object).reshape(shape)
        file.seek(0)
        return np.lib.format.read_array(file, allow_pickle=False)
