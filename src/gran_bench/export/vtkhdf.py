"""VTKHDF: all frames in one file that ParaView and VTK open, spheres as points and walls as triangles.

File format 2.0 (https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format), type ``PolyData`` with ``Steps``.
Spheres and walls are one data set, because VTK 9.7 does not move the blocks of a composite one in time: at a new time
its reader gives the first one's points. The array ``wall`` tells the two apart: 0 is a sphere, k the k-th wall.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from gran_bench.export.source import Exported, ExportError, scene_text
from gran_bench.export.walls import WallMesh, wall_mesh
from gran_bench.files import whole_file

_CELLS = ("Vertices", "Lines", "Polygons", "Strips")  # in the order of the columns of offsets
_BYTES = 4 * (3 + 3 + 1 + 3)  # of a point in a frame: position, velocity, speed, spin


def write_vtkhdf(exported: Exported, path: Path | str, tell: Callable[[str], None] = lambda line: None) -> Path:
    """Write a trajectory as one temporal VTKHDF file.

    Point arrays: ``radius`` in m (0 for walls, so that a glyph scaled by it draws the spheres alone), ``velocity`` and
    ``speed`` in m/s, ``angular_velocity`` in rad/s where there are spins, ``id``, ``type`` (material; both −1 for
    walls), ``wall``. Positions are in m, times in s.

    Args:
        exported: what to write.
        path: of the file, whole or absent afterwards.
        tell: gets a line for each wall that cannot be drawn.

    Raises:
        ExportError: the disk has not enough room.
    """
    path, motion = Path(path), exported.trajectory
    frames, count = motion.position.shape[:2]
    mesh = wall_mesh(exported.scene, *exported.bounds, tell)
    points = count + len(mesh.point)
    _hold_room(path, frames * points * _BYTES)
    with whole_file(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["scene"] = scene_text(exported)
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = np.array([2, 0])
        root.attrs["Type"] = np.bytes_("PolyData")
        steps = root.create_group("Steps")
        steps.attrs["NSteps"] = frames
        steps["Values"] = motion.time.astype(np.float64)
        steps["PartOffsets"] = np.arange(frames)
        steps["NumberOfParts"] = np.ones(frames, np.int64)
        steps["PointOffsets"] = points * np.arange(frames)
        root["NumberOfPoints"] = np.full(frames, points)
        _write_points(root, steps, exported, mesh)
        _write_cells(root, steps, exported, mesh)
    return path


def _write_points(root: h5py.Group, steps: h5py.Group, exported: Exported, mesh: WallMesh) -> None:
    motion, walls = exported.trajectory, len(mesh.point)
    frames, count = motion.position.shape[:2]
    points = count + walls
    data, offsets = root.create_group("PointData"), steps.create_group("PointDataOffsets")
    fixed = {
        "radius": np.concatenate([motion.radius.astype(np.float32), np.zeros(walls, np.float32)]),
        "id": np.concatenate([np.arange(count), np.full(walls, -1)]),
        "type": np.concatenate([exported.material.astype(np.int32), np.full(walls, -1, np.int32)]),
        "wall": np.concatenate([np.zeros(count, np.int32), 1 + mesh.wall.astype(np.int32)]),
    }
    for name, values in fixed.items():
        data[name], offsets[name] = values, np.zeros(frames, np.int64)
    moving = {"velocity": 3, "speed": 1} | ({} if motion.angular_velocity is None else {"angular_velocity": 3})
    for name, width in moving.items():
        data.create_dataset(name, (frames * points, width)[: 1 + (width > 1)], np.float32)
        offsets[name] = points * np.arange(frames)
    root.create_dataset("Points", (frames * points, 3), np.float32)
    for frame in range(frames):
        span, (place, velocity, _) = slice(frame * points, (frame + 1) * points), mesh.at(float(motion.time[frame]))
        velocity = np.concatenate([motion.velocity[frame], velocity])
        root["Points"][span] = np.concatenate([motion.position[frame], place])
        data["velocity"][span] = velocity
        data["speed"][span] = np.linalg.norm(velocity, axis=1)
        if motion.angular_velocity is not None:
            data["angular_velocity"][span] = np.concatenate([motion.angular_velocity[frame], np.zeros((walls, 3))])


def _write_cells(root: h5py.Group, steps: h5py.Group, exported: Exported, mesh: WallMesh) -> None:
    """A vertex a sphere, the triangles of the walls; one table for all frames, unless a wall opens."""
    motion = exported.trajectory
    frames, count = motion.position.shape[:2]
    there = np.array([mesh.at(float(time))[2] for time in motion.time]).reshape(frames, len(mesh.triangle))
    triangles = [mesh.triangle[shown] + count for shown in there] if not there.all() else [mesh.triangle + count]
    tables = {"Vertices": [np.arange(count)[:, None]], "Polygons": triangles}
    cells, ids = np.zeros((frames, 4), np.int64), np.zeros((frames, 4), np.int64)
    for column, name in enumerate(_CELLS):
        parts = tables.get(name, [np.zeros((0, 1), np.int64)])
        number = np.array([len(part) for part in parts])
        width = parts[0].shape[1]
        group = root.create_group(name)
        group["Connectivity"] = np.concatenate(parts).ravel()
        group["Offsets"] = np.concatenate([width * np.arange(n + 1) for n in number])
        group["NumberOfCells"] = np.broadcast_to(number, frames)
        group["NumberOfConnectivityIds"] = np.broadcast_to(width * number, frames)
        if len(parts) > 1:
            cells[:, column] = np.cumsum(number) - number
            ids[:, column] = width * cells[:, column]
    steps["CellOffsets"], steps["ConnectivityIdOffsets"] = cells, ids


def _hold_room(path: Path, size: int) -> None:
    """HDF5 ends the process where a disk is full, so the room is looked at before."""
    path.parent.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(path.parent).free
    if size > free:
        raise ExportError(f"{path} takes {size / 1e6:.0f} MB and {free / 1e6:.0f} MB are free; export fewer frames")
