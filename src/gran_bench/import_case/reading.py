"""Trajectories as other codes write them: text dumps of LAMMPS and LIGGGHTS, and NumPy archives.

A dump has one block a frame: ``ITEM: TIMESTEP`` or ``ITEM: TIME``, ``ITEM: NUMBER OF ATOMS``, ``ITEM: BOX BOUNDS`` and
``ITEM: ATOMS`` with the names of its columns. An archive is plain, as `gran_bench.export` writes it, or has the layout
of learning-to-simulate and gns: trajectories as pairs of positions ``(F, N, 3)`` and particle types.
"""

from __future__ import annotations

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

_VECTORS = {
    "position": [("x", "y", "z"), ("xu", "yu", "zu")],
    "velocity": [("vx", "vy", "vz")],
    "angular_velocity": [("omegax", "omegay", "omegaz")],
}
# Arguments of `import_arrays` by the names of an archive's arrays.
_ARRAYS = {name: name for name in ("position", "velocity", "angular_velocity", "time", "radius", "type", "id")}
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
            raise DatasetError(f"{path} is no file; give a dump of LAMMPS or LIGGGHTS (also .gz) or an .npz")
    try:
        if paths[0].suffix == ".npz":
            return _archive(paths[0], types, trajectory)
        dumps = [list(_blocks(path)) for path in paths]
    except (OSError, EOFError, UnicodeDecodeError, zipfile.BadZipFile, pickle.UnpicklingError, ValueError) as error:
        raise DatasetError(f"{paths[0]} cannot be read: {str(error).splitlines()[0]}; write it again") from error
    dumps.sort(key=lambda dump: dump[0][0].get("time", dump[0][0]["step"]))
    return _joined([block for dump in dumps for block in dump], time_step, types, paths[0])


def _blocks(path: Path) -> Iterator[tuple[dict[str, float], pd.DataFrame]]:
    """Each frame's head (step, time) and its table, sorted by id."""
    found, head = 0, {}
    with (gzip.open if path.suffix == ".gz" else open)(path, "rt") as file:
        for line in filter(str.strip, file):
            item = line.removeprefix("ITEM:").strip()
            if not line.startswith("ITEM:"):
                raise DatasetError(f"{path} is no dump of LAMMPS or LIGGGHTS: frame {found} has the line {item[:40]!r}")
            if item in ("TIMESTEP", "TIME", "NUMBER OF ATOMS"):
                head[{"TIMESTEP": "step", "TIME": "time"}.get(item, "count")] = float(next(file, ""))
            elif item == "UNITS" and (units := next(file, "").strip()) != "si":
                raise DatasetError(f"{path} is in units {units}; write it in units si (m, s, kg)")
            elif item.startswith("BOX BOUNDS"):
                list(islice(file, 3))
            elif item.startswith("ATOMS") and "count" in head:
                lines = list(islice(file, int(head["count"])))
                if len(lines) < head["count"]:
                    raise DatasetError(
                        f"{path} is cut short in frame {found}: {len(lines)} of {head['count']:.0f} spheres"
                    )
                yield {"step": found} | head, _table(path, found, item.split()[1:], lines)
                found, head = found + 1, {}
            elif item != "UNITS":
                raise DatasetError(f"{path} is no dump of spheres: frame {found} has the unknown ITEM: {item}")
    if not found:
        raise DatasetError(f"{path} has no frame; give a dump with ITEM: ATOMS")


def _table(path: Path, frame: int, columns: list[str], lines: list[str]) -> pd.DataFrame:
    triples = [triple for names in _VECTORS.values() for triple in names]
    given = [triple for triple in triples if set(triple) & set(columns)]
    wanted = ["id", *(name for triple in given or triples[:1] for name in triple)]
    if not set(triples[0]) & set(columns) and not set(triples[1]) & set(columns):
        wanted += triples[0]
    missing = [name for name in dict.fromkeys(wanted) if name not in columns]
    if missing:
        raise DatasetError(
            f"{path} lacks the column {', '.join(missing)} (it has {', '.join(columns)}); write it with dump custom "
            "id type x y z vx vy vz omegax omegay omegaz radius"
        )
    kept = [name for name in columns if name in (*wanted, "type", "radius", "diameter")]
    table = pd.read_csv(StringIO("".join(lines)), sep=r"\s+", names=columns, usecols=kept, index_col=False)
    words = [name for name in kept if table[name].dtype.kind not in "iuf"]
    if words:
        raise DatasetError(
            f"{path}: frame {frame} has words in column {words[0]}, where numbers belong; write it again"
        )
    return table.sort_values("id", kind="stable")


def _joined(
    blocks: list[tuple[dict[str, float], pd.DataFrame]], time_step: float | None, types: Sequence[int], path: Path
) -> dict[str, np.ndarray]:
    timed = all("time" in head for head, _ in blocks)
    if not timed and time_step is None:
        raise DatasetError(f"{path} counts steps and has no ITEM: TIME; give --time-step, s")
    tables = [table[table["type"].isin(types)] if types and "type" in table else table for _, table in blocks]
    first = tables[0]["id"].to_numpy()
    if not len(first):
        raise DatasetError(f"{path} has no sphere{f' of type {list(types)}' if types else ''}; choose another --type")
    for frame, table in enumerate(tables):
        ids = table["id"].to_numpy()
        faults = {"twice": ids[1:][np.diff(ids) == 0], "no more": np.setdiff1d(first, ids)}
        for what, names in (faults | {"which frame 0 lacks": np.setdiff1d(ids, first)}).items():
            if len(names):
                more = f" and {len(names) - 1} more" if len(names) > 1 else ""
                raise DatasetError(
                    f"{path}: frame {frame} has id {names[0]:.0f}{more} {what}; give a dump in which all spheres are "
                    "there from first to last, or choose spheres with --type"
                )
    arrays = {
        "time": np.array([head["time"] if timed else head["step"] * time_step for head, _ in blocks]),
        "id": first,
    }
    shared = set.intersection(*(set(table) for table in tables))
    for name, triples in _VECTORS.items():
        for triple in filter(shared.issuperset, reversed(triples)):
            arrays[name] = np.stack([table[list(triple)].to_numpy(np.float64) for table in tables])
    for column, scale in (("diameter", 0.5), ("radius", 1.0)):
        if column in shared:
            arrays["radius"] = scale * np.stack([table[column].to_numpy(np.float64) for table in tables])
    return arrays | ({"type": tables[0]["type"].to_numpy()} if "type" in shared else {})


class _ArraysAlone(pickle.Unpickler):
    """Loads arrays of objects, of which gns makes its archives, and runs nothing that a file names."""

    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] == "numpy" and name in ("_reconstruct", "ndarray", "dtype", "scalar"):
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"it names {module}.{name}, which is no array")


def _archive(path: Path, types: Sequence[int], trajectory: int | None) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(path) as archive:
        arrays = {name.removesuffix(".npy"): _member(archive, name) for name in archive.namelist()}
    pairs = [values for values in arrays.values() if values.dtype.hasobject]
    if pairs:
        pairs = list(pairs[0]) if "gns_data" in arrays else pairs
        if (trajectory is None and len(pairs) > 1) or not 0 <= (trajectory or 0) < len(pairs):
            raise DatasetError(f"{path} has {len(pairs)} trajectories; choose one with --trajectory, from 0")
        positions, kinds = pairs[trajectory or 0][:2]
        found = {"position": positions, "type": np.broadcast_to(kinds, np.shape(positions)[1:2])}
    else:
        found = {_ARRAYS[name]: values for name, values in arrays.items() if name in _ARRAYS}
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
    with archive.open(name) as file:
        return np.lib.format.read_array(file, allow_pickle=False)
