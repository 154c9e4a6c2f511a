"""The files: temporal VTKHDF for ParaView, extended XYZ with a mesh of the walls for OVITO, plain arrays for NumPy.

Each writer takes a case and the file, which is whole or absent afterwards.
"""

from pathlib import Path

import h5py
import numpy as np
import yaml

from gran_bench.dataset import Case, to_document
from gran_bench.export.walls import container, wall_mesh
from gran_bench.files import write_atomically, write_text
from gran_bench.state import FloatArray

_CELLS = ("Vertices", "Lines", "Polygons", "Strips")  # of VTK's PolyData, in the order of the columns of offsets


def write_vtkhdf(case: Case, path: Path) -> None:
    """Write one VTKHDF file (format 2.0, PolyData with Steps): spheres as points, walls as triangles.

    Spheres and walls are one data set: VTK 9.3 (ParaView 5.12) reads no composite one, and the reader of VTK 9.7 gives
    the points of the first time again at every later one of a composite. Point arrays: ``radius`` in m (0 for walls,
    so that a glyph scaled by it draws spheres alone), ``velocity``, ``speed`` in m/s, ``angular_velocity`` in rad/s
    where there is spin, ``id`` and ``type`` (−1 for walls), ``wall`` (0 for spheres, else the wall's number from 1).
    """
    motion, mesh = case.trajectory, wall_mesh(case)
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
        "type": np.pad(case.settled.material.astype(np.int32), (0, walls), constant_values=-1),
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
        file.attrs["scene"] = _scene_text(case)
        root, steps = file.create_group("VTKHDF"), file.create_group("VTKHDF/Steps")
        root.attrs["Version"], root.attrs["Type"] = np.array([2, 0]), np.bytes_("PolyData")
        steps.attrs["NSteps"], start = frames, (count + walls) * np.arange(frames)
        root["Points"], root["NumberOfPoints"] = np.concatenate(both(motion.position, 0)), np.full(parts, count + walls)
        steps["Values"], steps["PointOffsets"] = motion.time.astype(np.float64), start
        steps["PartOffsets"], steps["NumberOfParts"] = opens * np.arange(frames), np.ones(frames, np.int64)
        for name, values in {**fixed, **moving}.items():
            root[f"PointData/{name}"] = values if name in fixed else np.concatenate(values)
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


def write_xyz(case: Case, path: Path) -> None:
    """Write all frames as extended XYZ, and the walls at the first frame beside it as ``NAME.walls.obj``.

    A line a sphere: species ``material_k``, position and radius in m, velocity and speed in m/s, spin in rad/s
    (``omega``), id. The comment line has the time in s and the box around the container. Nine digits keep a float32.
    """
    motion, scene, (lower, upper) = case.trajectory, case.scene, container(case)
    spins, count = motion.angular_velocity, len(motion.radius)
    lattice, origin = (" ".join(f"{v:.9g}" for v in values) for values in (np.diag(upper - lower).ravel(), lower))
    columns = "species:S:1:pos:R:3:radius:R:1:velo:R:3:speed:R:1" + ("" if spins is None else ":omega:R:3") + ":id:I:1"
    periodic = "F T F" if scene.period else "F F F"
    head = f'{count}\nLattice="{lattice}" Origin="{origin}" pbc="{periodic}" Properties={columns} Time='

    def write(file) -> None:
        for k, time in enumerate(motion.time):
            velocity, spin = motion.velocity[k], [] if spins is None else [spins[k]]
            speed, first = np.linalg.norm(velocity, axis=1), 1 + case.settled.material
            row = [first, motion.position[k], motion.radius, velocity, speed, *spin, np.arange(count)]
            file.write(f"{head}{float(time):.12g}\n".encode())
            np.savetxt(file, np.column_stack(row), "material_%d" + " %.9g" * (8 + 3 * len(spin)) + " %d")

    write_atomically(path, write)
    mesh = wall_mesh(case)
    if len(mesh.triangle):
        place, _, there = mesh.at(float(motion.time[0]))
        rows = ["v {:.9g} {:.9g} {:.9g}\n".format(*row) for row in place]
        rows += ["f {} {} {}\n".format(*row) for row in 1 + mesh.triangle[there]]
        write_text(path.with_suffix(".walls.obj"), "".join(rows))
        later = ", from where they move or open later (--to vtkhdf shows it)" if scene.needs.wall_geometry else ""
        print(f"walls as they stand at the first frame{later}: {path.with_suffix('.walls.obj')}")


def write_npz(case: Case, path: Path) -> None:
    """Write plain arrays in SI units.

    ``time (F,)``, ``position``, ``velocity``, ``angular_velocity (F, N, 3)``, ``radius``, ``material``, ``id (N,)``,
    ``wall_point``, ``wall_velocity (F, M, 3)``, ``wall_triangle (T, 3)``, ``scene`` (YAML).
    """
    motion, mesh = case.trajectory, wall_mesh(case)
    point, velocity, _ = zip(*(mesh.at(float(time)) for time in motion.time), strict=True)
    arrays = {name: getattr(motion, name) for name in ("time", "position", "velocity", "angular_velocity", "radius")}
    arrays |= {"material": case.settled.material, "id": np.arange(len(motion.radius)), "wall_triangle": mesh.triangle}
    arrays |= {"wall_point": np.array(point), "wall_velocity": np.array(velocity)}
    arrays = {name: values for name, values in arrays.items() if values is not None}
    write_atomically(path, lambda file: np.savez(file, scene=_scene_text(case), **arrays))


def _scene_text(case: Case) -> str:
    return yaml.safe_dump(to_document(case.scene), sort_keys=False)


FORMATS = {"vtkhdf": write_vtkhdf, "xyz": write_xyz, "npz": write_npz}
