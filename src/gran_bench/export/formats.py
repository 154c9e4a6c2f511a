"""The files: temporal VTKHDF for ParaView, extended XYZ with a mesh of the walls for OVITO, plain arrays for NumPy."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import yaml

from gran_bench.dataset import to_document
from gran_bench.export.source import Exported
from gran_bench.export.walls import Tell, silent, wall_mesh
from gran_bench.files import write_atomically, write_text
from gran_bench.state import FloatArray

_CELLS = ("Vertices", "Lines", "Polygons", "Strips")  # of VTK's PolyData, in the order of the columns of offsets


def write_vtkhdf(exported: Exported, path: Path, tell: Tell = silent) -> None:
    """Write one VTKHDF file (format 2.0, PolyData with Steps): spheres as points, walls as triangles.

    Spheres and walls are one data set: VTK 9.3 (ParaView 5.12) reads no composite one, and the reader of VTK 9.7 gives
    the points of the first time again at every later one of a composite. Point arrays: ``radius`` in m (0 for walls,
    so that a glyph scaled by it draws spheres alone), ``velocity``, ``speed`` in m/s, ``angular_velocity`` in rad/s
    where there is spin, ``id`` and ``type`` (−1 for walls), ``wall`` (0 for spheres, else the wall's number from 1).

    Args:
        exported: what to write; m and s.
        path: of the file, whole or absent afterwards.
        tell: gets a line for each wall that cannot be drawn.
    """
    motion, mesh = exported.trajectory, wall_mesh(exported.scene, *exported.bounds, tell)
    (frames, count), walls = motion.position.shape[:2], len(mesh.point)
    moved = [mesh.at(float(time)) for time in motion.time]

    def both(spheres: FloatArray, k: int) -> FloatArray:
        return np.concatenate([spheres, np.array([wall[k] for wall in moved])], axis=1).astype(np.float32)

    velocity = both(motion.velocity, 1)
    moving = {"velocity": velocity, "speed": np.linalg.norm(velocity, axis=2)}
    if motion.angular_velocity is not None:
        moving["angular_velocity"] = np.pad(motion.angular_velocity, ((0, 0), (0, walls), (0, 0)))
    fixed = {
        "radius": np.pad(motion.radius.astype(np.float32), (0, walls)),
        "id": np.pad(np.arange(count), (0, walls), constant_values=-1),
        "type": np.pad(exported.material.astype(np.int32), (0, walls), constant_values=-1),
        "wall": np.concatenate([np.zeros(count, np.int32), 1 + mesh.wall]),
    }
    # One part with the cells of all frames; where a wall opens, a part a frame. VTK 9.3 and 9.7 read a part's offsets
    # alike only if each kind of cell has as many tables as there are parts.
    opens = not all(there.all() for *_, there in moved)
    parts = frames if opens else 1
    tables = dict.fromkeys(_CELLS, [np.zeros((0, 1), np.int64)] * parts)
    tables["Vertices"] = [np.arange(count)[:, None]] * parts
    tables["Polygons"] = [mesh.triangle[there] + count for *_, there in moved[:parts]]
    # Built in memory, because HDF5 ends the process where a disk is full.
    with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
        file.attrs["scene"] = _scene_text(exported)
        root, steps = file.create_group("VTKHDF"), file.create_group("VTKHDF/Steps")
        root.attrs["Version"], root.attrs["Type"], steps.attrs["NSteps"] = (
            np.array([2, 0]),
            np.bytes_("PolyData"),
            frames,
        )
        start = (count + walls) * np.arange(frames)
        root["Points"], root["NumberOfPoints"] = _flat(both(motion.position, 0)), np.full(parts, count + walls)
        steps["Values"], steps["PointOffsets"] = motion.time.astype(np.float64), start
        steps["PartOffsets"], steps["NumberOfParts"] = opens * np.arange(frames), np.ones(frames, np.int64)
        for name, values in {**fixed, **moving}.items():
            root[f"PointData/{name}"] = values if name in fixed else _flat(values)
            steps[f"PointDataOffsets/{name}"] = 0 * start if name in fixed else start
        cells, ids = np.zeros((2, frames, 4), np.int64)
        for column, (name, table) in enumerate(tables.items()):
            number, width = np.array([len(part) for part in table]), table[0].shape[1]
            root[f"{name}/Connectivity"] = np.concatenate(table).ravel()
            root[f"{name}/Offsets"] = np.concatenate([width * np.arange(n + 1) for n in number])
            root[f"{name}/NumberOfCells"], root[f"{name}/NumberOfConnectivityIds"] = number, width * number
            cells[:, column] = opens * (np.cumsum(number) - number)
            ids[:, column] = width * cells[:, column]
        steps["CellOffsets"], steps["ConnectivityIdOffsets"] = cells, ids
        file.flush()
        image = file.id.get_file_image()
    write_atomically(path, lambda disk: disk.write(image))


def write_xyz(exported: Exported, path: Path, tell: Tell = silent) -> None:
    """Write all frames as extended XYZ, and the walls at the first frame beside it as ``NAME.walls.obj``.

    A line a sphere: species ``material_k``, position and radius in m, velocity and speed in m/s, spin in rad/s
    (``omega``), id. The comment line has the time in s and the box around the container. Nine digits keep a float32.

    Args:
        exported: what to write.
        path: of the file, whole or absent afterwards.
        tell: gets a line that names the mesh, and one for each wall that it does not show as it is.
    """
    motion, (lower, upper) = exported.trajectory, exported.bounds
    spins, count = motion.angular_velocity, len(motion.radius)
    lattice = " ".join(f"{value:.9g}" for value in np.diag(upper - lower).ravel())
    columns = "species:S:1:pos:R:3:radius:R:1:velo:R:3:speed:R:1" + ("" if spins is None else ":omega:R:3") + ":id:I:1"
    head = f'{count}\nLattice="{lattice}" Origin="{" ".join(f"{value:.9g}" for value in lower)}" '
    head += f'pbc="{"F T F" if exported.scene.period else "F F F"}" Properties={columns} Time='

    def write(file) -> None:
        for k, time in enumerate(motion.time):
            velocity = motion.velocity[k]
            row = [1 + exported.material, motion.position[k], motion.radius, velocity, np.linalg.norm(velocity, axis=1)]
            row += [np.arange(count)] if spins is None else [spins[k], np.arange(count)]
            file.write(f"{head}{float(time):.12g}\n".encode())
            np.savetxt(file, np.column_stack(row), "material_%d" + " %.9g" * (8 if spins is None else 11) + " %d")

    write_atomically(path, write)
    mesh = wall_mesh(exported.scene, lower, upper, tell)
    if len(mesh.triangle):
        place, _, there = mesh.at(float(motion.time[0]))
        rows = ["v {:.9g} {:.9g} {:.9g}\n".format(*row) for row in place]
        rows += ["f {} {} {}\n".format(*row) for row in 1 + mesh.triangle[there]]
        write_text(path.with_suffix(".walls.obj"), "".join(rows))
        later = (
            ", from where they move or open later (--to vtkhdf shows it)" if exported.scene.needs.wall_geometry else ""
        )
        tell(f"walls as they stand at the first frame{later}: {path.with_suffix('.walls.obj')}")


def write_npz(exported: Exported, path: Path, tell: Tell = silent) -> None:
    """Write plain arrays in SI units.

    ``time (F,)``, ``position``, ``velocity``, ``angular_velocity (F, N, 3)``, ``radius``, ``material``, ``id (N,)``,
    ``wall_point``, ``wall_velocity (F, M, 3)``, ``wall_triangle (T, 3)``, ``scene`` (YAML).

    Args:
        exported: what to write.
        path: of the file, whole or absent afterwards.
        tell: gets a line for each wall that cannot be drawn.
    """
    motion, mesh = exported.trajectory, wall_mesh(exported.scene, *exported.bounds, tell)
    walls = [mesh.at(float(time)) for time in motion.time]
    arrays = {name: getattr(motion, name) for name in ("time", "position", "velocity", "angular_velocity", "radius")}
    arrays |= {"material": exported.material, "id": np.arange(len(motion.radius)), "wall_triangle": mesh.triangle}
    arrays |= {f"wall_{name}": np.array([wall[k] for wall in walls]) for k, name in enumerate(("point", "velocity"))}
    arrays = {name: values for name, values in arrays.items() if values is not None}
    write_atomically(path, lambda file: np.savez(file, scene=_scene_text(exported), **arrays))


def _flat(values: FloatArray) -> FloatArray:
    """Frames one after the other."""
    return values.reshape(-1, *values.shape[2:])


def _scene_text(exported: Exported) -> str:
    return yaml.safe_dump(to_document(exported.scene), sort_keys=False)
