"""Extended XYZ for OVITO, with the walls as a mesh beside it, and plain arrays for NumPy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from gran_bench.export.source import Exported, scene_text
from gran_bench.export.walls import wall_mesh
from gran_bench.files import whole_file, write_text

_COLUMNS = "species:S:1:pos:R:3:radius:R:1:velo:R:3:speed:R:1"


def write_xyz(exported: Exported, path: Path | str, tell: Callable[[str], None] = lambda line: None) -> Path:
    """Write a trajectory as extended XYZ, and its walls at the first frame beside it as ``NAME.walls.obj``.

    A line a sphere: species ``material_k``, position and radius in m, velocity and speed in m/s, spin in rad/s
    (``omega``), id. The comment line of a frame has its time in s and the box around the container. Nine digits keep
    every float32.

    Args:
        exported: what to write.
        path: of the file, whole or absent afterwards.
        tell: gets a line for each wall that cannot be drawn, and one where drawn walls move.
    """
    path, motion = Path(path), exported.trajectory
    lower, upper = exported.bounds
    lattice = " ".join(f"{value:.9g}" for value in np.diag(upper - lower).ravel())
    origin = " ".join(f"{value:.9g}" for value in lower)
    wraps = "F T F" if exported.scene.period else "F F F"
    spins = motion.angular_velocity
    columns = _COLUMNS + ("" if spins is None else ":omega:R:3") + ":id:I:1"
    line = "material_%d" + " %.9g" * (8 if spins is None else 11) + " %d"
    count = len(motion.radius)
    with whole_file(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        for frame, time in enumerate(motion.time):
            file.write(
                f'{count}\nLattice="{lattice}" Origin="{origin}" pbc="{wraps}" Properties={columns} '
                f"Time={float(time):.12g}\n"
            )
            velocity = motion.velocity[frame]
            parts = [1 + exported.material, motion.position[frame], motion.radius, velocity]
            parts += [np.linalg.norm(velocity, axis=1), *([] if spins is None else [spins[frame]]), np.arange(count)]
            np.savetxt(file, np.column_stack(parts), line)
    _write_walls(exported, path.with_suffix(".walls.obj"), tell)
    return path


def _write_walls(exported: Exported, path: Path, tell: Callable[[str], None]) -> None:
    mesh = wall_mesh(exported.scene, *exported.bounds, tell)
    if not len(mesh.triangle):
        return
    place, _, there = mesh.at(float(exported.trajectory.time[0]))
    rows = ["v {:.9g} {:.9g} {:.9g}".format(*row) for row in place]
    rows += ["f {} {} {}".format(*row) for row in 1 + mesh.triangle[there]]
    write_text(path, "\n".join(rows) + "\n")
    tell(f"walls as they stand at the first frame: {path}")
    if exported.scene.needs.wall_geometry:
        tell("walls move or open later, which XYZ cannot show; --to vtkhdf does")


def write_npz(exported: Exported, path: Path | str, tell: Callable[[str], None] = lambda line: None) -> Path:
    """Write a trajectory as plain arrays in SI units.

    ``time (F,)``, ``position``, ``velocity``, ``angular_velocity (F, N, 3)``, ``radius``, ``material``, ``id (N,)``,
    ``wall_point (F, M, 3)``, ``wall_velocity (F, M, 3)``, ``wall_triangle (T, 3)``, ``scene`` (YAML). A model without
    spin has no ``angular_velocity``.

    Args:
        exported: what to write.
        path: of the file, whole or absent afterwards.
        tell: gets a line for each wall that cannot be drawn.
    """
    path, motion = Path(path), exported.trajectory
    mesh = wall_mesh(exported.scene, *exported.bounds, tell)
    walls = [mesh.at(float(time)) for time in motion.time]
    arrays = {"time": motion.time, "position": motion.position, "velocity": motion.velocity}
    if motion.angular_velocity is not None:
        arrays["angular_velocity"] = motion.angular_velocity
    arrays |= {"radius": motion.radius, "material": exported.material, "id": np.arange(len(motion.radius))}
    arrays |= {
        "wall_point": np.array([place for place, _, _ in walls], np.float32),
        "wall_velocity": np.array([velocity for _, velocity, _ in walls], np.float32),
        "wall_triangle": mesh.triangle,
        "scene": np.array(scene_text(exported)),
    }
    with whole_file(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **arrays)
    return path
