"""A turning drum run by LAMMPS `granular` from a settled bed: the rotation of a case of `drum`, frame by frame.

    lammps-venv/bin/python benchmarks/lammps_drum.py BED.npz OUT.json [--rpm 20] [--tangential mindlin/force] …

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
from dem_vs_lammps import LAMMPS_SCENE

SKIN = 0.005  # m; changes the time that it takes, not the flow
FRAME = 0.01  # s


def commands(
    rpm: float,
    step: float,
    tangential: str = "mindlin/force",
    restitution: float = 0.5,
    cut_tail: bool = False,
    youngs_modulus: float = 1.0e7,
) -> str:
    """LAMMPS' input: the scene of `dem_vs_lammps` at another speed, step, force law and modulus.

    Args:
        rpm: speed of the drum.
        step: s.
        tangential: name of LAMMPS' tangential law.
        restitution: the number that LAMMPS' damping is made of.
        cut_tail: whether a contact that parts may not attract; the restitution that comes out is larger then.
        youngs_modulus: E, Pa.
    """
    text = LAMMPS_SCENE.replace("tangential mindlin/force", f"tangential {tangential}")
    text = text.replace("hertz/material 1e7 0.5 0.29", f"hertz/material {youngs_modulus!r} {restitution!r} 0.29")
    if cut_tail:
        text = text.replace("damping coeff_restitution", "damping coeff_restitution limit_damping")
    return text.format(skin=SKIN, step=step, speed=rpm * 2 * np.pi / 60, processors="* * *")


def main(bed: Path, output: Path, scene: str, step: float, duration: float) -> None:
    """Runs the rotation and writes both series."""
    from lammps import lammps

    state = np.load(bed)
    solver = lammps(cmdargs=["-screen", "none", "-log", "none"])
    solver.commands_string(scene)
    count = len(state["position"])
    solver.create_atoms(
        count, list(range(1, count + 1)), [1] * count, state["position"].ravel().tolist(),
        state["velocity"].ravel().tolist(),
    )  # fmt: skip
    solver.commands_string("set group all diameter 0.05\nset group all density 2500")
    own = solver.extract_setting("nlocal")
    solver.numpy.extract_atom("omega")[:own] = state["angular_velocity"][solver.numpy.extract_atom("id")[:own] - 1]
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
    parser.add_argument("output", type=Path)
    parser.add_argument("--rpm", type=float, default=20.0)
    parser.add_argument("--tangential", default="mindlin/force", help="LAMMPS' name of the tangential law")
    parser.add_argument("--restitution", type=float, default=0.5, help="of which LAMMPS makes its damping")
    parser.add_argument("--cut-tail", action="store_true", help="no attraction while a contact parts")
    parser.add_argument("--youngs-modulus", type=float, default=1.0e7, help="E, Pa")
    parser.add_argument("--step", type=float, default=2.0e-4, help="s")
    parser.add_argument("--duration", type=float, default=4.0, help="s")
    given = parser.parse_args()
    scene = commands(given.rpm, given.step, given.tangential, given.restitution, given.cut_tail, given.youngs_modulus)
    main(given.bed, given.output, scene, given.step, given.duration)
